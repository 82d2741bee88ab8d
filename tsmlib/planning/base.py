"""Plans, and the protocols of predictors, search spaces and planners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from tsmlib.models.base import Model
from tsmlib.rewards import Reward
from tsmlib.trajectory import Segment

Predictor = Callable[[Tensor], Tensor]  # actions (C, B, T, du) -> sampled states (S, C, B, T, dx)


class Judge(Protocol):
    """What candidates are judged by: ``model_predictor``, the mode; ``expected_predictor``, mode and samples; ..."""

    def __call__(self, model: Model, past: Segment, /, *, seed: int) -> Predictor:
        """The predictor through ``model`` from ``past`` (B, L, .); what is drawn is a function of ``seed``."""
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
        """What is left when ``steps`` actions of a plan (B, *shape) are done: the space, and the plan in it."""
        ...


@dataclass(frozen=True, repr=False)
class Plan:
    """The best actions found for each of B targets.

    actions (B, T, du); parameters (B, *shape) they decode from; states (S, B, T, dx) predicted for them;
    predicted_return (B,): expected and undiscounted; curve (iterations + 1, B): predicted return of the best so far,
    from the start on, -inf where none was finite yet; seconds; trace (iterations + 1, B, *shape): the parameters of the
    best so far, see ``plan_at``.
    """

    actions: Tensor
    parameters: Tensor
    states: Tensor
    predicted_return: Tensor
    curve: Tensor
    seconds: float
    trace: Tensor | None = None

    def __repr__(self) -> str:
        n, steps = self.actions.shape[:2]
        return f"Plan({n} targets, {steps} steps, mean predicted return {float(self.predicted_return.mean()):.4g})"


class Planner(Protocol):
    """``adam``, ``cem`` or ``mppi``, with its settings bound by ``functools.partial``."""

    def __call__(
        self, predict: Predictor, reward: Reward, space: SearchSpace, start: Tensor | int, /
    ) -> Plan:
        """Plan from parameters ``start`` (C, B, *shape), or for ``start`` targets from zero. Never worse than it."""
        ...
