"""Results of 06_robustness: rows of errors and policies; curves, the map, tables and thresholds from rows.

An imperfect arm's rows have the plain arm's name as ``env``; what is imperfect stands in ``noise`` and ``delay``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np
import pandas as pd
from torch import Tensor

from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, NOISE
from tsmlib.evaluation.filtering import PARTS, rmse
from tsmlib.plots.method import Method
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.policies import model_steps, seed_means
from reproduction.results.prediction import paired, select, values
from reproduction.results.table import PolicyHeader, Row

LAST = (
    880  # iterations up to which policies are compared; by then the curves of 05_control are flat
)
THRESHOLDS = {"lost": 0.2, "success50": 0.6}  # of a policy, with noise and with delay


# Rows ----------------------------------------------------------------------------------------------------------------


def error_rows(
    env: str, model: str, ahead: np.ndarray | None, now: np.ndarray | None = None, **common: object
) -> list[Row]:
    """Rows ``rmse_clean``: of the steps ahead (N, K, dx) and over all of them, and of now (``steps_ahead`` 0).

    Beside the whole state also angles, velocities and fingertip apart, in metrics of their own.
    """
    common |= table.place(env) | dict(
        model=model, planner="none", execution="segments", unit="half range"
    )
    rows = []
    for part, dims in {"": slice(None), **PARTS}.items():
        here = dict(common, metric=f"rmse_clean_{part}".removesuffix("_"))
        if now is not None:
            rows.append(dict(here, steps_ahead=0, value=rmse(now[..., dims]), n=len(now)))
        if ahead is not None:
            rows.append(dict(here, value=rmse(ahead[..., dims]), n=len(ahead)))
            for k, step in enumerate(ahead.swapaxes(0, 1), start=1):
                rows.append(dict(here, steps_ahead=k, value=rmse(step[:, dims]), n=len(step)))
    return rows


def policy_rows(header: PolicyHeader, distances: Tensor, *, level: float = 0.05) -> list[Row]:
    """Rows ``success50`` of a learned policy, one per copy: the share of targets within ``level`` metres at the end.

    distances (copies, targets): final distances in metres.
    """
    common = table.policy(header) | dict(
        iteration=header["curve"]["iteration"][-1],
        n=distances.shape[1],
        metric=f"success{1000 * level:.0f}",
        unit="share",
    )
    return [
        dict(common, value=float((own < level).float().mean()), copy=copy)
        for copy, own in enumerate(distances)
    ]


# Reading rows --------------------------------------------------------------------------------------------------------


def filtering_panels(
    found: pd.DataFrame, env: str, models: Sequence[str]
) -> tuple[dict[str, dict[Method, np.ndarray]], dict[str, dict[Method, float]], dict[str, float]]:
    """The input of ``figures.filtering_errors``: errors ahead of models and the filter, of filters now, and raw."""
    ahead: dict[str, dict[Method, np.ndarray]] = {}
    now: dict[str, dict[Method, float]] = {}
    raw: dict[str, float] = {}
    for part in ("", *PARTS):
        metric, title = f"rmse_clean_{part}".removesuffix("_"), part or "whole state"
        at = [
            values(found, metric, env=env, execution="segments", steps_ahead=step)
            for step in range(11)
        ]
        drawn = [model for model in at[1] if model in (*models, "filter")]
        ahead[title] = {
            zoo.method(model): np.stack([step[model] for step in at[1:]], 1) for model in drawn
        }
        now[title] = {
            zoo.method(model): float(at[0][model].mean())
            for model in ("filter", "exponential")
            if model in at[0]
        }
        raw[title] = float(at[1]["none"].mean())
    return ahead, now, raw


def own_errors(
    found: pd.DataFrame, env: str, models: Sequence[str]
) -> dict[str, dict[Method, np.ndarray]]:
    """The reader's own in ``figures.filtering_errors``: panel -> method -> errors ahead (k, 10)."""
    if not len(select(found, "rmse_clean", env=env, execution="segments", steps_ahead=1)):
        return {}
    return filtering_panels(found, env, models)[0]


