"""Features: angles as cosine and sine, everything standardised by training statistics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self, cast

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.models.config import Configured, weights_from
from tsmlib.storage.files import Json
from tsmlib.trajectory import Trajectories

ROUNDING = 8 * float(np.finfo(np.float32).eps)  # of a value, by which it may vary and be constant


class Features(nn.Module):
    """Physical states as networks and scores see them: angles as cosine and sine, everything standardised.

    The statistics come from training data by ``fit`` and travel with the model. A state dimension that never changes
    within an episode (the obstacle) is an input only: its increment is exactly zero and ``scored`` leaves it out. One
    that grows evenly (a clock) has the size of its steps in place of their deviation, which is none.
    """

    mean: Tensor
    std: Tensor
    step_std: Tensor

    def __init__(self, state_dim: int, angles: tuple[int, ...]) -> None:
        super().__init__()
        self.angles = list(angles)
        self.others = [d for d in range(state_dim) if d not in angles]
        self.dim = state_dim + len(angles)
        self._settled: tuple[slice | Tensor, slice | Tensor] | None = None
        self._parts: tuple[slice | Tensor | list[int], ...] = (
            _columns(self.angles),
            _columns(self.others),
        )
        self.register_buffer("mean", torch.zeros(self.dim))
        self.register_buffer("std", torch.ones(self.dim))
        self.register_buffer(
            "step_std", torch.zeros(state_dim)
        )  # of x_{t+1} - x_t, physical units; 0 until fitted

    def fit(self, data: Trajectories | Tensor) -> Features:
        """Take the statistics of training data, or of states (N, T + 1, dx), in float64.

        What changes by no more than the rounding of float32 at its size does not change; so neither
        units nor offsets decide what moves.
        """
        if isinstance(data, Tensor):
            rows, lengths = data.detach().cpu().flatten(0, 1), np.full(len(data), data.shape[1])
        else:
            rows, lengths = torch.from_numpy(data.flat_states), data.steps + 1
        ends = np.cumsum(lengths)
        states = rows.double()
        raw = self._raw(states)
        self.mean.copy_(raw.mean(0))
        std = raw.std(0)
        varies = raw.amax(0) - raw.amin(0) > ROUNDING * raw.abs().amax(0)
        self.std.copy_(torch.where(varies, std, torch.ones_like(std)))
        steps = torch.from_numpy(np.delete(states.diff(dim=0).numpy(), ends[:-1] - 1, axis=0))
        step_std, step_rms = steps.std(0), steps.square().mean(0).sqrt()
        step_std = torch.where(
            step_std > 1e-3 * step_rms, step_std, step_rms
        )  # a clock's are alike
        high, low = (
            edge.reduceat(states.numpy(), ends - lengths) for edge in (np.maximum, np.minimum)
        )
        within = torch.from_numpy((high - low).max(0))
        self.step_std.copy_(step_std * (within > ROUNDING * states.abs().amax(0)))
        return self

    def require_states(self, data: Trajectories, expected: str) -> None:
        """ValueError where the states of ``data`` have other dimensions or angles. expected: ends the message."""
        states = data.robot.state_dim
        if len(self.step_std) != states or self.angles != list(data.angles):
            raise ValueError(
                f"the model's states have {len(self.step_std)} dimensions with angles {self.angles}, those of "
                f"{data.env} {states} with angles {list(data.angles)}; expected {expected}"
            )

    @property
    def fitted(self) -> bool:
        """Whether there are statistics: data in which nothing moves have none. What is settled has them."""
        return self._settled is not None or bool(self.step_std.any())

    @property
    def moving(self) -> Tensor:
        """(dx,) bool: state dimensions that change within an episode."""
        return self.step_std > 0

    @property
    def scored(self) -> Tensor:
        """(dim,) bool: features that change within an episode."""
        moving = self.moving
        return torch.cat([moving[self.angles], moving[self.angles], moving[self.others]])

    def settle(self) -> None:
        """Fix which columns change, and indices on the device: within ``torch.func`` and CUDA graphs no value can be
        looked at or brought there. After another ``fit`` call it again. ValueError without statistics."""
        if not self.fitted:
            raise ValueError("these features have no statistics of data; call fit first")

        def fixed(index: list[int]) -> slice | Tensor:
            at = _columns(index)
            return (
                at
                if isinstance(at, slice)
                else torch.tensor(at, dtype=torch.long).to(self.std.device)
            )

        moving, scored = (some.nonzero()[:, 0].tolist() for some in (self.moving, self.scored))
        self._settled = fixed(moving), fixed(scored)
        self._parts = fixed(self.angles), fixed(self.others)

    def forward(self, states: Tensor) -> Tensor:
        """(..., dx) -> (..., dim): cosines, sines, the rest; zero mean and unit variance on the training data."""
        return (self._raw(states) - self.mean) / self.std

    def difference(self, predicted: Tensor, true: Tensor) -> Tensor:
        """(..., dx) twice -> the difference of their features that change within an episode, standardised."""
        difference = self(predicted) - self(true)
        if self._settled:
            return difference[..., self._settled[1]]
        scored = self.scored
        return difference if scored.all() else difference[..., scored]

    def increments(self, predicted: Tensor, true: Tensor) -> Tensor:
        """(..., dx) twice -> the difference of the dimensions that change, in standard deviations of one step."""
        moving = self._moving_columns()
        return (predicted - true)[..., moving] / self.step_std[moving]

    def moving_part(self, values: Tensor) -> Tensor:
        """(..., dx) -> those of the dimensions that change."""
        return values[..., self._moving_columns()]

    def _moving_columns(self) -> slice | Tensor:
        if self._settled:
            return self._settled[0]
        moving = self.moving
        return slice(None) if moving.all() else moving

    def _raw(self, states: Tensor) -> Tensor:
        angles, others = (states[..., part] for part in self._parts)
        return torch.cat([angles.cos(), angles.sin(), others], dim=-1)


class Featured:
    """A model of states, made for its training data."""

    features: Features

    @classmethod
    def for_data(cls, data: Trajectories, *, seed: int = 0, **options: Json) -> Self:
        """The model of ``data`` as training starts: its sizes, angles and statistics, and weights drawn from ``seed``.

        options: those of the constructor.
        """
        make = cast(Callable[..., Self], cls)
        with weights_from(seed):
            model = make(data.robot.state_dim, data.robot.action_dim, angles=data.angles, **options)
        model.features.fit(data)
        return model


def _columns(index: list[int]) -> slice | list[int]:
    """An index of columns, as a slice where they lie side by side: a view, and no scattered gradient."""
    side_by_side = bool(index) and index == list(range(index[0], index[-1] + 1))
    return slice(index[0], index[-1] + 1) if side_by_side else index


def require_robot(model: object, data: Trajectories, expected: str) -> None:
    """ValueError where a model's states or actions are not those of ``data``, as far as it knows its own."""
    features = getattr(model, "features", None)
    if isinstance(features, Features):
        features.require_states(data, expected)
    known = model.config().get("action_dim") if isinstance(model, Configured) else None
    if known is not None and known != data.robot.action_dim:
        raise ValueError(
            f"the model's actions have {known} dimensions, those of {data.env} {data.robot.action_dim}; "
            f"expected {expected}"
        )
