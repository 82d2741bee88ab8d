"""What trials are worth: the tables of 05_control, and pictures of plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from tsmlib import figures
from tsmlib.control import TOLERANCE, Task, Trial, label, sim_of
from tsmlib.envs.render import draw_scene
from tsmlib.runs import Run

ORACLE, NOTHING = label("oracle", "cem", "codes"), label("none", "zero", "")  # what earned returns are held against


def numbers(trial: Trial) -> dict[str, tuple[Tensor, str]]:
    """What a trial measured for each target: metric -> values (B,) and unit."""
    found = {"return_true": (trial.true, "m"), "final_distance": (trial.final_distance, "m")}
    if trial.plan is not None:
        found |= {"return_predicted": (trial.plan.predicted, "m"), "exploitation_gap": (trial.gap, "m")}
    return found


def means(trial: Trial, among: Mapping[str, Trial]) -> dict[str, tuple[float, str]]:
    """Means over the targets, and what only makes sense over all of them: metric -> value and unit.

    among: all methods' trials of the task. With the oracle over codes in it, ``cost_over_oracle`` is the mean cost over
    the oracle's; with zero torque as well, ``gain_share`` is the part of the oracle's gain over doing nothing.
    """
    found = {metric: (float(values.mean()), unit) for metric, (values, unit) in numbers(trial).items()}
    found["success"] = (float((trial.final_distance <= TOLERANCE).float().mean()), "share")
    oracle, nothing = among.get(ORACLE), among.get(NOTHING)
    if oracle is not None:
        found["cost_over_oracle"] = (float(trial.true.mean() / oracle.true.mean()), "ratio")
    if oracle is not None and nothing is not None:
        gain = (trial.true - nothing.true).mean() / (oracle.true - nothing.true).mean()
        found["gain_share"] = (float(gain), "share")
    if trial.plan is not None:
        found["relative_gap_median"] = (float((trial.gap.abs() / trial.true.abs()).median()), "share")
        found["plan_seconds"] = (trial.plan.seconds, "s")
    return found


Trials = Mapping[str, Mapping[str, Trial]]  # environment -> method's label -> trial


def tables(tasks: Sequence[Task], trials: Trials, run: Run) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of metrics/05_control.csv (one number per method) and of 05_control_rows.csv (one per target as well)."""
    summary, per_target = [], []
    for task in tasks:
        common = dict(
            env=task.env, sim=sim_of(task.env), task=task.name, horizon=task.horizon,
            condition="clean", seed=run.seed, scale=run.scale,
        )  # fmt: skip
        for name, trial in trials[task.env].items():
            model, prior, planner = name.split() if " " in name else ("none", "", name)
            method = dict(common, model=model, prior=prior, planner=planner)
            summary += [
                dict(method, metric=metric, value=value, unit=unit, n=len(task))
                for metric, (value, unit) in means(trial, trials[task.env]).items()
            ]
            per_target += [
                dict(method, metric=metric, value=float(value), unit=unit, n=1, target=i)
                for metric, (values, unit) in numbers(trial).items()
                for i, value in enumerate(values)
            ]
    return summary, per_target


def report(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of 05_control.csv as a Markdown table, one line per method."""
    columns = {
        "return_predicted": "promised", "return_true": "earned", "exploitation_gap": "gap",
        "relative_gap_median": "median gap / earned", "cost_over_oracle": "cost / oracle's",
        "gain_share": "share of oracle's gain", "final_distance": "final distance (m)",
        "success": f"within {TOLERANCE} m", "plan_seconds": "seconds, all targets",
    }  # fmt: skip
    shown = [metric for metric in columns if any(row["metric"] == metric for row in rows)]
    lines = [f"| environment | method | n | {' | '.join(columns[m] for m in shown)} |", "|---" * (len(shown) + 3) + "|"]
    methods: dict[tuple[str, str, int], dict[str, float]] = {}
    for row in rows:
        name = label(row["model"], row["planner"], row["prior"])
        methods.setdefault((row["env"], name, row["n"]), {})[row["metric"]] = row["value"]
    for (env, name, n), values in methods.items():
        cells = [f"{values[metric]:.3f}" if metric in values else "" for metric in shown]
        lines.append(f"| `{env}` | {name} | {n} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


# Pictures ------------------------------------------------------------------------------------------------------------


def returns(trials: Mapping[str, Trial]) -> dict[str, dict[str, np.ndarray | None]]:
    """The arrays that figures draw: label -> true and predicted returns (B,)."""
    return {
        name: {"true": t.true.numpy(), "predicted": None if t.plan is None else t.plan.predicted.numpy()}
        for name, t in trials.items()
    }


def film(task: Task, trial: Trial, target: int) -> np.ndarray:
    """Frames (T, height, width, 3) of one target: what the model dreamt beside what the arm did."""
    dreamt, done = _dreamt_and_done(trial, target)
    env: Any = gymnasium.make_vec(task.env, num_envs=1).unwrapped
    goal = task.target[target].numpy()
    left, right = (np.stack([env.image(state, goal) for state in states]) for states in (dreamt, done))
    env.close()
    return figures.side_by_side(left, right, ("what the model dreamt", "what the arm did"))


def strip(task: Task, trial: Trial, target: int, *, frames: int = 6) -> Figure:
    """The same as a filmstrip."""
    dreamt, done = _dreamt_and_done(trial, target)
    times = [round(step) for step in np.linspace(0, len(done) - 1, frames)]
    return figures.plan_strip(
        lambda ax, state, goal: draw_scene(ax, state, task.env, goal), dreamt, done, task.target[target].numpy(), times
    )


def _dreamt_and_done(trial: Trial, target: int) -> tuple[np.ndarray, np.ndarray]:
    if trial.plan is None:
        raise ValueError("these actions were not planned, so there is nothing that a model dreamt")
    return trial.plan.states[0, target].numpy(), trial.states[target, 1:].numpy()
