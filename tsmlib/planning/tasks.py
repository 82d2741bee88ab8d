"""Tasks: frozen starts, targets and reward of an environment, and reference torques."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tsmlib import rewards
from tsmlib.collection import smooth_torques
from tsmlib.envs.geometry import BLOCK_RADIUS, LINK_LENGTHS, WALL
from tsmlib.envs.spec import EnvSpec
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment, initial_past

HORIZON = {"reach": 50, "push": 100}  # steps of 0.02 s
TOLERANCE = {"reach": 0.03, "push": 0.05}  # metres: a trial that ends within it is a success


@dataclass(frozen=True)
class Task:
    """B instances of one task in one environment. start (B, dx), target (B, 2) in metres, horizon in steps.

    reward_for: targets -> reward; position: what has to arrive, fingertip or object; tolerance: metres, of a success.
    ``standard`` gives the paper's, ``with_reward`` one of one's own. ValueError where a target is out of reach, or the
    reward is not one number per step; FloatingPointError where it is NaN.
    """

    name: str
    env: str
    start: np.ndarray
    target: Tensor
    reward_for: Callable[[Tensor], Reward]
    position: slice
    horizon: int = HORIZON["reach"]
    tolerance: float = TOLERANCE["reach"]

    @classmethod
    def standard(cls, env: str, start: np.ndarray, target: Tensor) -> Task:
        """The paper's task of an environment: to push the object to the target, or to reach it where there is none."""
        if EnvSpec.parse(env).task == "push":
            return cls("push", env, start, target, rewards.push, rewards.BLOCK, HORIZON["push"], TOLERANCE["push"])
        return cls("reach", env, start, target, rewards.reach, rewards.TIP)

    def __post_init__(self) -> None:
        if self.position.stop > self.start.shape[1]:
            raise ValueError(f"there is nothing to push in {self.env}; its task is 'reach'")
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}, expected a positive number of steps")
        if self.target.shape != (len(self), 2):
            raise ValueError(f"target is {tuple(self.target.shape)}, expected ({len(self)}, 2): one per start")
        self._check_reach()
        # Standing still, in the shape in which planners ask.
        states = torch.from_numpy(self.start).float()[:, None].expand(2, 1, -1, self.horizon, -1)
        found = rewarded(self.reward, states, states.new_zeros(1, len(self), self.horizon, 2))
        if not torch.isfinite(found).all():
            raise ValueError(f"the reward of task {self.name!r} is infinite for an arm that stands still")

    def __len__(self) -> int:
        return len(self.start)

    @property
    def reward(self) -> Reward:
        """The task's reward, one target per instance."""
        return self.reward_for(self.target)

    @property
    def is_standard(self) -> bool:
        """Whether the reward is the paper's."""
        return self.reward_for in (rewards.reach, rewards.push)

    def with_reward(
        self, name: str, reward: Reward, *, target: Tensor | None = None, horizon: int | None = None
    ) -> Task:
        """A task of one's own from these starts, in which the same has to arrive.

        reward: any torch function of states (..., B, T, dx) and actions (..., B, T, du) that gives one number per
        step, (..., B, T), differentiable if it is to be planned for with Adam. It always sees the whole episode, so
        that it may depend on the time. target (2,) or (B, 2): where it should end, for final_distance and pictures.
        """
        goal = self.target if target is None else target.float().expand(len(self), 2)
        return replace(self, name=name, target=goal, reward_for=lambda _: reward, horizon=horizon or self.horizon)

    def _check_reach(self) -> None:
        if self.position == rewards.TIP:
            within, what = self.target.norm(dim=1) <= sum(LINK_LENGTHS) + 1e-6, "fingertip"
            limit = f"{sum(LINK_LENGTHS):g} m from the shoulder"
        else:
            within, what = self.target.abs().amax(1) <= WALL - BLOCK_RADIUS + 1e-6, "object"
            limit = f"{WALL - BLOCK_RADIUS:g} m along x and y, where the walls are"
        if not within.all():
            i = int((~within).nonzero()[0])
            raise ValueError(
                f"target {i} at ({self.target[i, 0]:.3f}, {self.target[i, 1]:.3f}) m is out of reach: "
                f"the {what} gets as far as {limit}"
            )

    def past(self, past_len: int) -> Segment:
        """The past before the first step: x_0 repeated, zero actions."""
        return initial_past(torch.from_numpy(self.start).float(), past_len, 2)

    def take(self, n: int) -> Task:
        """The first ``n`` instances; ValueError if there are not as many."""
        if not 1 <= n <= len(self):
            raise ValueError(f"{n} targets of {self.env} asked for; choose a number from 1 to {len(self)}")
        return replace(self, start=self.start[:n], target=self.target[:n])

    def times(self, n: int) -> Task:
        """All instances n times over, for as many copies of a policy."""
        return replace(self, start=np.tile(self.start, (n, 1)), target=self.target.repeat(n, 1))


def zero_torques(task: Task) -> Tensor:
    """No torque at all: the floor below which a plan does harm. (B, T, du)."""
    return torch.zeros(len(task), task.horizon, 2)


def random_torques(task: Task, *, seed: int = 0) -> Tensor:
    """Torques like the training data's. (B, T, du)."""
    return smooth_torques(len(task), task.horizon, generator=torch.Generator().manual_seed(seed))
