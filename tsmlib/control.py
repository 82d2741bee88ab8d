"""A task posed, planned for and executed: what a plan promised and what the arm then did (section 5.3.2, figure 6)."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
from torch import Tensor

import tsmlib.envs  # noqa: F401 - registers the environments
from tsmlib import rewards
from tsmlib.collect import Controller, collect, once, smooth_torques
from tsmlib.rewards import Reward
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
        """The first ``n`` instances; ValueError if there are not as many."""
        if not 1 <= n <= len(self):
            raise ValueError(f"{n} targets of {self.env} asked for; choose a number from 1 to {len(self)}")
        return Task(self.name, self.env, self.start[:n], self.target[:n], self.horizon)

    def times(self, n: int) -> Task:
        """All instances n times over, for as many copies of a policy."""
        return Task(self.name, self.env, np.tile(self.start, (n, 1)), self.target.repeat(n, 1), self.horizon)


@dataclass(frozen=True)
class Trial:
    """Actions executed in the true simulator.

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


def execute(task: Task, plan: Plan | Tensor | Controller) -> Trial:
    """Run a plan, or plain actions (B, T, du), open loop from the task's starts; or a controller, a policy say."""
    actions = plan.actions if isinstance(plan, Plan) else plan
    env = gymnasium.make_vec(task.env, num_envs=len(task))
    if isinstance(actions, Tensor):
        seen = collect(env, once(actions), horizon=actions.shape[1], states=task.start)
    else:
        seen = collect(env, actions, horizon=task.horizon, states=task.start)
        actions = torch.from_numpy(seen.actions)
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
