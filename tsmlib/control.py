"""A task posed, planned for and executed: what a plan promised and what the arm then did (section 5.3.2, figure 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

import tsmlib.envs  # noqa: F401 - registers the environments
from tsmlib import figures, rewards
from tsmlib.collect import collect, once, smooth_torques
from tsmlib.envs.render import draw_scene
from tsmlib.rewards import Reward
from tsmlib.runs import Run
from tsmlib.trajectory import Segment, initial_past
from tsmlib.trajopt import Plan

TOLERANCE = 0.03  # metres: a trial that ends within it is a success


@dataclass(frozen=True)
class Task:
    """B instances of one task in one environment. start (B, dx), target (B, 2) in metres, horizon in steps."""

    name: str  # reach or push
    env: str
    start: np.ndarray
    target: Tensor
    horizon: int = 50

    def __post_init__(self) -> None:
        if self.name not in ("reach", "push"):
            raise ValueError(f"task is {self.name!r}, expected 'reach' or 'push'")
        if self.name == "push" and self.start.shape[1] < 10:
            raise ValueError(f"there is nothing to push in {self.env}; its task is 'reach'")
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}, expected a positive number of steps")

    def __len__(self) -> int:
        return len(self.start)

    @property
    def reward(self) -> Reward:
        """The task's reward, one target per instance."""
        return (rewards.reach if self.name == "reach" else rewards.push)(self.target)

    @property
    def position(self) -> slice:
        """What has to arrive: the fingertip or the object."""
        return rewards.TIP if self.name == "reach" else rewards.BLOCK

    def past(self, past_len: int) -> Segment:
        """The past before the first step: x_0 repeated, zero actions."""
        return initial_past(torch.from_numpy(self.start).float(), past_len, 2)

    def take(self, n: int) -> Task:
        """The first ``n`` instances."""
        return Task(self.name, self.env, self.start[:n], self.target[:n], self.horizon)


@dataclass(frozen=True)
class Trial:
    """Actions executed open loop in the true simulator.

    actions (B, T, du); states (B, T + 1, dx) from the start on; true (B,): undiscounted return executed;
    final_distance (B,): metres; plan: where the actions came from, with the predicted return, if from a plan.
    """

    actions: Tensor
    states: Tensor
    true: Tensor
    final_distance: Tensor
    plan: Plan | None = None

    @property
    def gap(self) -> Tensor:
        """Exploitation gap (B,): predicted minus true return."""
        if self.plan is None:
            raise ValueError("these actions were not planned, so nothing was predicted for them")
        return self.plan.predicted - self.true


def execute(task: Task, plan: Plan | Tensor) -> Trial:
    """Run a plan, or plain actions (B, T, du), open loop from the task's starts."""
    actions = plan.actions if isinstance(plan, Plan) else plan
    env = gymnasium.make_vec(task.env, num_envs=len(task))
    seen = collect(env, once(actions), horizon=actions.shape[1], states=task.start)
    env.close()
    states = torch.from_numpy(seen.states)
    return Trial(
        actions=actions,
        states=states,
        true=task.reward(states[:, 1:], actions).sum(-1),
        final_distance=rewards.final_distance(states, task.target, task.position),
        plan=plan if isinstance(plan, Plan) else None,
    )


def zero_torques(task: Task) -> Tensor:
    """No torque at all: the floor below which a plan does harm. (B, T, du)."""
    return torch.zeros(len(task), task.horizon, 2)


def random_torques(task: Task, *, seed: int = 0) -> Tensor:
    """Torques like the training data's. (B, T, du)."""
    return smooth_torques(len(task), task.horizon, generator=torch.Generator().manual_seed(seed))


def sim_of(env: str) -> str:
    """The simulator behind an environment id, as the tables name it."""
    return "pymunk" if "Pymunk" in env else "mujoco"


def label(model: str, planner: str, prior: str) -> str:
    """A method in one line, as figures name it: ``tsm codes cem``, ``zero``."""
    return planner if model == "none" else f"{model} {prior} {planner}"


# Tables --------------------------------------------------------------------------------------------------------------


def numbers(trial: Trial) -> dict[str, tuple[Tensor, str]]:
    """What a trial measured for each target: metric -> values (B,) and unit."""
    found = {"return_true": (trial.true, "m"), "final_distance": (trial.final_distance, "m")}
    if trial.plan is not None:
        found |= {"return_predicted": (trial.plan.predicted, "m"), "exploitation_gap": (trial.gap, "m")}
    return found


def means(trial: Trial) -> dict[str, tuple[float, str]]:
    """Means over the targets, and what only makes sense over all of them: metric -> value and unit."""
    found = {metric: (float(values.mean()), unit) for metric, (values, unit) in numbers(trial).items()}
    found["success"] = (float((trial.final_distance <= TOLERANCE).float().mean()), "share")
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
            env=task.env, sim="pymunk" if "Pymunk" in task.env else "mujoco", task=task.name, horizon=task.horizon,
            condition="clean", seed=run.seed, scale=run.scale,
        )  # fmt: skip
        for name, trial in trials[task.env].items():
            model, prior, planner = name.split() if " " in name else ("none", "", name)
            method = dict(common, model=model, prior=prior, planner=planner)
            summary += [
                dict(method, metric=metric, value=value, unit=unit, n=len(task))
                for metric, (value, unit) in means(trial).items()
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
        "relative_gap_median": "median gap / earned", "final_distance": "final distance (m)",
        "success": f"within {TOLERANCE} m", "plan_seconds": "seconds",
    }  # fmt: skip
    lines = ["| environment | method | n | " + " | ".join(columns.values()) + " |", "|---" * (len(columns) + 3) + "|"]
    methods: dict[tuple[str, str, int], dict[str, float]] = {}
    for row in rows:
        name = label(row["model"], row["planner"], row["prior"])
        methods.setdefault((row["env"], name, row["n"]), {})[row["metric"]] = row["value"]
    for (env, name, n), values in methods.items():
        cells = [f"{values[metric]:.3f}" if metric in values else "" for metric in columns]
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
