"""What trials are worth: the rows and tables of 05_control, what figures draw from them, and pictures of plans.

A row's ``condition`` is OPEN (executed open loop, as in the paper), CLOSED (planned again every few steps) or ALONG
(open loop, as the plan was after ``horizon`` iterations of its planner).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tsmlib.collection import smooth_torques
from tsmlib.envs.spec import sim_of, task_of
from tsmlib.evaluation.actions import novelty, roughness
from tsmlib.evaluation.exploitation import shares, worst
from tsmlib.figures.style import NAMES, label, pretty
from tsmlib.planning.base import Plan
from tsmlib.planning.execution import Trial
from tsmlib.planning.planners import iterations_to
from tsmlib.planning.tasks import TOLERANCE, Task
from tsmlib.statistics import interval
from tsmlib.study.runs import Run

OPEN, CLOSED, ALONG = "clean", "closed loop", "along the way"
ORACLE, NOTHING = label("oracle", "cem", "codes"), label("none", "zero", "")  # what earned returns are held against
PAPER = ("tsm", "tsm+energy+direct", "onestep", "multistep", "lstm", "ensemble+mse")  # rows of figure 6, and ours
INVARIANTS = ("moves_untouched", "penetrates", "broken")

Row = Mapping[str, Any]
Rows = Iterable[Row]
Trials = Mapping[str, Mapping[str, Trial]]  # environment -> method's label -> trial
Number = tuple[float, str]  # value and unit


# Rows ----------------------------------------------------------------------------------------------------------------


def numbers(task: Task, trial: Trial, condition: str = OPEN) -> dict[str, tuple[Tensor, str]]:
    """What a trial measured for each target: metric -> values (B,) and unit. For ``broken`` see ``invariants``."""
    found = {"return_true": (trial.executed_return, "m"), "final_distance": (trial.final_distance, "m")}
    if trial.plan is not None:
        found["return_predicted"] = (trial.plan.predicted_return, "m")
        if task_of(task.env) == "push" and condition != CLOSED:  # there, every plan dreams from another start
            broken = shares(task.start, trial.plan.states.numpy(), task.env)
            found |= {name: (torch.from_numpy(share), "share") for name, share in broken.items()}
    return found


def means(task: Task, trial: Trial, among: Mapping[str, Trial], condition: str = OPEN) -> dict[str, Number]:
    """Means over the targets, and what only makes sense over all of them: metric -> value and unit.

    among: all methods' trials of the task. With the oracle over codes in it, ``cost_over_oracle`` is the mean cost over
    the oracle's; with zero torque as well, ``gain_share`` is the part of the oracle's gain over doing nothing.
    ``_worst`` is the mean over the worst tenth of plans; for what is said of torques see ``invariants``.
    """
    each = numbers(task, trial, condition)
    found: dict[str, Number] = {metric: (float(values.mean()), unit) for metric, (values, unit) in each.items()}
    found["success"] = (float((trial.final_distance <= TOLERANCE).float().mean()), "share")
    oracle, nothing = among.get(ORACLE), among.get(NOTHING)
    if oracle is not None:
        found["cost_over_oracle"] = (float(trial.executed_return.mean() / oracle.executed_return.mean()), "ratio")
    if oracle is not None and nothing is not None:
        gain = (trial.executed_return - nothing.executed_return).mean() / (
            oracle.executed_return - nothing.executed_return
        ).mean()
        found["gain_share"] = (float(gain), "share")
    if trial.plan is not None:
        found["exploitation_gap"] = (float(trial.gap.mean()), "m")
        found["gap_absolute"] = (float(trial.gap.abs().mean()), "m")
        found["relative_gap_median"] = (float((trial.gap.abs() / trial.executed_return.abs()).median()), "share")
        found["plan_seconds"] = (trial.plan.seconds, "s")
        most = worst(trial.gap.numpy())
        found |= {f"{name}_worst": (float(each[name][0][most].mean()), "share") for name in INVARIANTS if name in each}
    shape = roughness(trial.actions)
    found["torque_change"] = (float(shape["change"].mean()), "share")
    found["torque_fast"] = (float(shape["fast"].mean()), "share")
    new = novelty(trial.actions, _known_torques(), segment_len=min(10, task.horizon))
    found["torque_novelty"] = (float(new.mean()), "std")
    return found


@cache
def _known_torques() -> Tensor:
    """Torques like the training data's, to measure the novelty of others against."""
    return smooth_torques(1000, 100, generator=torch.Generator().manual_seed(7))