@table.told
def errors_told(found: pd.DataFrame, env: str, models: Sequence[str]) -> Iterator[str]:
    """A sentence on errors to the clean state, one and ten steps ahead, as shares of the raw observation's."""
    for step in (1, 10):
        of = values(found, "rmse_clean", env=env, execution="segments", steps_ahead=step)
        words = {**{model: zoo.look(model).name for model in models}, "filter": "Kalman filter"}
        said = [
            f"{name} {of[model].mean() / of['none'].mean():.2f}"
            for model, name in words.items()
            if model in of
        ]
        if said and "none" in of:
            yield f"{step} step{'s' * (step > 1)} ahead, as shares of the raw observation's: {', '.join(said)}."


@table.told
def worlds_told(
    found: pd.DataFrame, envs: Mapping[str, str], models: Sequence[str]
) -> Iterator[str]:
    """A sentence per world on errors and on truths within 80 % intervals. envs: world -> environment."""
    for title, env in envs.items():
        error, held = (values(found, metric, env=env) for metric in ("nrmse", "coverage80"))
        blind = values(found, "nrmse", env=env, subset="past actions zero")
        if said := [
            f"{zoo.look(model).name} {error[model].mean():.2f}"
            for model in models
            if model in error
        ]:
            text = f"{title}, error / data's s.d.: {', '.join(said)}"
            text += "".join(
                f"; {zoo.look(model).name} shown zeros for past actions {blind[model].mean():.2f}"
                for model in models
                if model in blind
            )
            yield text + "."
        if said := [
            f"{zoo.look(model).name} {held[model].mean():.0%}" for model in models if model in held
        ]:
            yield f"{title}, truths within 80 % intervals: {', '.join(said)}."


@table.told
def lost_told(
    found: pd.DataFrame, methods: Sequence[Method], random: float, last: int = LAST
) -> Iterator[str]:
    """A sentence per world on the share of the clean arm's gain over random torques that policies lose there."""
    for arm in ("noise", "delay"):
        shares = {method: lost(found, method, arm, last, random) for method in methods}
        if said := [
            f"{method.label} {share:.0%}" for method, share in shares.items() if share == share
        ]:
            yield f"{arm}, lost of the clean gain: {', '.join(said)}."


def world(noise: float, delay: int) -> str:
    """Imperfections in words: clean; noise, delay, or both, with numbers unless the paper's."""
    words = [
        word if value == paper else f"{word} {value:g}"
        for word, value, paper in (("noise", noise, NOISE), ("delay", delay, DELAY))
        if value
    ]
    return ", ".join(words) or "clean"


@table.sourced
def thresholds_table(
    found: pd.DataFrame, method: Method, random: float, last: int = LAST
) -> pd.DataFrame:
    """``thresholds`` in Markdown."""
    return thresholds(found, method, random, last)


def _policies(found: pd.DataFrame, last: int, *metrics: str) -> pd.DataFrame:
    """Rows of policies of at most ``last`` iterations, with the columns method and world."""
    own = table.with_method(
        table.select(found, planner="policy", metric=metrics), "model", "search_space"
    )
    own = own[(own["iteration"] <= last).to_numpy(dtype=bool)]
    return own.assign(world=list(map(world, own["noise"].fillna(0), own["delay"].fillna(0))))


def _ends(found: pd.DataFrame, last: int, *metrics: str) -> pd.DataFrame:
    """The last of the rows that ``_policies`` gives, of each method, world and metric."""
    own = _policies(found, last, *metrics)
    end = own.groupby(["method", "world", "metric"], sort=False)["iteration"].transform("max")
    return own[own["iteration"] == end]


@table.sourced
def policies_table(found: pd.DataFrame, last: int = LAST) -> pd.DataFrame:
    """What policies come to in each world, in Markdown: means over seeds, or over the copies of the only one, with half
    their 95 % t interval, at the last record of at most ``last`` iterations."""
    shown = {
        "return_true": "executed return",
        "final_distance": "final distance (m)",
        "success50": "within 0.05 m",
    }
    ends = _ends(found, last, *shown)
    said = {
        key: table.spell(seed_means(own.set_index(["seed", "copy"])[["value"]])["value"])
        for key, own in table.groups(ends, ["world", "metric", "method"])
    }
    columns: dict[str, list[object]] = {"method": list(ends["method"].unique())}
    for arm, (metric, title) in product(ends["world"].unique(), shown.items()):
        if any(key[:2] == (arm, metric) for key in said):
            columns[f"{arm}: {title}"] = [
                said.get((arm, metric, method), "") for method in columns["method"]
            ]
    return pd.DataFrame(columns)


