"""Baselines of section 5.2, with the features and targets of TSM: standardised increments.

OneStep    x_{t+1} = f(x_t, u_t)                  (i) one-step loss, (ii) multi-step loss
LSTM       x_{t+1}, h_{t+1} = f(x_t, u_t, h_t)    (iii) multi-step loss, h warmed up on the past
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tsmlib.checks import require_counts
from tsmlib.models.base import Step, predict_segment, repeated
from tsmlib.models.layers import chunked, silu_network
from tsmlib.models.recurrence import Recurrent
from tsmlib.models.state_model import StateModel
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Window, states_before


def _free_running_error(model: OneStep | LSTM, window: Window) -> Tensor:
    """Squared error of the features that a model reaches on its own predictions."""
    predicted = predict_segment(model, window.past, window.future.actions)
    return model.features.difference(predicted, window.future.states).square().sum((1, 2)).mean()


class OneStep(StateModel):
    """A fully connected network f(x_t, u_t): a segment model with H = 1 (section 5.2, i and ii).

    ``OneStep.for_data(data)`` makes one that fits the data. It reads the last state alone.

    Args:
        state_dim: dx, dimensions of a state.
        action_dim: du, dimensions of an action.
        angles: indices of state dimensions that are angles in radians; the model sees their cosine
            and sine.
        hidden: size of each hidden layer; 200 as in PETS (the paper's is not stated).
        layers: hidden layers; 3.
    """

    segment_len, past_len, stochastic = 1, 1, False

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: Sequence[int] = (),
        hidden: int = 200,
        layers: int = 3,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(hidden=hidden, layers=layers)
        self.net = silu_network(self.features.dim + action_dim, *[hidden] * layers, state_dim)
        self.output_layers = (f"net.{2 * layers}",)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """Predict one step, x_{t+1} = f(x_t, u_t).

        Args:
            x: states (..., dx) in physical units.
            u: actions (..., du) in [-1, 1].

        Returns:
            The next states (..., dx) in physical units.
        """
        return x + self.features.step_std * self.net(torch.cat([self.features(x), u], dim=-1))

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Go on from the last state, for any number of steps.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            generator: unused; nothing is drawn.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to, in physical units.
        """
        return repeated(self.step, past.states[:, -1])

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Square the errors of one-step increments on every (x_t, u_t, x_{t+1}) (section 5.2, i).

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: unused; nothing is drawn.

        Returns:
            The mean over the batch, a scalar without unit.
        """
        before = states_before(window)
        predicted = self.step(before, window.future.actions)
        return self.features.increments(predicted, window.future.states).square().sum((1, 2)).mean()

    def multi_step_loss(self, window: Window, generator: Noise) -> Tensor:
        """Square the errors of the states that its own predictions reach (section 5.2, ii).

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: unused; nothing is drawn.

        Returns:
            The mean over the batch, a scalar without unit.
        """
        return _free_running_error(self, window)


class LSTM(StateModel):
    """(iii) A recurrent model: its hidden state reads the true past, then its own predictions.

    ``LSTM.for_data(data)`` makes one that fits the data.

    Args:
        state_dim: dx, dimensions of a state.
        action_dim: du, dimensions of an action.
        angles: indices of state dimensions that are angles in radians; the model sees their cosine
            and sine.
        hidden: size of h and c; 160 trains as fast as TSM's stack.
        past_len: steps of past that warm the hidden state up; 10, H of TSM.
        segment_len: most steps until the hidden state is read anew; 100, an episode of section 5.1.
    """

    stochastic, output_layers = False, ("out",)

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: Sequence[int] = (),
        hidden: int = 160,
        past_len: int = 10,
        segment_len: int = 100,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(hidden=hidden, past_len=past_len, segment_len=segment_len)
        self.past_len, self.segment_len, self.hidden = past_len, segment_len, hidden
        self.cell = nn.Linear(self.features.dim + action_dim + hidden, 4 * hidden)
        self.out = nn.Linear(hidden, state_dim)
        with torch.no_grad():
            self.cell.bias[:hidden] = 1.0  # forget gates start open

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Warm the hidden state up on the past, then carry it from step to step.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            generator: unused; nothing is drawn.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to, in physical units.
        """
        return self._recurrent().begin(past)

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """Predict the states that ``begin`` steps through, by blocks of rows.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1].
            generator: unused; nothing is drawn.

        Returns:
            States (B, K, dx) in physical units.
        """
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
        """Square the errors of the states that its own predictions reach (section 5.2, iii).

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: unused; nothing is drawn.

        Returns:
            The mean over the batch, a scalar without unit.
        """
        return _free_running_error(self, window)
