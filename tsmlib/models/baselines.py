"""What TSM is held against (section 5.2), behind the same interface, with the same features and targets.

    OneStep    x_{t+1} = f(x_t, u_t)                       (i) one-step loss, (ii) the same with a multi-step loss
    LSTM       x_{t+1}, h_{t+1} = f(x_t, u_t, h_t)         (iii) multi-step loss, h warmed up on the past
    Ensemble   x_{t+1} ~ N(mean_m, variance_m)(x_t, u_t)   PETS: member m is drawn once per rollout (Chua et al., 2018)

All of them read cosine and sine of the angles and standardised velocities and positions, and predict the increment of
the physical state in units of its standard deviation, as TSM does. The ensemble is not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.features import Features
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Window, states_before


class OneStep(nn.Module):
    """A fully connected network f(x_t, u_t): a segment model with H = 1 that reads the last state alone.

    state_dim, action_dim: dx, du. angles: state dimensions in radians.
    """

    segment_len, past_len, stochastic = 1, 1, False

    def __init__(
        self, state_dim: int, action_dim: int, *, angles: tuple[int, ...] = (0, 1), hidden: int = 200, layers: int = 3
    ) -> None:
        super().__init__()
        self._config = dict(
            state_dim=state_dim, action_dim=action_dim, angles=list(angles), hidden=hidden, layers=layers
        )
        self.features = Features(state_dim, tuple(angles))
        widths = [self.features.dim + action_dim, *[hidden] * layers]
        inner = [m for i, o in pairwise(widths) for m in (nn.Linear(i, o), nn.SiLU())]
        self.net = nn.Sequential(*inner, nn.Linear(hidden, state_dim))

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """f: (..., dx), (..., du) -> (..., dx)."""
        return x + self.features.step_std * self.net(torch.cat([self.features(x), u], dim=-1))

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        """(B, L, .), (B, K, du) -> states (B, K, dx), for any K. There is nothing to draw."""
        step = self.stepper(past)
        return torch.stack([step(u) for u in actions.unbind(1)], dim=1)

    def stepper(self, past: Segment, *, generator: Noise | None = None) -> Callable[[Tensor], Tensor]:
        """``predict_segment`` one action at a time; see ``dynamics.stepper``."""
        x = past.states[:, -1]

        def step(u: Tensor) -> Tensor:
            nonlocal x
            x = self.step(x, u)
            return x

        return step

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """(i) Squared error of one-step increments on every tuple (x_t, u_t, x_{t+1}) of the window's future."""
        before = states_before(window)
        predicted = self.step(before, window.future.actions)
        return self.features.increments(predicted, window.future.states).square().sum((1, 2)).mean()

    def multi_step_loss(self, window: Window, generator: Noise) -> Tensor:
        """(ii) Squared error of the states that the network reaches on its own predictions, over the whole future."""
        predicted = self.predict_segment(window.past, window.future.actions)
        return self.features.difference(predicted, window.future.states).square().sum((1, 2)).mean()


class LSTM(nn.Module):
    """(iii) A recurrent model: its hidden state reads the true past, then runs on with the model's own predictions.

    hidden: size of h. past_len: steps of past that warm it up. segment_len: it keeps its hidden state for as many
    steps as one call asks for, so a whole horizon is one segment.
    """

    stochastic = False

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (0, 1),
        hidden: int = 160,
        past_len: int = 10,  # H
        segment_len: int = 100,  # the length of an episode
    ) -> None:
        super().__init__()
        self._config = dict(
            state_dim=state_dim, action_dim=action_dim, angles=list(angles), hidden=hidden, past_len=past_len,
            segment_len=segment_len,
        )  # fmt: skip
        self.past_len, self.segment_len, self.hidden = past_len, segment_len, hidden
        self.features = Features(state_dim, tuple(angles))
        self.cell = nn.Linear(self.features.dim + action_dim + hidden, 4 * hidden)
        self.out = nn.Linear(hidden, state_dim)
        with torch.no_grad():
            self.cell.bias[:hidden] = 1.0  # forget gates start open

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        """(B, L, .), (B, K <= segment_len, du) -> states (B, K, dx). There is nothing to draw."""
        step = self.stepper(past)
        return torch.stack([step(u) for u in actions.unbind(1)], dim=1)

    def stepper(self, past: Segment, *, generator: Noise | None = None) -> Callable[[Tensor], Tensor]:
        """``predict_segment`` one action at a time, the hidden state carried; see ``dynamics.stepper``."""
        h = c = past.states.new_zeros(len(past.states), self.hidden)
        for x, u in zip(past.states[:, :-1].unbind(1), past.actions[:, 1:].unbind(1), strict=True):
            h, c = self.recur(x, u, h, c)
        x = past.states[:, -1]

        def step(u: Tensor) -> Tensor:
            nonlocal x, h, c
            h, c = self.recur(x, u, h, c)
            x = x + self.features.step_std * self.out(h)
            return x

        return step

    def recur(self, x: Tensor, u: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """The next hidden state h and cell c, (B, hidden) each."""
        gates = self.cell(torch.cat([self.features(x), u, h], dim=-1))
        forget, write, read, candidate = gates.chunk(4, dim=-1)
        c = forget.sigmoid() * c + write.sigmoid() * candidate.tanh()
        return read.sigmoid() * c.tanh(), c

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error of the states over the whole future, on the model's own predictions."""
        predicted = self.predict_segment(window.past, window.future.actions)
        return self.features.difference(predicted, window.future.states).square().sum((1, 2)).mean()