def lost(found: pd.DataFrame, method: Method, arm: str, last: int, random: float) -> float:
    """Share of a policy's gain over random torques on the clean arm that ``arm`` (noise or delay) takes away."""
    ends = _ends(found, last, "return_true")
    mean = ends[ends["method"] == method].groupby("world")["value"].mean()
    clean, here = (mean.get(world, math.nan) for world in ("clean", arm))
    return float((clean - here) / (clean - random))


def learning_curves(
    found: pd.DataFrame, last: int = LAST
) -> dict[str, dict[Method, dict[str, np.ndarray]]]:
    """The input of ``figures.figure8``: world -> method -> curves against steps in the model, those that are
    ``policies.seed_means``, of up to ``last`` iterations."""
    curves: dict[str, dict[Method, dict[str, np.ndarray]]] = {}
    for (arm, method), own in table.groups(
        _policies(found, last, "return_true"), ["world", "method"]
    ):
        wide = seed_means(own.pivot(index=["seed", "copy"], columns="iteration", values="value"))
        steps = wide.columns.to_numpy(dtype=float) * model_steps(*own[["task", "scale"]].iloc[0])
        seeds = np.array(own["seed"].nunique())
        curves.setdefault(arm, {})[method] = {
            "steps": steps,
            "return_true": wide.to_numpy(),
            "seeds": seeds,
        }
    return curves


def advantage_rows(
    found: pd.DataFrame,
    clean: pd.DataFrame,
    models: Sequence[str],
    noises: Sequence[float],
    delays: Sequence[int],
) -> pd.DataFrame:
    """The rows of the map: ``ll_horizon`` of some models, open loop, of each of its places. clean: of 03_predict, which
    scored models of more seeds where there is neither noise nor delay; each measurement once."""
    both = pd.concat([clean, found])
    rows = [
        select(both, "ll_horizon", env=env, subset=subset, model=models)
        for env, subset in _places(noises, delays).values()
    ]
    same = ["env", "noise", "delay", "subset", "model", "seed", "scale"]
    return pd.concat(rows).drop_duplicates([*same, *(["source"] if "source" in both else [])])


def _places(noises: Sequence[float], delays: Sequence[int]) -> dict[str, tuple[str, str]]:
    """Place of the map -> environment and subset: the plain arm with every noise and delay, then the one with the
    obstacle, from the first touch on."""
    plain, obstacle = "tsm/Reacher-v0", "tsm/ReacherObstacle-v0"
    places = {
        f"noise {noise:g}, delay {delay}": (imperfect(plain, noise=noise, delay=delay), "")
        for delay in delays
        for noise in noises
    }
    return places | {"obstacle, after contact": (obstacle, "contact")}


def advantage(
    rows: pd.DataFrame,
    subject: str,
    rivals: Sequence[str],
    noises: Sequence[float],
    delays: Sequence[int],
) -> dict[str, dict[Method, np.ndarray]]:
    """``subject`` minus each rival in ``ll_horizon``, nats per step: the input of the map.

    Place -> rival -> a difference for each training seed that both have (k,); places without any are left out. rows:
    as ``advantage_rows`` gives them.
    """
    ahead = {}
    for words, (env, subset) in _places(noises, delays).items():
        pairs = paired(rows, subject, "ll_horizon", env=env, subset=subset)
        if found := {other: pairs[other] for other in map(zoo.method, rivals) if other in pairs}:
            ahead[words] = found
    return ahead


def thresholds(
    found: pd.DataFrame, method: Method, random: float, last: int = LAST
) -> pd.DataFrame:
    """Thresholds of a policy, what was measured, and whether they were reached; for ``table.thresholds_table``."""
    lines = []
    for arm in ("noise", "delay"):
        share = lost(found, method, arm, last, random)
        own = _policies(found, last, "success50")
        near = own[(own["method"] == method) & (own["world"] == arm)]["value"].mean()
        lines.append(
            (
                f"{arm}: lost of the clean gain over random torques",
                "at most",
                THRESHOLDS["lost"],
                share,
            )
        )
        lines.append(
            (f"{arm}: targets reached within 0.05 m", "at least", THRESHOLDS["success50"], near)
        )
    return table.thresholds([(*line, "{:.1%}") for line in lines])
