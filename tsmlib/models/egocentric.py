"""A one-step model that sees everything from one of the bodies. Not in the paper.

    s = [places, velocities and action as seen from body b, and where b itself is]
    x_{t+1} = x_t + R(b) D (A s + f(s))             R: from the body's frame back to the world's

What happens when a thing is pushed does not depend on where in the world it lies, so a network that
sees it from there learns a contact once. Only the walls need to know where that is. It is a segment
model with H = 1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.checks import require_columns, require_counts, require_type
from tsmlib.models.base import Step, repeated, rollout
from tsmlib.models.layers import silu_network
from tsmlib.models.state_model import StateModel
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Trajectories, Window


class Egocentric(StateModel):
    """A fully connected network in the frame of a body that moves in the plane.

    Args:
        state_dim: dx.
        action_dim: du = 2, a vector in the plane.
        angles: state dimensions in radians.
        body: columns x, y and angle of the body.
        places: pairs of columns that are places of other things.
        vectors: pairs of columns that are vectors, velocities for example.
        hidden: width of the network.
        layers: hidden layers.

    Raises:
        TypeError: an argument of another kind; it is named.
        ValueError: columns that there are not, or that are not named once; another angle than the
            body's; an action that is no vector in the plane.
    """

    segment_len, past_len, stochastic = 1, 1, False
    seen_mean: Tensor
    seen_std: Tensor
    step_std: Tensor

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: Sequence[int] = (4,),
        body: Sequence[int] = (2, 3, 4),
        places: Sequence[Sequence[int]] = ((0, 1),),
        vectors: Sequence[Sequence[int]] = ((5, 6),),
        hidden: int = 256,
        layers: int = 3,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(hidden=hidden, layers=layers)
        if action_dim != 2:
            raise ValueError(f"action_dim is {action_dim}; expected 2, a vector in the plane")
        x, y, self.angle = require_columns("body", body, 3, state_dim)
        self.pairs = [[x, y]]
        for name, pairs in (("places", places), ("vectors", vectors)):
            require_type(name, pairs, (list, tuple), "pairs of columns, such as ((0, 1),)")
            columns = (require_columns(f"a pair of {name}", pair, 2, state_dim) for pair in pairs)
            self.pairs += [list(pair) for pair in columns]
        counts = Counter([self.angle, *(column for pair in self.pairs for column in pair)])
        if wrong := [column for column in range(state_dim) if counts[column] != 1]:
            raise ValueError(
                f"body is {body}, places {places} and vectors {vectors}, which name column "
                f"{wrong[0]} {counts[wrong[0]]} times; expected each of the {state_dim} state "
                "dimensions once"
            )
        if self.features.angles != [self.angle]:
            raise ValueError(f"angles is {angles}; expected the body's alone, ({self.angle},)")
        self.n_places, dim = len(places), 2 * (len(places) + len(vectors)) + action_dim + 4
        self.net = silu_network(dim, *[hidden] * layers, state_dim)
        self.linear = nn.Linear(dim, state_dim)
        self.output_layers = (f"net.{2 * layers}", "linear")
        self.register_buffer("seen_mean", torch.zeros(dim))
        self.register_buffer("seen_std", torch.ones(dim))
        self.register_buffer("step_std", torch.ones(state_dim))  # in the body's frame

    def take_robot(self, data: Trajectories) -> None:
        """Take the robot of training data and, where there are none yet, their statistics.

        Args:
            data: training episodes.
        """
        fitted = self.features.fitted
        super().take_robot(data)
        if fitted:
            return
        at = np.arange(len(data.flat_actions)) + np.repeat(np.arange(len(data)), data.lengths)
        at, x = at[:: 1 + len(at) // 100_000], torch.from_numpy(data.flat_states)
        before, after = x[at], x[at + 1]
        u = torch.from_numpy(data.flat_actions)[:: 1 + len(data.flat_actions) // 100_000]
        seen, step = self._seen(before, u), self._increments(before, after)
        self.seen_mean.copy_(seen.mean(0))
        self.seen_std.copy_(seen.std(0).clamp(min=1e-6))
        self.step_std.copy_(step.std(0))

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """Predict one step in the frame of the body.

        Args:
            x: states (..., dx) in physical units.
            u: actions (..., du) in [-1, 1].

        Returns:
            The next states (..., dx) in physical units.
        """
        s = (self._seen(x, u) - self.seen_mean) / self.seen_std
        d = (self.net(s) + self.linear(s)) * self.step_std
        cosine, sine = x[..., self.angle, None].cos(), x[..., self.angle, None].sin()
        turned = _turned(d[..., :-1].unflatten(-1, (-1, 2)), cosine, sine).flatten(-2)
        moved = torch.cat([turned, d[..., -1:]], dim=-1)
        return x + moved[..., self._order()]

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
        """Average the distance of the states that its own predictions reach, in the size of steps.

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: unused; nothing is drawn.

        Returns:
            The mean over batch and steps, a scalar without unit.
        """
        predicted = rollout(self, window.past, window.future.actions)
        apart = self.features.increments(predicted, window.future.states)
        return (apart.square().sum(-1) + 1e-4).sqrt().mean()

    def _order(self) -> list[int]:
        """Where each state dimension stands among the pairs, and the angle at the end."""
        columns = [c for pair in self.pairs for c in pair] + [self.angle]
        return [columns.index(c) for c in range(len(columns))]

    def _seen(self, x: Tensor, u: Tensor) -> Tensor:
        cosine, sine = x[..., self.angle, None].cos(), x[..., self.angle, None].sin()
        own, *others = (x[..., pair] for pair in self.pairs)
        others = [p - own if i < self.n_places else p for i, p in enumerate(others)]
        turned = _turned(torch.stack([*others, u], dim=-2), cosine, -sine).flatten(-2)
        return torch.cat([turned, own, cosine, sine], dim=-1)

    def _increments(self, before: Tensor, after: Tensor) -> Tensor:
        """What a step changes, in the body's frame: pairs, then the angle."""
        cosine, sine = before[..., self.angle, None].cos(), before[..., self.angle, None].sin()
        change = torch.stack([(after - before)[..., pair] for pair in self.pairs], dim=-2)
        turned = _turned(change, cosine, -sine).flatten(-2)
        return torch.cat([turned, (after - before)[..., [self.angle]]], dim=-1)


def _turned(pairs: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Vectors (..., n, 2) turned by an angle whose cosine and sine are (..., 1)."""
    x, y = pairs.unbind(-1)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)
