"""Features: angles as cosine and sine, everything standardised by training statistics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.checks import as_tensor, require_counts
from tsmlib.trajectory import Trajectories

ROUNDING = 8 * float(np.finfo(np.float32).eps)  # of a value, by which a constant may vary


class Features(nn.Module):
    """Physical states as networks and scores see them: angles as cosine and sine, all standardised.

    The statistics come from training data by ``fit`` and travel with the model. A state dimension
    that never changes within an episode (the obstacle) is an input only: its increment is exactly
    zero and ``scored`` leaves it out. One that grows evenly (a clock) has the size of its steps in
    place of their deviation, which is none.

    Args:
        state_dim: dx, dimensions of a state.
        angles: indices of the dimensions that are angles in radians.
    """

    mean: Tensor
    std: Tensor
    step_std: Tensor

    def __init__(self, state_dim: int, angles: Sequence[int] = ()) -> None:
        super().__init__()
        require_counts(state_dim=state_dim)
        known = range(state_dim)
        listed = list(angles) if isinstance(angles, Sequence) else [None]
        self.angles = [d for d in listed if type(d) is int and d in known]
        if len(set(self.angles)) < len(listed):
            raise ValueError(
                f"angles is {angles!r:.80}; expected some of the state dimensions 0 to "
                f"{state_dim - 1}, each once"
            )
        self.others = [d for d in known if d not in self.angles]
        self.dim = state_dim + len(self.angles)
        self._parts = _columns(self.angles), _columns(self.others)
        self.register_buffer("mean", torch.zeros(self.dim))
        self.register_buffer("std", torch.ones(self.dim))
        # Of x_{t+1} - x_t in physical units; 0 until fitted.
        self.register_buffer("step_std", torch.zeros(state_dim))

    def fit(self, data: Trajectories | Tensor) -> Features:
        """Take the statistics of training data, in float64.

        What changes by no more than the rounding of float32 at its size does not change, so that
        neither units nor offsets decide what moves.

        Args:
            data: episodes, or their states (N, T + 1, dx) alone.

        Returns:
            These features.
        """
        if isinstance(data, Trajectories):
            if data.robot.state_dim != len(self.step_std):
                raise ValueError(
                    f"data has {data.robot.state_dim} state dimensions; expected "
                    f"{len(self.step_std)}"
                )
            rows, lengths = torch.from_numpy(data.flat_states), data.steps + 1
        else:
            rows = as_tensor("data", data, ("N", "T + 1", len(self.step_std))).detach().cpu()
            lengths = np.full(len(rows), rows.shape[1])
            rows = rows.flatten(0, 1)
        begins, states = np.cumsum(lengths) - lengths, rows.double()
        raw = self._raw(states)
        varies = raw.amax(0) - raw.amin(0) > ROUNDING * raw.abs().amax(0)
        self.mean.copy_(raw.mean(0))
        self.std.copy_(raw.std(0).where(varies, 1.0))
        steps = torch.from_numpy(np.delete(states.diff(dim=0).numpy(), begins[1:] - 1, axis=0))
        step_std, step_rms = steps.std(0), steps.square().mean(0).sqrt()
        step_std = step_std.where(step_std > 1e-3 * step_rms, step_rms)  # a clock's are alike
        edges = (edge.reduceat(states.numpy(), begins) for edge in (np.maximum, np.minimum))
        within = torch.from_numpy(np.subtract(*edges).max(0))
        self.step_std.copy_(step_std * (within > ROUNDING * states.abs().amax(0)))
        return self

    @property
    def fitted(self) -> bool:
        """Whether there are statistics: data in which nothing moves have none."""
        return bool(self.step_std.any())

    @property
    def moving(self) -> Tensor:
        """(dx,) bool: state dimensions that change within an episode."""
        return self.step_std > 0

    @property
    def scored(self) -> Tensor:
        """(dim,) bool: features that change within an episode."""
        moving = self.moving
        return torch.cat([moving[self.angles], moving[self.angles], moving[self.others]])

    def forward(self, states: Tensor) -> Tensor:
        """(..., dx) -> (..., dim): cosines, sines, the rest; of mean 0, variance 1 in training."""
        return (self._raw(states) - self.mean) / self.std

    def difference(self, predicted: Tensor, true: Tensor) -> Tensor:
        """(..., dx) twice -> the difference of their features that change, standardised."""
        difference, scored = self(predicted) - self(true), self.scored
        return difference if scored.all() else difference[..., scored]

    def increments(self, predicted: Tensor, true: Tensor) -> Tensor:
        """(..., dx) twice -> the difference of what changes, in deviations of one step."""
        return self.moving_part(predicted - true) / self.moving_part(self.step_std)

    def moving_part(self, values: Tensor) -> Tensor:
        """(..., dx) -> those of the dimensions that change."""
        moving = self.moving
        return values if moving.all() else values[..., moving]

    def _raw(self, states: Tensor) -> Tensor:
        angles, others = (states[..., part] for part in self._parts)
        return torch.cat([angles.cos(), angles.sin(), others], dim=-1)


def _columns(index: list[int]) -> slice | list[int]:
    """An index of columns, as a slice where they lie side by side, which makes a view."""
    side_by_side = bool(index) and index == list(range(index[0], index[-1] + 1))
    return slice(index[0], index[-1] + 1) if side_by_side else index
