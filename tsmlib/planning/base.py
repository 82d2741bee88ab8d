"""Plans, and the protocols of predictors, search spaces and planners.

Letters in shapes: B targets planned for at once, C candidates for each, S model samples, T horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from tsmlib.models.base import Model
from tsmlib.rewards import Reward
from tsmlib.trajectory import Robot, Segment

Predictor = Callable[[Tensor], Tensor]  # actions (C, B, T, du) -> sampled states (S, C, B, T, dx)


class Judge(Protocol):
    """Makes what candidates are judged by: ``model_predictor``, ``expected_predictor``, ..."""

    def __call__(self, model: Model, past: Segment, /, *, seed: int) -> Predictor:
        """The predictor through ``model`` from ``past`` (B, L, .); ``seed`` fixes what it draws."""
        ...


class SearchSpace(Protocol):
    """What a planner searches: parameters that decode to bounded actions."""

    shape: tuple[int, ...]  # of one target's parameters
    scale: float  # standard deviation of parameters whose actions are like the training data's

    def decode(self, parameters: Tensor) -> Tensor:
        """(C, B, *shape) -> actions (C, B, T, du) in [-1, 1]."""
        ...

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        """Perturbations (n, n_targets, *shape) of unit variance."""
        ...

    def after(self, parameters: Tensor, steps: int) -> tuple[SearchSpace, Tensor]:
        """The space of the rest after ``steps`` actions of a plan (B, *shape), and the rest."""
        ...


@dataclass(frozen=True, repr=False)
class Plan:
    """The best actions found for each of B targets.

    Attributes:
        actions: (B, T, du) in [-1, 1].
        parameters: (B, *shape) in the search space, which decode to the actions.
        states: (S, B, T, dx) predicted for the actions, physical units.
        predicted_return: (B,), undiscounted, mean over the samples.
        curve: (iterations + 1, B), what the best so far was judged by, from the start on; -inf
            where no return was finite yet.
        seconds: of the planning, on the wall.
        start: (B, dx), the states that the plan begins in; None where the predictor did not say.
            ``execute`` refuses the plan for other starts.
        robot: that the predictor is of; None where it did not say.
    """

    actions: Tensor
    parameters: Tensor
    states: Tensor
    predicted_return: Tensor
    curve: Tensor
    seconds: float
    start: Tensor | None = None
    robot: Robot | None = None

    def __repr__(self) -> str:
        n, steps = self.actions.shape[:2]
        value = float(self.predicted_return.mean())
        return f"Plan({n} targets, {steps} steps, mean predicted return {value:.4g})"


class Planner(Protocol):
    """``adam``, ``cem`` or ``mppi``, with its settings bound by ``functools.partial``."""

    def __call__(
        self, predict: Predictor, reward: Reward, space: SearchSpace, start: Tensor | int, /
    ) -> Plan:
        """Plan from parameters ``start`` (C, B, *shape), or for ``start`` targets from zero.

        The plan is never worse than its start.
        """
        ...
