"""Results of 03_predict: rows from scores; curves, pairs and tables from rows.

``execution`` is "open loop" (from the first ten observed steps to the end of the episode) or "segments" (ten steps from
the true past, three to an episode); ``subset`` is empty or "contact" (steps from the first touch of arm and obstacle or
object on; segments with a touch in them). Empty ``steps_ahead``: mean over all predicted steps, the paper's "per
timestep".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.contacts import after_first, contact_steps
from tsmlib.evaluation.prediction import Scores, cut
from tsmlib.evaluation.scoring import LEVELS
from tsmlib.plots.method import Method
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.table import Row
from tsmlib.trajectory import Trajectories

SEGMENTS = range(
    10, 100, 30
)  # steps at which the segments that are scored from the true past begin
HORIZONS = (1, 2, 5, 10, 20, 30, 40, 50, 60, 70, 80, 90)
TRIMMED_SHARE = 0.05  # of episodes, which the subset TRIMMED leaves out
TRIMMED = "without the worst 5 %"  # of the episodes, by the model's own mean log-likelihood
LOWER_IS_BETTER = ("energy_score", "crps", "energy_score_noise", "crps_noise", "nrmse")
NAMES = {  # of metrics, as readers meet them
    "ll_paper": "log-likelihood, paper's protocol",
    "ll_shared": "log-likelihood, one shared variance",
    "ll_horizon": "log-likelihood, variance per step",
    "ll_own": "log-likelihood, own density",
    "energy_score": "energy score, bare samples",
    "energy_score_noise": "energy score",
    "crps_noise": "CRPS",
    "nrmse": "error / data's s.d.",
    "coverage80": "truths in 80 % intervals",
    "diverged": "rollouts out of range",
    "spread": "spread of samples",
    "error": "error",
    "kl": "KL (nats)",
    "active_units": "active units",
    "spread_ratio": "spread after / before a touch",
    "spearman": "rank correlation of spread and error",
    "recall": "recall",
    "majority": "foretold by most samples",
    "precision": "precision",
    "chance": "recall by chance",
    "deflection_error": "direction, error (°)",
    "deflection_spread": "spread (°)",
    "deflection_spearman": "rank correlation",
    "deflection_coverage80": "truths in 80 % intervals",
    "deflection_still": "samples that do not move it",
    "travel_error": "distance, error (m)",
    "travel_spread": "spread (m)",
    "travel_spearman": "rank correlation",
    "travel_coverage80": "truths in 80 % intervals",
}


def rows(
    env: str, model: str, open_loop: Scores, segments: Scores, test: Trajectories, **common: object
) -> list[Row]:
    """One model's rows. test: the episodes that were scored, or more; common: seed and scale."""
    test = test.take(slice(len(open_loop.outside)))
    common = table.place(env) | dict(model=model, planner="none", **common)
    whole = torch.ones(open_loop.pit.shape[:2], dtype=torch.bool)
    parts = [
        ("open loop", "", open_loop, whole),
        ("segments", "", segments, torch.ones_like(segments.pit[..., 0] > 0)),
    ]
    if EnvSpec.parse(test.env).has_block:
        touched = touches(test, segments, SEGMENTS).any(1, keepdim=True)
        parts.append(("open loop", "contact", open_loop, since_touch(test, open_loop)))
        parts.append(("segments", "contact", segments, touched.expand(-1, segments.pit.shape[1])))
    found = []
    for execution, subset, scores, where in parts:
        if where.any():
            chosen = where if subset else None
            here = dict(common, execution=execution, subset=subset, n=int(where.any(1).sum()))
            found += [
                dict(here, metric=metric, value=value)
                for metric, value in means(scores, chosen).items()
            ]
            if scores is open_loop:
                found += _by_step(scores, chosen, where.sum(0), here) + _calibrated(
                    scores, chosen, here
                )
    found.append(dict(common, execution="open loop", **_trimmed(open_loop)))
    diverged = dict(
        metric="diverged",
        unit="share",
        value=float(open_loop.outside.mean()),
        n=len(open_loop.outside),
    )
    return [*found, dict(common, execution="open loop", **diverged)]


