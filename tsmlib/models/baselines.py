"""Baselines of section 5.2, with the features and targets of TSM: both predict standardised increments.

OneStep    x_{t+1} = f(x_t, u_t)                       (i) one-step loss, (ii) the same with a multi-step loss
LSTM       x_{t+1}, h_{t+1} = f(x_t, u_t, h_t)         (iii) multi-step loss, h warmed up on the past
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from tsmlib.models.base import Step, predict_segment
from tsmlib.models.config import Configured
from tsmlib.models.features import Featured, Features
from tsmlib.models.layers import chunked
from tsmlib.models.recurrence import Recurrent
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Window, states_before


class OneStep(Featured, Configured):
    """A fully connected network f(x_t, u_t): a segment model with H = 1 that reads the last state alone.

    state_dim, action_dim: dx, du. angles: state dimensions in radians.
    """

    segment_len, past_len, stochastic = 1, 1, False

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (),
        hidden: int = 200,
        layers: int = 3,
    ) -> None:
        super().__init__()
        self.features = Features(state_dim, tuple(angles))
        widths = [self.features.dim + action_dim, *[hidden] * layers]
        inner = [m for i, o in pairwise(widths) for m in (nn.Linear(i, o), nn.SiLU())]
        self.net = nn.Sequential(*inner, nn.Linear(hidden, state_dim))
        self.output_layers = (f"net.{len(inner)}",)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """f: (..., dx), (..., du) -> (..., dx)."""
        return x + self.features.step_std * self.net(torch.cat([self.features(x), u], dim=-1))

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Go on from the last state, for any number of steps. There is nothing to draw."""
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
        predicted = predict_segment(self, window.past, window.future.actions)
        return self.features.difference(predicted, window.future.states).square().sum((1, 2)).mean()


class LSTM(Featured, Configured):
    """(iii) A recurrent model: its hidden state reads the true past, then runs on with the model's own predictions.

    hidden: size of h. past_len: steps of past that warm it up. segment_len: it keeps its hidden state for as many
    steps as one call asks for, so a whole horizon is one segment.
    """

    stochastic, output_layers = False, ("out",)

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (),
        hidden: int = 160,
        past_len: int = 10,  # H
        segment_len: int = 100,  # the length of an episode
    ) -> None:
        super().__init__()
        self.past_len, self.segment_len, self.hidden = past_len, segment_len, hidden
        self.features = Features(state_dim, tuple(angles))
        self.cell = nn.Linear(self.features.dim + action_dim + hidden, 4 * hidden)
        self.out = nn.Linear(hidden, state_dim)
        with torch.no_grad():
            self.cell.bias[:hidden] = 1.0  # forget gates start open

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Warm the hidden state up on the past (B, L, .), then carry it. There is nothing to draw."""
        return self._recurrent().begin(past)

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """The states (B, K, dx) that ``begin`` steps through, by blocks of rows."""
        return chunked(self._decode, *past, actions)

    def _decode(self, states: Tensor, before: Tensor, actions: Tensor) -> Tensor:
        recurrent, u = self._recurrent(), actions.transpose(0, 1)
        states, _ = recurrent.run(
            states[:, -1], recurrent.read(Segment(states, before)), u, u[..., :0]
        )
        return states.transpose(0, 1)  # (B, K, dx)

    def _recurrent(self) -> Recurrent:
        return Recurrent.of(self.features, self.cell, self.out)

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error of the states over the whole future, on the model's own predictions."""
        predicted = predict_segment(self, window.past, window.future.actions)
        return self.features.difference(predicted, window.future.states).square().sum((1, 2)).mean()
