"""A recurrent segment model: codes, one per segment, in the gates of an LSTM cell, trained by an energy score.

    h_t, c_t = LSTM([x_t, u_t], h_{t-1}, c_{t-1}; gates + V z_k)      z_k ~ N(0, I), one code per segment of H steps
    x_{t+1}  = x_t + s * head(h_t, x_t, u_t)

The hidden state reads the past with z = 0 and is then carried on through all segments, so that nothing is forgotten
where one segment ends and the next begins. All that is uncertain lives in the codes. Always free-running.

    energy score of S samples X_i:   mean_i |X_i - x| - mean_{i != j} |X_i - X_j| / 2     over each segment as a whole

It is strictly proper: its minimum over all models is the true distribution of the future. No encoder is needed.

The prototype behind ``successor.csv``, kept as it was; the package's is ``tsmlib.models.recurrent``.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.base import Step
from tsmlib.models.config import Configured
from tsmlib.models.features import Features
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window


class Recurrent(Configured):
    """Recurrent decoder with codes.

    state_dim, action_dim: dx, du. angles: state dimensions in radians. hidden: size of h and c. head: width of the
    hidden layer of the head. code_len: H, steps for which a code is held. segment_len: steps of one call, within which
    the hidden state is carried. samples: S of the energy score. mode_weight: of the distance between the mode (z = 0)
    and the truth, beside the energy score. per_step: weight of the energy score of each single step, beside that of
    whole segments.
    """

    stochastic = True

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (0, 1),
        hidden: int = 160,
        head: int = 0,
        latent_dim: int = 8,
        code_len: int = 10,
        past_len: int = 10,
        segment_len: int = 100,
        samples: int = 2,
        mode_weight: float = 0.0,
        per_step: float = 0.0,
    ) -> None:
        super().__init__()
        self.hidden, self.latent_dim, self.code_len = hidden, latent_dim, code_len
        self.past_len, self.segment_len = past_len, segment_len
        self.samples, self.mode_weight, self.per_step = samples, mode_weight, per_step
        self.features = Features(state_dim, tuple(angles))
        seen = self.features.dim + action_dim
        self.cell = nn.Linear(seen + hidden, 4 * hidden)
        self.code = nn.Linear(latent_dim, 4 * hidden, bias=False)
        self.head = nn.Sequential(
            nn.Linear(hidden + seen, head or hidden), nn.SiLU(), nn.Linear(head or hidden, state_dim)
        )
        with torch.no_grad():
            self.cell.bias[:hidden] = 1.0  # forget gates start open
            self.head[2].weight.mul_(0.1)  # predictions start near standing still, so that long windows stay finite

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past (B, L, .). A new code is drawn every H steps; no generator: all codes zero, the mode."""
        x, (h, c), taken = past.states[:, -1], self.read(past), 0
        code: Tensor = x.new_zeros(())

        def step(u: Tensor) -> Tensor:
            nonlocal x, h, c, taken, code
            if generator is not None and taken % self.code_len == 0:
                drawn = standard_normal((len(u), self.latent_dim), generator, x)
                code = self.code(drawn)
            x, h, c = self.step(x, u, h, c, code)
            taken += 1
            return x

        return step

    def decode(self, past: Segment, actions: Tensor, codes: Tensor) -> Tensor:
        """States (B, K, dx) under ``actions`` (B, K, du) with one code per segment, ``codes`` (B, K / H, dz)."""
        memory = self.read(past)
        return self._run(past.states[:, -1], memory, actions, self.code(codes).unbind(1))

    def read(self, past: Segment) -> tuple[Tensor, Tensor]:
        """Hidden state and cell (B, hidden) after the past, all but its last state."""
        seen = torch.cat([self.features(past.states[:, :-1]), past.actions[:, 1:]], dim=-1)
        given = nn.functional.linear(seen, self.cell.weight[:, : seen.shape[2]], self.cell.bias)
        h = c = past.states.new_zeros(len(past.states), self.hidden)
        for gates in given.unbind(1):
            h, c = Gates.apply(gates + nn.functional.linear(h, self.cell.weight[:, seen.shape[2] :]), c)
        return h, c

    def step(self, x: Tensor, u: Tensor, h: Tensor, c: Tensor, code: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The next state, hidden state and cell, by a code that has become gates (B, 4 hidden)."""
        seen = torch.cat([self.features(x), u], dim=-1)
        h, c = Gates.apply(self.cell(torch.cat([seen, h], dim=-1)) + code, c)
        return x + self.features.step_std * self.head(torch.cat([h, seen], dim=-1)), h, c

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Energy score, mean over the segments of the window's future, plus the weighted distance of the mode."""
        if self.mode_weight > 0 and self.samples == 1:
            return self.mode_loss(window)
        (past, future), draws = window, self.samples + (self.mode_weight > 0)
        memory = [part.repeat(draws, 1) for part in self.read(past)]
        n, length = future.actions.shape[:2]
        shape = (self.samples * n, -(-length // self.code_len), self.latent_dim)
        codes = standard_normal(shape, generator, past.states)
        if self.mode_weight > 0:
            codes = torch.cat([codes, codes.new_zeros(n, *shape[1:])])
        actions = future.actions.repeat(draws, 1, 1)
        drawn = self._run(past.states[:, -1].repeat(draws, 1), memory, actions, self.code(codes).unbind(1))
        truth, drawn = (self.features(states)[..., self.features.scored] for states in (future.states, drawn))
        total, parts = truth.new_zeros(()), list(zip(
            drawn.unflatten(0, (draws, n)).split(self.code_len, dim=2), truth.split(self.code_len, dim=1), strict=True
        ))  # fmt: skip
        for samples, x in parts:
            total = total + energy(samples[: self.samples], x, 2)
            if self.per_step:
                total = total + self.per_step * energy(samples[: self.samples], x, 1)
            if self.mode_weight > 0:
                total = total + self.mode_weight * distance(samples[-1], x, 2)
        return total / len(parts)

    def mode_loss(self, window: Window) -> Tensor:
        """Distance between the mode and the truth, mean over the segments: with one sample, codes are but noise."""
        past, future = window
        codes = past.states.new_zeros(len(past.states), -(-future.actions.shape[1] // self.code_len), self.latent_dim)
        states = self.decode(past, future.actions, codes)
        mode, truth = (self.features(each)[..., self.features.scored] for each in (states, future.states))
        pairs = zip(mode.split(self.code_len, dim=1), truth.split(self.code_len, dim=1), strict=True)
        return torch.stack([distance(a, b, 2) for a, b in pairs]).mean()

    def _run(self, x: Tensor, memory: Any, actions: Tensor, codes: Any) -> Tensor:
        (h, c), states = memory, []
        for k, u in enumerate(actions.unbind(1)):
            x, h, c = self.step(x, u, h, c, codes[k // self.code_len])
            states.append(x)
        return torch.stack(states, dim=1)


class Gates(torch.autograd.Function):
    """Of gates (B, 4 hidden) and cell (B, hidden), the new hidden state and cell; in fewer passes over memory.

    h = r tanh(c'),  c' = f c + w tanh(g). A tanh is a sigmoid of twice its argument, which processors compute faster.
    """

    @staticmethod
    def forward(ctx: Any, gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        n = c.shape[1]
        s = gates.to(torch.float32, copy=True)
        s[:, 3 * n :].mul_(2)
        s.sigmoid_()
        s[:, 3 * n :].mul_(2).sub_(1)
        forget, write, read, candidate = s.split(n, dim=1)
        after = torch.addcmul(forget * c, write, candidate)
        t = (2 * after).sigmoid_().mul_(2).sub_(1)
        ctx.save_for_backward(s, c, t)
        ctx.type = gates.dtype
        return read * t, after

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, dh: Tensor, dc: Tensor) -> tuple[Tensor, Tensor]:
        s, c, t = ctx.saved_tensors
        n = c.shape[1]
        forget, write, read, candidate = s.split(n, dim=1)
        dc = torch.addcmul(dc, dh * read, 1 - t * t)
        slopes = s - s * s  # of the three sigmoids
        torch.addcmul(slopes.new_ones(()), candidate, candidate, value=-1, out=slopes[:, 3 * n :])
        for part, towards in zip(slopes.split(n, dim=1), ((dc, c), (dc, candidate), (dh, t), (dc, write)), strict=True):
            part.mul_(towards[0]).mul_(towards[1])
        return slopes.to(ctx.type), dc * forget


def energy(samples: Tensor, truth: Tensor, dims: int) -> Tensor:
    """Energy score of samples (S, B, K, D), mean over the batch; over the last ``dims`` dimensions as a whole."""
    pairs = list(combinations(samples, 2))
    off = torch.stack([distance(a, truth, dims) for a in samples]).mean()
    return off - torch.stack([distance(a, b, dims) for a, b in pairs]).mean() / 2 if pairs else off


def distance(a: Tensor, b: Tensor, dims: int) -> Tensor:
    """Mean Euclidean distance over the last ``dims`` dimensions, with a gradient where it is zero."""
    squares = (a - b).square().flatten(-dims).sum(-1)
    return ((squares + 1e-8).sqrt() * (1.0 if dims == 2 else a.shape[-2] ** 0.5)).mean()
