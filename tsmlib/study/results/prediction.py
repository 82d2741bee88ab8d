"""The scoreboard of 03_predict: what ``evaluate.score`` found as rows of a table, and rows as curves, tables and pairs.

Conditions, in the table's column of that name:

    clean              open loop from the first H observed steps to the end of the episode, all test episodes
    contact            the same, from the first touch of arm and obstacle or object on
    segments           H steps from the true past, three to an episode (what the model defines)
    segments contact   the same, segments with a touch in them

A row with an empty horizon is the mean over all predicted steps, the paper's "per timestep".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tsmlib.envs.spec import has_block, imperfections, sim_of
from tsmlib.evaluation.contacts import after_first, contact_steps
from tsmlib.evaluation.prediction import LEVELS, Scores, cut
from tsmlib.statistics import interval
from tsmlib.trajectory import Trajectories

SEGMENTS = range(10, 100, 30)  # steps at which the segments that are scored from the true past begin
HORIZONS = (1, 2, 5, 10, 20, 30, 40, 50, 60, 70, 80, 90)
LOWER_IS_BETTER = ("energy_score", "crps", "energy_score_noise", "crps_noise", "nrmse")
Rows = Sequence[Mapping[str, Any]]


def rows(
    env: str, model: str, open_loop: Scores, segments: Scores, test: Trajectories, **common: Any
) -> list[dict[str, Any]]:
    """One model's rows of metrics/03_predict.csv. common: seed and scale."""
    common = dict(env=env, sim=sim_of(env), model=model, planner="none", **common)
    subsets: dict[str, tuple[Scores, Tensor | None]] = {"clean": (open_loop, None), "segments": (segments, None)}
    if has_block(test.env):
        touched = touches(test, segments, SEGMENTS).any(1, keepdim=True)
        subsets["contact"] = (open_loop, after_first(touches(test, open_loop)))
        subsets["segments contact"] = (segments, touched.expand(-1, segments.pit.shape[1]))
    found = []
    for condition, (scores, where) in subsets.items():
        n = torch.full((scores.pit.shape[1],), len(scores.outside)) if where is None else where.sum(0)  # at each step
        if not n.any():
            continue
        here = dict(common, condition=condition, n=len(scores.outside) if where is None else int(where.any(1).sum()))
        curves = scores.against_horizon(where)
        for metric, value in means(scores, where).items():
            found.append(dict(here, metric=metric, value=value))
            steps = [h for h in HORIZONS if h <= len(n) and n[h - 1]] if scores is open_loop else []
            found += [
                dict(here, metric=metric, horizon=h, value=float(curves[metric][h - 1]), n=int(n[h - 1])) for h in steps
            ]
        if scores is open_loop:
            observed = scores.calibration(where)
            found += [
                dict(here, metric=f"calibration{round(100 * float(level))}", value=float(share), unit="share")
                for level, share in zip(LEVELS, observed, strict=True)
            ]
    found.append(
        dict(common, condition="clean", n=len(open_loop.outside), metric="diverged", unit="share",
             value=float(open_loop.outside.mean()))
    )  # fmt: skip
    return found


def means(scores: Scores, where: Tensor | None = None) -> dict[str, float]:
    """Mean over all predicted steps, or those of ``where`` (N, T), metric -> number."""
    found = {
        metric: float(value.mean() if where is None else value[where].mean()) for metric, value in scores.values.items()
    }
    found["nrmse"] = math.sqrt(found.pop("squared_error"))
    return found


def touches(test: Trajectories, scores: Scores, starts: Sequence[int] = (10,)) -> Tensor:
    """(N, T) bool in the order of ``scores``: the arm touches the obstacle or object. ValueError for noisy states."""
    if imperfections(test.env)[1]:
        raise ValueError(f"noisy states of {test.env} do not tell what touches; give the same episodes without noise")
    return cut(contact_steps(test.states, test.env), starts, scores.pit.shape[1])


# Reading rows --------------------------------------------------------------------------------------------------------


def values(found: Rows, metric: str, *, env: str, condition: str = "clean", horizon: Any = "") -> dict[str, np.ndarray]:
    """Model -> one value per seed, in the order of the seeds."""
    by_model = _by_seed(found, metric, env=env, condition=condition, horizon=horizon)
    return {model: np.array([seeds[k] for k in sorted(seeds)]) for model, seeds in by_model.items()}


def paired(found: Rows, subject: str, metric: str, **where: Any) -> dict[str, np.ndarray]:
    """Model -> ``subject`` minus that model, one difference per seed that both were trained with."""
    chosen = _by_seed(found, metric, **where)
    first = chosen.pop(subject, {})
    pairs = {model: sorted(set(first) & set(seeds)) for model, seeds in chosen.items()}
    return {model: np.array([first[k] - chosen[model][k] for k in seeds]) for model, seeds in pairs.items() if seeds}


def curves(found: Rows, metric: str, *, env: str, condition: str = "clean") -> dict[str, np.ndarray]:
    """Model -> (seeds, 90): the metric at every step ahead, on straight lines between those of HORIZONS."""
    given = {h: values(found, metric, env=env, condition=condition, horizon=h) for h in HORIZONS}
    given = {h: by_model for h, by_model in given.items() if by_model}
    steps = np.arange(1, max(given, default=0) + 1)
    return {
        model: np.stack(
            [np.interp(steps, list(given), seeds) for seeds in np.stack([v[model] for v in given.values()]).T]
        )
        for model in next(iter(given.values()), {})
    }


def calibration(found: Rows, *, env: str, condition: str = "clean") -> dict[str, np.ndarray]:
    """Model -> (19,): observed coverage at the nominal LEVELS, mean over seeds."""
    shares = [values(found, f"calibration{round(100 * float(v))}", env=env, condition=condition) for v in LEVELS]
    return {model: np.array([share[model].mean() for share in shares]) for model in shares[0]}


def board(
    found: Rows, metrics: Sequence[str], *, env: str, condition: str = "clean", horizons: Sequence[Any] = ("",)
) -> str:
    """A Markdown table: one line per model, mean over seeds ± half its 95 % interval; fewer seeds are said."""
    columns = [(metric, h) for metric in metrics for h in horizons]
    cells = {c: values(found, c[0], env=env, condition=condition, horizon=c[1]) for c in columns}
    heads = [metric + (f" at {h}" if h != "" else "") for metric, h in columns]
    lines = ["| model | " + " | ".join(heads) + " |", "|---" * (len(columns) + 1) + "|"]
    most = max((len(seeds) for seeds in cells[columns[0]].values()), default=0)
    for model, seeds in cells[columns[0]].items():
        fewer = f" (seeds: {len(seeds)})" if len(seeds) < most else ""
        lines.append(
            f"| {model}{fewer} | " + " | ".join(_spell(by_model.get(model)) for by_model in cells.values()) + " |"
        )
    return "\n".join(lines)


def _spell(seeds: np.ndarray | None) -> str:
    if seeds is None:
        return ""
    mean, half = interval(seeds)
    return f"{mean:.3g}" + (f" ± {half:.2g}" if len(seeds) > 1 else "")


def _by_seed(
    found: Rows, metric: str, *, env: str, condition: str = "clean", horizon: Any = ""
) -> dict[str, dict[int, float]]:
    by_model: dict[str, dict[int, float]] = {}
    for row in found:
        if (row["metric"], row["env"], row["condition"], row.get("horizon", "")) == (metric, env, condition, horizon):
            by_model.setdefault(row["model"], {})[row["seed"]] = row["value"]
    return by_model
