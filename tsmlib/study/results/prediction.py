"""Results of 03_predict: rows from scores; curves, pairs and tables from rows.

``execution`` is "open loop" (from the first ten observed steps to the end of the episode) or "segments" (ten steps from
the true past, three to an episode); ``subset`` is empty or "contact" (steps from the first touch of arm and obstacle or
object on; segments with a touch in them). Empty ``steps_ahead``: mean over all predicted steps, the paper's "per
timestep".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.contacts import after_first, contact_steps
from tsmlib.evaluation.prediction import Scores, cut
from tsmlib.evaluation.scoring import LEVELS
from tsmlib.figures.method import Method
from tsmlib.study.results import table
from tsmlib.study.results.table import Row
from tsmlib.trajectory import Trajectories

SEGMENTS = range(10, 100, 30)  # steps at which the segments that are scored from the true past begin
HORIZONS = (1, 2, 5, 10, 20, 30, 40, 50, 60, 70, 80, 90)
LOWER_IS_BETTER = ("energy_score", "crps", "energy_score_noise", "crps_noise", "nrmse")


def rows(env: str, model: str, open_loop: Scores, segments: Scores, test: Trajectories, **common: object) -> list[Row]:
    """One model's rows. test: the episodes that were scored, or more; common: seed and scale."""
    test = test.take(slice(len(open_loop.outside)))
    common = table.place(env) | dict(model=model, planner="none", **common)
    whole = torch.ones(open_loop.pit.shape[:2], dtype=torch.bool)
    parts = [("open loop", "", open_loop, whole), ("segments", "", segments, torch.ones_like(segments.pit[..., 0] > 0))]
    if EnvSpec.parse(test.env).has_block:
        touched = touches(test, segments, SEGMENTS).any(1, keepdim=True)
        parts.append(("open loop", "contact", open_loop, after_first(touches(test, open_loop))))
        parts.append(("segments", "contact", segments, touched.expand(-1, segments.pit.shape[1])))
    found = []
    for execution, subset, scores, where in parts:
        if where.any():
            chosen = where if subset else None
            here = dict(common, execution=execution, subset=subset, n=int(where.any(1).sum()))
            found += [dict(here, metric=metric, value=value) for metric, value in means(scores, chosen).items()]
            if scores is open_loop:
                found += _by_step(scores, chosen, where.sum(0), here) + _calibrated(scores, chosen, here)
    diverged = dict(metric="diverged", unit="share", value=float(open_loop.outside.mean()), n=len(open_loop.outside))
    return [*found, dict(common, execution="open loop", **diverged)]


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


def _coverage(level: Any) -> str:
    return f"calibration{round(100 * float(level))}"


def means(scores: Scores, where: Tensor | None = None) -> dict[str, float]:
    """Mean over all predicted steps, or those of ``where`` (N, T), metric -> number."""
    found = {
        metric: float(value.mean() if where is None else value[where].mean()) for metric, value in scores.values.items()
    }
    found["nrmse"] = math.sqrt(found.pop("squared_error"))
    return found


def touches(test: Trajectories, scores: Scores, starts: Sequence[int] = (10,)) -> Tensor:
    """(N, T) bool in the order of ``scores``: the arm touches the obstacle or object. ValueError for noisy states."""
    if EnvSpec.parse(test.env).noise:
        raise ValueError(f"noisy states of {test.env} do not tell what touches; give the same episodes without noise")
    return cut(contact_steps(test.states, test.env), starts, scores.pit.shape[1])


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


def select(found: pd.DataFrame, metric: str | Sequence[str], *, env: str, **where: object) -> pd.DataFrame:
    """Rows of an environment, imperfect or not: open loop, of everything, mean over steps, unless ``where`` says
    otherwise of execution, subset or steps_ahead."""
    spec = EnvSpec.parse(env)
    arm = {"env": spec.arm.id, "noise": spec.noise or None, "delay": spec.delay or None}
    asked = arm | {"execution": "open loop", "subset": "", "steps_ahead": None} | where
    return table.select(found, metric=metric, **asked)


def values(found: pd.DataFrame, metric: str, *, env: str, **where: object) -> dict[str, np.ndarray]:
    """Model -> one value per seed, in the order of the seeds; of the rows that ``select`` gives."""
    return table.values(select(found, metric, env=env, **where))


def ranking(found: pd.DataFrame, metric: str, *, env: str, **where: object) -> list[str]:
    """Models from the best to the worst mean over seeds."""
    means = {model: seeds.mean() for model, seeds in values(found, metric, env=env, **where).items()}
    return sorted(means, key=lambda model: means[model], reverse=metric not in LOWER_IS_BETTER)


def paired(found: pd.DataFrame, subject: str, metric: str, *, env: str, **where: object) -> dict[Method, np.ndarray]:
    """Method -> ``subject`` minus that model, one difference per seed that both were trained with."""
    return table.methods(table.pairs(select(found, metric, env=env, **where), subject))


def curves(found: pd.DataFrame, metric: str, *, env: str, **where: object) -> dict[Method, np.ndarray]:
    """Method -> (seeds, 90): the metric at every step ahead, on straight lines between those of HORIZONS."""
    lines: dict[str, np.ndarray] = {}
    for model, own in table.groups(select(found, metric, env=env, steps_ahead=HORIZONS, **where), "model"):
        wide = own.pivot(index="seed", columns="steps_ahead", values="value").dropna(axis=1, how="all")
        known = wide.columns.to_numpy(dtype=float)
        lines[model] = np.stack([np.interp(np.arange(1, known[-1] + 1), known, seed) for seed in wide.to_numpy()])
    return table.methods(lines)


def calibration(found: pd.DataFrame, *, env: str, **where: object) -> dict[Method, np.ndarray]:
    """Method -> (19,): observed coverage at the nominal LEVELS, mean over seeds."""
    metrics = [_coverage(level) for level in LEVELS]
    wide = table.means(select(found, metrics, env=env, **where), "model").reindex(columns=metrics)
    return table.methods(table.arrays(wide.T))


def scores_table(
    found: pd.DataFrame,
    metrics: Sequence[str],
    *,
    env: str,
    steps_ahead: Sequence[int | None] = (None,),
    **where: object,
) -> str:
    """A Markdown table: one line per model, mean over seeds ± half its 95 % interval; fewer seeds are said."""
    own = select(found, metrics, env=env, steps_ahead=list(steps_ahead), **where)
    if own.empty:
        return ""
    own = own.assign(
        column=own["metric"] + own["steps_ahead"].map(lambda h: "" if pd.isna(h) else f" at {h}").astype(str)
    )
    titles = [metric + (f" at {h}" if h else "") for metric in metrics for h in steps_ahead]
    wide = own.pivot_table(index="model", columns="column", values="value", aggfunc=table.spell, sort=False)
    seeds = own[own["column"] == titles[0]].groupby("model")["seed"].nunique()
    wide = wide.reindex(columns=titles).loc[[model for model in wide.index if model in seeds]]
    wide.index = [f"{model} (seeds: {seeds[model]})" if seeds[model] < seeds.max() else model for model in wide.index]
    return table.markdown(wide.rename_axis("model").reset_index())