def _trimmed(scores: Scores) -> Row:
    """``ll_own`` without the episodes in which it is lowest: a mean of log scores is decided by few that all miss."""
    by_episode = (
        scores.values["ll_own"].mean(1).sort().values[int(TRIMMED_SHARE * len(scores.outside)) :]
    )
    return dict(metric="ll_own", subset=TRIMMED, value=float(by_episode.mean()), n=len(by_episode))


def _by_step(scores: Scores, where: Tensor | None, n: Tensor, here: Row) -> list[Row]:
    """Scores at the steps of HORIZONS that ``n`` (T,) rollouts, at least one, have."""
    steps = [h for h in HORIZONS if h <= len(n) and n[h - 1]]
    return [
        dict(here, metric=metric, steps_ahead=h, value=float(curve[h - 1]), n=int(n[h - 1]))
        for metric, curve in scores.against_horizon(where).items()
        for h in steps
    ]


def _calibrated(scores: Scores, where: Tensor | None, here: Row) -> list[Row]:
    return [
        dict(here, metric=_coverage(level), value=float(share), unit="share")
        for level, share in zip(LEVELS, scores.calibration(where), strict=True)
    ]


def _coverage(level: float | Tensor) -> str:
    return f"calibration{round(100 * float(level))}"


def means(scores: Scores, where: Tensor | None = None) -> dict[str, float]:
    """Mean over all predicted steps, or those of ``where`` (N, T), metric -> number."""
    found = {
        metric: float(value.mean() if where is None else value[where].mean())
        for metric, value in scores.values.items()
    }
    found["nrmse"] = math.sqrt(found.pop("squared_error"))
    return found


def touches(test: Trajectories, scores: Scores, starts: Sequence[int] = (10,)) -> Tensor:
    """(N, T) bool in the order of ``scores``: the arm touches the obstacle or object. ValueError for noisy states."""
    return cut(_contacts(test), starts, scores.pit.shape[1])


def since_touch(test: Trajectories, scores: Scores, starts: Sequence[int] = (10,)) -> Tensor:
    """(N, T) bool: it touches now or has in the episode, also before the prediction began. As ``touches`` otherwise."""
    return cut(after_first(_contacts(test)), starts, scores.pit.shape[1])


def _contacts(test: Trajectories) -> Tensor:
    if EnvSpec.parse(test.env).noise:
        raise ValueError(
            f"noisy states of {test.env} do not tell what touches; give the same episodes without noise"
        )
    return contact_steps(test.states, test.env)


