"""What learned policies are worth: rows of their learning curves, and the input of figure 7 from such rows.

A row's ``horizon`` is the optimiser iterations done; for the model-free policies of benchmarks/model_free, whose
``prior`` is empty, the environment steps taken. All have the condition "learning".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from tsmlib.envs.spec import sim_of
from tsmlib.figures.policies import Curves, LearningCurves
from tsmlib.figures.style import name
from tsmlib.planning.tasks import TOLERANCE
from tsmlib.statistics import interval

EXTRA = ("copy",)  # column beside the usual ones
UNITS = {"return_true": "m", "return_predicted": "m", "exploitation_gap": "m", "final_distance": "m",
         "success": "share"}  # fmt: skip


def learning_rows(
    header: Mapping[str, Any], *, samples: int, train_seconds: float, n: int = 100, within_data: Iterable[float] = ()
) -> list[dict[str, Any]]:
    """Rows of a learned policy, one per record, copy and metric; header: as ``study.learn`` returns it.

    samples: environment steps in the data set of its model; train_seconds: of the model and the prior; n: the targets
    it is measured on. Both are rows too, so that the table says what a policy has cost in all. within_data: of the
    learned policy, one per copy (``study.within_data``).
    """
    env, curve = header["fingerprint"]["env"], header["curve"]
    common = dict(
        env=env, sim=sim_of(env), task=header["made_from"]["task"], model=header["model"], planner="policy",
        prior=header["prior"], condition="learning", seed=header["seed"], scale=header["scale"],
    )  # fmt: skip
    measured = {metric: np.asarray(values) for metric, values in curve["measured"].items()}  # (records, copies) each
    measured["exploitation_gap"] = measured["return_predicted"] - measured["return_true"]
    rows = [
        dict(common, horizon=iteration, metric=metric, value=float(value), unit=unit, n=n, copy=copy)
        for metric, unit in UNITS.items()
        for iteration, values in zip(curve["iteration"], measured[metric], strict=True)
        for copy, value in enumerate(values)
    ]
    rows += [
        dict(common, horizon=iteration, metric="seconds", value=seconds, unit="s")
        for iteration, seconds in zip(curve["iteration"], curve["seconds"], strict=True)
    ]
    common |= dict(horizon=curve["iteration"][-1])
    for metric, value, unit in (("samples", samples, "steps"), ("train_seconds", train_seconds, "s")):
        rows.append(dict(common, metric=metric, value=value, unit=unit))
    return rows + [
        dict(common, metric="within_data", value=float(value), unit="share", n=n, copy=copy)
        for copy, value in enumerate(within_data)
    ]


def learning_curves(rows: Iterable[Mapping[str, Any]]) -> LearningCurves:
    """The input of ``figures.figure7``: task -> label -> curves, from rows of learning; others are passed over.

    Copies and seeds of a label are its k lines. Seconds are the processor's where a table has them, else the clock's,
    which are more on a busy machine; training of the model is counted. ValueError where lines were not measured at the
    same points, or where one task was learned in two environments.
    """
    methods: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in _one_env([row for row in rows if row["condition"] == "learning" and row.get("horizon", "") != ""]):
        methods.setdefault((row["task"], f"{row['model']} {row['prior']}".strip()), []).append(row)
    found: dict[str, dict[str, Curves]] = {}
    for (task, label), own in methods.items():
        try:
            found.setdefault(task, {})[label] = _curves(own)
        except ValueError as error:
            raise ValueError(f"{task}, {label}: {error}") from None
    return found


def finished(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The rows of a growing table without those of seeds that stopped before the longest one of their method."""
    rows = [row for row in rows if row["condition"] == "learning"]
    ends: dict[tuple[Any, ...], dict[Any, int]] = {}
    for row in rows:
        seeds = ends.setdefault((row["env"], row["model"], row["prior"]), {})
        seeds[row["seed"]] = max(seeds.get(row["seed"], 0), row["horizon"])
    return [
        row for row in rows
        for seeds in [ends[row["env"], row["model"], row["prior"]]] if seeds[row["seed"]] == max(seeds.values())
    ]  # fmt: skip


def _curves(rows: Iterable[Mapping[str, Any]]) -> Curves:
    """The curves of one method."""
    by_metric: dict[str, dict[tuple[int, Any], dict[int, float]]] = {}  # metric -> (seed, copy) -> horizon -> value
    model_free = False
    for row in rows:
        line = by_metric.setdefault(row["metric"], {}).setdefault((row["seed"], row.get("copy", "")), {})
        if row["horizon"] in line:
            raise ValueError(f"{row['metric']} of seed {row['seed']} stands twice at {row['horizon']}")
        line[row["horizon"]] = row["value"]
        model_free = row["prior"] == ""
    first = next(iter(by_metric["return_true"].values()))
    at = np.array(sorted(first))

    def stacked(metric: str) -> np.ndarray:
        """(k, R)"""
        for (seed, copy), line in by_metric[metric].items():
            if sorted(line) != at.tolist():
                raise ValueError(
                    f"{metric} of seed {seed}{f', copy {copy}' if copy != '' else ''} was measured at "
                    f"{len(line)} points up to {max(line)}, expected the {len(at)} up to {at[-1]} of the others"
                )
        return np.array([[line[x] for x in at.tolist()] for line in by_metric[metric].values()])

    curves = {metric: stacked(metric) for metric in by_metric if metric in UNITS}
    curves["seconds"] = stacked("cpu_seconds" if "cpu_seconds" in by_metric else "seconds").mean(0)
    if model_free:
        return curves | {"samples": at}
    samples, before = (
        np.mean([value for line in by_metric[metric].values() for value in line.values()])
        for metric in ("samples", "train_seconds")
    )
    return curves | {
        "iterations": at, "samples": np.full(len(at), samples), "seconds": curves["seconds"] + before
    }  # fmt: skip