def tables(
    tasks: Sequence[Task], trials: Trials, run: Run, *, condition: str = OPEN, iteration: int | None = None
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of metrics/05_control.csv (one number per method) and of 05_control_rows.csv (one per target as well).

    iteration: of plans along the way; it stands in the column ``horizon``.
    """
    summary, per_target = [], []
    for task in tasks:
        horizon = task.horizon if iteration is None else iteration
        common = dict(
            env=task.env, sim=sim_of(task.env), task=task.name, horizon=horizon, condition=condition, seed=run.seed,
            scale=run.scale,
        )  # fmt: skip
        for name, trial in trials[task.env].items():
            model, prior, planner = name.split() if " " in name else ("none", "", name)
            method = dict(common, model=model, prior=prior, planner=planner)
            summary += [
                dict(method, metric=metric, value=value, unit=unit, n=len(task))
                for metric, (value, unit) in means(task, trial, trials[task.env], condition).items()
            ]
            per_target += [
                dict(method, metric=metric, value=float(f"{value:.7g}"), unit=unit, n=1, target=i)
                for metric, (values, unit) in numbers(task, trial, condition).items()
                if metric not in INVARIANTS[:2]
                for i, value in enumerate(values)
            ]
    return summary, per_target


def convergence(task: Task, plan: Plan, run: Run, **method: str) -> list[dict[str, Any]]:
    """Rows of 05_control_rows.csv that say how soon a long optimisation was nearly done (claim C15): for each target,
    the iterations until it promises 95 % of all that it gains. method: model, planner and prior."""
    common = dict(
        env=task.env, sim=sim_of(task.env), task=task.name, horizon=task.horizon, condition=OPEN, seed=run.seed,
        scale=run.scale, metric="iterations_to_95", unit="iterations", n=1,
    )  # fmt: skip
    return [dict(common, **method, value=value, target=i) for i, value in enumerate(iterations_to(plan.curve).tolist())]


def chosen(
    rows: Rows, *, env: str = "", condition: str = OPEN, models: Sequence[str] = (), planners: Sequence[str] = ()
) -> list[Row]:
    """The rows of an environment, a condition, some models and some planners; floors and oracles always are."""
    return [
        row for row in rows
        if row["condition"] == condition and env in ("", row["env"])
        and (row["model"] == "none" or not planners or row["planner"] in planners)
        and (row["model"] in ("none", "oracle") or not models or row["model"] in models)
    ]  # fmt: skip


def by_target(rows: Rows, metric: str) -> dict[str, np.ndarray]:
    """Rows with a ``target`` as arrays: label -> (targets,), means over the seeds there are."""
    found: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        if row["metric"] == metric:
            name = label(row["model"], row["planner"], row["prior"])
            found.setdefault(name, {}).setdefault(row["target"], []).append(row["value"])
    return {name: np.array([np.mean(each[i]) for i in sorted(each)]) for name, each in found.items()}


def returns(rows: Rows) -> dict[str, dict[str, np.ndarray | None]]:
    """What ``figures.figure6`` draws of one task: label -> true and predicted returns, from rows with a ``target``."""
    rows = list(rows)
    predicted = by_target(rows, "return_predicted")
    return {
        name: {"true": true, "predicted": predicted.get(name)} for name, true in by_target(rows, "return_true").items()
    }


def along_the_way(rows: Rows, env: str) -> dict[str, dict[str, np.ndarray]]:
    """What ``figures.along_the_way`` draws: label -> iterations, true and predicted mean returns (I,) each."""
    found: dict[str, dict[str, dict[int, list[float]]]] = {}
    words = {"return_true": "true", "return_predicted": "predicted"}
    for row in chosen(rows, env=env, condition=ALONG):
        if row["metric"] in words:
            line = found.setdefault(label(row["model"], row["planner"], row["prior"]), {})
            line.setdefault(words[row["metric"]], {}).setdefault(row["horizon"], []).append(row["value"])
    return {
        name: {"iterations": np.array(sorted(lines["true"]))}
        | {word: np.array([np.mean(line[i]) for i in sorted(line)]) for word, line in lines.items()}
        for name, lines in found.items()
    }


# Tables --------------------------------------------------------------------------------------------------------------

Method = tuple[str, str, str, str, int]  # environment, model, prior, planner, targets


def _methods(rows: Rows, condition: str) -> dict[Method, dict[str, float]]:
    """The numbers of each method under one condition, means over the seeds there are."""
    found: dict[Method, dict[str, list[float]]] = {}
    for row in rows:
        if row["condition"] == condition:
            method = (row["env"], row["model"], row["prior"], row["planner"], row["n"])
            found.setdefault(method, {}).setdefault(row["metric"], []).append(row["value"])
    return {method: {word: float(np.mean(values)) for word, values in own.items()} for method, own in found.items()}


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    text = [f"| {' | '.join(line)} |" for line in (head, *lines)]
    return "\n".join([text[0], "|---" * len(head) + "|", *text[1:]])


def _words(model: str, prior: str, planner: str) -> tuple[str, str]:
    """A method's model and what it plans over, as they are printed."""
    return (NAMES.get(planner, planner), "") if model == "none" else (NAMES.get(model, model), prior)


Column = tuple[str, Callable[[float], str]]


def _two(value: float) -> str:
    return f"{value:.2f}"


def _three(value: float) -> str:
    return f"{value:.3f}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


MAIN: dict[str, Column] = {
    "return_predicted": ("promised", _two), "return_true": ("earned", _two), "exploitation_gap": ("gap", _two),
    "relative_gap_median": ("median gap / earned", _percent), "cost_over_oracle": ("cost / oracle's", _three),
    "gain_share": ("share of oracle's gain", _two), "final_distance": ("final distance (m)", _three),
    "success": (f"within {TOLERANCE} m", _percent), "plan_seconds": ("seconds, all targets", lambda s: f"{s:.0f}"),
}  # fmt: skip
LOOP: dict[str, Column] = {
    "return_true": ("earned", _two), "final_distance": ("final distance (m)", _three),
    "success": (f"within {TOLERANCE} m", _percent),
}  # fmt: skip
SIGNS: dict[str, Column] = {
    "moves_untouched": ("moves untouched", _percent), "penetrates": ("arm inside object", _percent),
    "broken": ("either", _percent), "broken_worst": ("either, worst tenth", _percent),
    "torque_change": ("change of torque per step", _three), "torque_fast": ("power above 5 Hz", _percent),
    "torque_novelty": ("distance to training torques", _two),
}  # fmt: skip


def report(rows: Rows, *, planner: str = "cem") -> str:
    """Every model planned for by one planner, executed open loop, with floors and oracle: a Markdown table."""
    shown = chosen(rows, planners=[planner])
    columns = {metric: column for metric, column in MAIN.items() if any(row["metric"] == metric for row in shown)}
    return _table(
        ("environment", "model", "over", "n", *(title for title, _ in columns.values())),
        (
            (f"`{env}`", *_words(model, prior, by), str(n), *_cells(columns, own))
            for (env, model, prior, by, n), own in _methods(shown, OPEN).items()
        ),
    )


def _cells(columns: Mapping[str, Column], own: Mapping[str, float]) -> list[str]:
    return [spell(own[metric]) if metric in own else "" for metric, (_, spell) in columns.items()]


def by_planner(rows: Rows) -> str:
    """Model x planner x prior: the mean earned return, and in brackets the gap."""
    found = {key: own for key, own in _methods(rows, OPEN).items() if key[1] != "none"}
    planners = [word for word in ("adam", "adam+starts", "cem", "mppi") if any(key[3] == word for key in found)]
    lines: dict[tuple[str, str, str], dict[str, str]] = {}
    for (env, model, prior, planner, _), own in found.items():
        cell = f"{own['return_true']:.2f} ({own['exploitation_gap']:+.2f})"
        lines.setdefault((env, model, prior), {})[planner] = cell
    return _table(
        ("environment", "model", "over", *(pretty(word)[0] for word in planners)),
        (
            (f"`{env}`", *_words(model, prior, ""), *(cells.get(word, "") for word in planners))
            for (env, model, prior), cells in lines.items()
        ),
    )


def by_prior(rows: Rows) -> str:
    """What the prior changes, model by model and planner by planner: over codes minus over raw torques, paired by
    target, with half the 95 % t interval. rows: with a ``target``."""
    rows = [row for row in rows if row["condition"] == OPEN and row["model"] != "none"]
    lines: list[tuple[str, ...]] = []
    for env in dict.fromkeys(row["env"] for row in rows):
        here = chosen(rows, env=env)
        true, predicted = by_target(here, "return_true"), by_target(here, "return_predicted")
        for row in {(row["model"], row["planner"]): row for row in here}.values():
            codes, actions = (label(row["model"], row["planner"], prior) for prior in ("codes", "actions"))
            if codes in true and actions in true and len(true[codes]) == len(true[actions]):
                gaps = [np.abs(predicted[name] - true[name]) for name in (codes, actions)]
                cells = ["{:+.3f} ± {:.3f}".format(*interval(a - b)) for a, b in ((true[codes], true[actions]), gaps)]
                model, _ = _words(row["model"], "", "")
                lines.append((f"`{env}`", model, pretty(row["planner"])[0], str(len(true[codes])), *cells))
    return _table(("environment", "model", "planner", "n", "earned (m)", "size of the gap (m)"), lines)


def by_loop(rows: Rows) -> str:
    """Open loop beside closed loop, of the methods that were executed both ways."""
    rows = list(rows)
    before, after = _methods(rows, OPEN), _methods(rows, CLOSED)
    titles = [title for title, _ in LOOP.values()]
    return _table(
        ("environment", "model", "over", "n", *(f"{title}, {way}" for way in ("open", "closed") for title in titles)),
        (
            (f"`{key[0]}`", *_words(*key[1:4]), str(key[4]), *_cells(LOOP, before.get(key, {})), *_cells(LOOP, own))
            for key, own in after.items()
        ),
    )


def by_convergence(rows: Rows) -> str:
    """How many iterations planners took to 95 % of what they gain in the end, from rows with a ``target``."""
    found: dict[tuple[str, str, str, str], list[float]] = {}
    for row in rows:
        if row["metric"] == "iterations_to_95":
            method = (f"`{row['env']}`", *_words(row["model"], row["prior"], ""), pretty(row["planner"])[0])
            found.setdefault(method, []).append(row["value"])
    return _table(
        ("environment", "model", "over", "planner", "n", "median", "within 100", "within 150"),
        (
            (*method, str(len(values)), f"{np.median(values):.0f}",
             *(_percent(float(np.mean(np.array(values) <= bound))) for bound in (100, 150)))
            for method, values in found.items()
        ),
    )  # fmt: skip


def by_invariant(rows: Rows, *, planner: str = "cem") -> str:
    """Signs of exploitation: shares of predicted steps that break an invariant, and torques unlike the data's."""
    return _table(
        ("environment", "model", "over", *(title for title, _ in SIGNS.values())),
        (
            (f"`{env}`", *_words(model, prior, by), *_cells(SIGNS, own))
            for (env, model, prior, by, _), own in _methods(chosen(rows, planners=[planner]), OPEN).items()
        ),
    )


def bars(rows: Rows, model: str) -> dict[str, tuple[str, str, bool]]:
    """What planning with ``model`` over codes by CEM is to reach: what -> (bar, reached, whether it was).

    Baselines are the models of PAPER that are no segment models, over codes and over raw torques.
    """
    rows = [row for row in rows if row["planner"] == "cem"]
    reach, push = "tsm/Reacher-v0", "tsm/ReacherPush-v0"
    opened, closed = ({key[:3]: own for key, own in _methods(rows, way).items()} for way in (OPEN, CLOSED))
    near, far, again = opened[reach, model, "codes"], opened[push, model, "codes"], closed[push, model, "codes"]
    ours = (push, model, "codes")
    others = {key: own for key, own in opened.items() if key[0] == push and key[1] in PAPER and key != ours}
    gap = min(own["gap_absolute"] for key, own in others.items() if not key[1].startswith("tsm")) / 2
    best = max(others, key=lambda key: others[key]["return_true"])
    most, (_, rival, over) = others[best]["return_true"], best
    share = min(0.8, closed[push, "oracle", "codes"]["success"])
    low, high = "at most", "at least"
    found: dict[str, tuple[str, float, str, float, Callable[[float], str]]] = {
        "reach: cost over the oracle's": (low, 1.1, "", near["cost_over_oracle"], _three),
        "reach: median gap over earned": (low, 0.05, "", near["relative_gap_median"], _percent),
        "push: cost over the oracle's": (low, 1.15, "", far["cost_over_oracle"], _three),
        "push: mean size of the gap (m)": (low, gap, ", half of any baseline's", far["gap_absolute"], _three),
        "push: earned (m)": (high, most, f" of {NAMES[rival]} over {over}, the best other", far["return_true"], _three),
        f"push, closed loop: within {TOLERANCE} m": (high, share, ", the oracle's or 80 %", again["success"], _percent),
        "push: predicted steps that break an invariant": (low, 0.05, "", far["broken"], _percent),
    }  # fmt: skip
    return {
        what: (f"{word} {spell(bar)}{why}", spell(value), value <= bar if word == low else value >= bar)
        for what, (word, bar, why, value, spell) in found.items()
    }


def verdicts(found: Mapping[str, tuple[str, str, bool]]) -> str:
    """``bars`` as a Markdown table."""
    lines = ((what, bar, reached, "yes" if met else "no") for what, (bar, reached, met) in found.items())
    return _table(("what", "bar", "measured", "reached"), lines)


def by_gradient(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows of ``gradient_snr`` as a Markdown table: the geometric mean over starts, and by how much that over codes is
    larger than that over torques, with the 95 % t interval over starts (means over the seeds there are)."""
    found: dict[tuple[str, str], dict[str, dict[int, list[float]]]] = {}
    for row in rows:
        if row["metric"] == "gradient_snr":
            starts = found.setdefault((row["env"], row["model"]), {}).setdefault(row["prior"], {})
            starts.setdefault(row["target"], []).append(math.log(row["value"]))
    lines = ["| environment | model | n | over codes | over torques | codes / torques |", "|---" * 6 + "|"]
    for (env, model), ways in found.items():
        codes, actions = (np.array([np.mean(ways[way][i]) for i in sorted(ways[way])]) for way in ("codes", "actions"))
        mean, half = interval(codes - actions)
        cells = [f"{np.exp(value):.3g}" for value in (codes.mean(), actions.mean(), mean, mean - half, mean + half)]
        ratio = f"{cells[2]} [{cells[3]}, {cells[4]}]"
        lines.append(f"| `{env}` | {NAMES.get(model, model)} | {len(codes)} | {cells[0]} | {cells[1]} | {ratio} |")
    return "\n".join(lines)