def extremes(test: Trajectories, scores: Scores) -> tuple[np.ndarray, np.ndarray | None]:
    """Best, median and worst episode by energy score, among those with a touch if these are three or more, and the step
    of their first touch: negative without one, None without a block."""
    energy = scores.values["energy_score"].mean(1).numpy()
    if not EnvSpec.parse(test.env).has_block:
        return np.argsort(energy)[[0, len(energy) // 2, -1]], None
    touching = touches(test, scores).numpy()
    first = np.where(touching.any(1), touching.argmax(1), -1)
    among = np.flatnonzero(first >= 0) if (first >= 0).sum() >= 3 else np.arange(len(first))
    order = among[np.argsort(energy[among])]
    picked = order[[0, len(order) // 2, -1]]
    return picked, first[picked]


# Reading rows --------------------------------------------------------------------------------------------------------


def select(
    found: pd.DataFrame, metric: str | Sequence[str], *, env: str, **where: object
) -> pd.DataFrame:
    """Rows of an environment, imperfect or not: open loop, of everything, mean over steps, unless ``where`` says
    otherwise of execution, subset or steps_ahead."""
    spec = EnvSpec.parse(env)
    arm = {"env": spec.arm.id, "noise": spec.noise or None, "delay": spec.delay or None}
    asked = arm | {"execution": "open loop", "subset": "", "steps_ahead": None} | where
    return table.select(found, metric=metric, **asked)


def values(found: pd.DataFrame, metric: str, *, env: str, **where: object) -> dict[str, np.ndarray]:
    """Model -> one value per seed, in the order of the seeds; of the rows that ``select`` gives."""
    return table.values(select(found, metric, env=env, **where))


@table.sourced
def best_table(found: pd.DataFrame, titles: Mapping[str, str], envs: Sequence[str]) -> pd.DataFrame:
    """The best model of each environment by some metrics, in Markdown; titles: of metrics."""
    ranked = {
        env: {title: ranking(found, metric, env=env) for metric, title in titles.items()}
        for env in envs
    }
    return pd.DataFrame(
        {"env": env} | {title: zoo.look(order[0]).name for title, order in row.items()}
        for env, row in ranked.items()
        if all(row.values())
    )


@table.told
def versus(
    found: pd.DataFrame, subject: str, rival: str, metric: str, envs: Sequence[str], **where: object
) -> Iterator[str]:
    """A sentence per environment: the values of two models, and their difference where it has an interval."""
    for env in envs:
        of = values(found, metric, env=env, **where)
        if subject in of and rival in of:
            apart = paired(found, subject, metric, env=env, **where).get(
                zoo.method(rival), np.zeros(0)
            )
            more = f"; difference {table.spell(apart)}" if len(apart) > 1 else ""
            yield (
                f"{EnvSpec.parse(env).name}, {NAMES[metric]}: {zoo.look(subject).name} {table.spell(of[subject])}, "
                f"{zoo.look(rival).name} {table.spell(of[rival])}{more}."
            )


def named(*metrics: str) -> dict[str, str]:
    """Metrics with their NAMES, for ``scores_table``."""
    return {metric: NAMES[metric] for metric in metrics}


def ranking(found: pd.DataFrame, metric: str, *, env: str, **where: object) -> list[str]:
    """Models from the best to the worst mean over seeds."""
    means = {
        model: seeds.mean() for model, seeds in values(found, metric, env=env, **where).items()
    }
    return sorted(means, key=lambda model: means[model], reverse=metric not in LOWER_IS_BETTER)


def paired(
    found: pd.DataFrame, subject: str, metric: str, *, env: str, **where: object
) -> dict[Method, np.ndarray]:
    """Method -> ``subject`` minus that model, one difference per seed that both were trained with."""
    return table.methods(table.pairs(select(found, metric, env=env, **where), subject))


def curves(
    found: pd.DataFrame, metric: str, *, env: str, **where: object
) -> dict[Method, np.ndarray]:
    """Method -> (seeds, 90): the metric at every step ahead, on straight lines between those of HORIZONS."""
    lines: dict[str, np.ndarray] = {}
    for model, own in table.groups(
        select(found, metric, env=env, steps_ahead=HORIZONS, **where), "model"
    ):
        wide = own.pivot(index="seed", columns="steps_ahead", values="value").dropna(
            axis=1, how="all"
        )
        known = wide.columns.to_numpy(dtype=float)
        lines[model] = np.stack(
            [np.interp(np.arange(1, known[-1] + 1), known, seed) for seed in wide.to_numpy()]
        )
    return table.methods(lines)


def score_panels(
    found: pd.DataFrame, titles: Mapping[str, str], envs: Sequence[str]
) -> dict[str, dict[str, dict[Method, np.ndarray]]]:
    """The input of ``figures.figure5``: title -> environment -> method -> one value per seed; titles: of metrics."""
    found_of = {
        metric: {env: table.methods(values(found, metric, env=env)) for env in envs}
        for metric in titles
    }
    return {
        titles[metric]: {EnvSpec.parse(env).name: found for env, found in rows.items() if found}
        for metric, rows in found_of.items()
    }


def horizon_panels(
    found: pd.DataFrame, titles: Mapping[str, str], envs: Sequence[str]
) -> dict[str, dict[Method, np.ndarray]]:
    """The input of ``figures.against_horizon``: a panel for each environment and metric; titles: of metrics."""
    return {
        f"{EnvSpec.parse(env).name}: {title}": curves(found, metric, env=env)
        for env in envs
        for metric, title in titles.items()
    }


def paired_panels(
    found: pd.DataFrame, subject: str, titles: Mapping[str, str], env: str
) -> dict[str, dict[Method, np.ndarray]]:
    """The input of ``figures.differences`` of an environment: a panel for each metric; titles: of metrics."""
    return {title: paired(found, subject, metric, env=env) for metric, title in titles.items()}


def calibration_panels(
    found: pd.DataFrame, envs: Sequence[str]
) -> dict[str, dict[Method, np.ndarray]]:
    """The input of ``figures.calibration``: a panel for each environment, then those after contact."""
    contact = [env for env in envs if EnvSpec.parse(env).has_block]
    panels = {EnvSpec.parse(env).name: calibration(found, env=env) for env in envs}
    return panels | {
        f"{EnvSpec.parse(env).name}, after contact": calibration(found, env=env, subset="contact")
        for env in contact
    }


def calibration(found: pd.DataFrame, *, env: str, **where: object) -> dict[Method, np.ndarray]:
    """Method -> (19,): observed coverage at the nominal LEVELS, mean over seeds."""
    metrics = [_coverage(level) for level in LEVELS]
    wide = table.means(select(found, metrics, env=env, **where), "model").reindex(columns=metrics)
    return table.methods(table.arrays(wide.T))


@table.sourced
def scores_table(
    found: pd.DataFrame,
    metrics: Sequence[str] | Mapping[str, str],
    *,
    env: str,
    steps_ahead: Sequence[int | None] = (None,),
    **where: object,
) -> pd.DataFrame:
    """A Markdown table: one line per model, mean over seeds ± half its 95 % interval; fewer seeds are said.

    metrics: their words, or with them the titles of columns; then models stand by their names.
    """
    own = select(found, list(metrics), env=env, steps_ahead=list(steps_ahead), **where)
    if own.empty:
        return own
    titles = metrics if isinstance(metrics, Mapping) else {metric: metric for metric in metrics}
    own = own.assign(
        column=own["metric"].map(titles)
        + own["steps_ahead"].map(lambda h: "" if pd.isna(h) else f" at {h}").astype(str)
    )
    columns = [title + (f" at {h}" if h else "") for title in titles.values() for h in steps_ahead]
    wide = own.pivot_table(
        index="model", columns="column", values="value", aggfunc=table.spell, sort=False
    )
    seeds = own[own["column"] == columns[0]].groupby("model")["seed"].nunique()
    wide = wide.reindex(columns=columns).loc[[model for model in wide.index if model in seeds]]
    names = wide.index if titles is not metrics else [zoo.look(model).name for model in wide.index]
    fewer = [f" (seeds: {n})" if (n := seeds[model]) < seeds.max() else "" for model in wide.index]
    if "source" in found:
        wide.insert(0, "n", own.groupby("model")["n"].max())
    wide.index = [name + few for name, few in zip(names, fewer, strict=True)]
    return wide.rename_axis("model").reset_index()


@table.sourced
def own_density_table(found: pd.DataFrame, envs: Sequence[str]) -> pd.DataFrame:
    """``ll_own`` over 90 steps in Markdown, of all episodes and without the worst of each model: a line per model."""
    columns: dict[str, dict[str, str]] = {}
    for env in envs:
        for subset, words in (("", "all episodes"), (TRIMMED, TRIMMED)):
            numbers = values(found, "ll_own", env=env, subset=subset)
            columns[f"{EnvSpec.parse(env).name}: {words}"] = {
                model: table.spell(own) for model, own in numbers.items()
            }
    return pd.DataFrame(columns).fillna("").rename_axis("model").reset_index()


def over_the_best(
    found: pd.DataFrame, subject: str, metric: str, *, env: str, steps_ahead: Sequence[int]
) -> pd.DataFrame:
    """The subject's score over the lowest of all other models' of the same seed, a line per seed, a column per step
    ahead; of a seed without others, or without the subject, none."""
    lines = []
    for seed, part in table.groups(
        select(found, metric, env=env, steps_ahead=list(steps_ahead)), "seed"
    ):
        wide = part.pivot(index="steps_ahead", columns="model", values="value")
        others = wide.drop(columns=subject, errors="ignore")
        if subject in wide and others.shape[1]:
            line = {"seed": seed}
            for h in steps_ahead:
                best = str(others.loc[h].idxmin())
                line[f"at {h} steps"] = (
                    f"{wide[subject][h] / others[best][h]:.2f} ({zoo.look(best).name})"
                )
            lines.append(line)
    return pd.DataFrame(lines)