def references(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Task -> label -> mean true return of the oracle's plans and of no torque, from rows of 05_control.csv.

    ValueError where one task was done in two environments.
    """
    found: dict[str, dict[str, float]] = {}
    for row in _one_env([row for row in rows if row["metric"] == "return_true"]):
        if row["model"] == "oracle" or row["planner"] == "zero":
            label = "zero" if row["planner"] == "zero" else f"oracle {row['prior']} {row['planner']}"
            found.setdefault(row["task"], {})[label] = row["value"]
    return found


def _one_env(rows: list[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    envs: dict[str, str] = {}
    for row in rows:
        if envs.setdefault(row["task"], row["env"]) != row["env"]:
            raise ValueError(
                f"rows of task {row['task']} are of {envs[row['task']]} and of {row['env']}; give those of one of them"
            )
    return rows


def reached(curves: Curves, level: float, against: str = "samples") -> float | None:
    """After how much of ``against`` (samples, iterations or seconds) the mean true return first reaches ``level``.

    Between two records along the straight line; None where it never does.
    """
    mean, spent = curves["return_true"].mean(0), curves[against]
    above = np.flatnonzero(mean >= level)
    if not len(above):
        return None
    i = int(above[0])
    if i == 0:
        return float(spent[0])
    share = (level - mean[i - 1]) / (mean[i] - mean[i - 1])
    return float(spent[i - 1] + share * (spent[i] - spent[i - 1]))


def plateau_rows(
    curves: Mapping[str, Curves], *, steps: int, share: float = 0.9, **common: Any
) -> list[dict[str, Any]]:
    """Rows of what each policy needed to come to ``share`` of the common plateau (claims C37 and C39), one task's.

    curves: label -> curves of one seed, of the policies that are compared. Their common plateau is what those learned
    inside models and the best of the model-free ones have all come to in the end; what counts is the gain over the
    best of all before learning. There are no rows where that is none. A model-free policy that never comes there counts
    with all that it took. steps: of its model that a policy takes per iteration.

    ``samples_to_90``: steps of what it learned in, the model or else the environment; ``env_samples_to_90``: steps of
    the environment, the data of its model included; ``seconds_to_90``: training of its model included.
    """
    means = {label: own["return_true"].mean(0) for label, own in curves.items()}
    inside, free = ([mean[-1] for label, mean in means.items() if (" " in label) == way] for way in (True, False))
    ends = [*inside, *([max(free)] if free else [])]
    start = max((mean[0] for mean in means.values()), default=0.0)
    if not ends or not min(ends) > start:
        return []
    level, rows = start + share * (min(ends) - start), []
    for label, own in curves.items():
        model, _, prior = label.partition(" ")
        ways = {"samples_to_90": "iterations" if prior else "samples", "env_samples_to_90": "samples",
                "seconds_to_90": "seconds"}  # fmt: skip
        for metric, against in ways.items():
            spent = reached(own, level, against)
            value = (float(own[against][-1]) if spent is None else spent) * (steps if against == "iterations" else 1)
            rows.append(dict(
                common, model=model, planner="policy", prior=prior, condition="learning", metric=metric, value=value,
                unit="s" if against == "seconds" else "steps", n=len(own["return_true"]),
            ))  # fmt: skip
    return rows


SOONEST = {"samples_to_90": "steps of model or environment", "env_samples_to_90": "steps of the environment",
           "seconds_to_90": "seconds"}  # fmt: skip


def plateaus(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows of ``plateau_rows`` as a Markdown table: what each policy needed to come to 90 %, means over seeds."""
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for row in rows:
        if row["metric"] in SOONEST:
            label = f"{row['model']} {row['prior']}".strip()
            found.setdefault((row["task"], label), {}).setdefault(row["metric"], []).append(row["value"])
    lines = [f"| task | policy | {' | '.join(SOONEST.values())} |", "|---" * (len(SOONEST) + 2) + "|"]
    for (task, label), own in found.items():
        cells = " | ".join(f"{np.mean(own[metric]):,.0f}" for metric in SOONEST)
        lines.append(f"| {task} | {name(label)} | {cells} |")
    return "\n".join(lines) if found else ""


def report(curves: LearningCurves) -> str:
    """The end of every learning curve as a Markdown table: means over copies and seeds, with half 95 % intervals."""
    shown = {"return_true": "earned", "return_predicted": "promised", "final_distance": "final distance (m)",
             "success": f"within {TOLERANCE} m"}  # fmt: skip
    lines = [f"| task | policy | k | {' | '.join(shown.values())} | environment steps | seconds |"]
    lines.append("|---" * (len(shown) + 5) + "|")
    for task, methods in curves.items():
        for label, own in methods.items():
            cells = []
            for metric in shown:
                mean, half = interval(own[metric][:, -1]) if metric in own else (0.0, 0.0)
                cells.append((f"{mean:.3f}" + (f" ± {half:.3f}" if half else "")) if metric in own else "")
            cells += [f"{own[word][-1]:,.0f}" for word in ("samples", "seconds")]
            lines.append(f"| {task} | {name(label)} | {len(own['return_true'])} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
