"""RecurrentTSM, a segment model whose decoder is a recurrent cell, with the codes in its gates. Not in the paper.

    h_t, c_t = cell([x_t, u_t], h_{t-1}, c_{t-1}; gates + V z_k)        z_k ~ N(0, I), one code for H steps
    x_{t+1}  = x_t + s * head(h_t, x_t, u_t)                            s: deviation of one step

The hidden state reads the past with z = 0 and is then carried on from code to code, so that nothing is forgotten where
one ends and the next begins. All that is uncertain lives in the codes. There is no encoder: it is trained by the energy
score of its own free-running samples.
"""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.models.base import Step
from tsmlib.models.config import Configured
from tsmlib.models.energy import distance, energy_score
from tsmlib.models.features import Featured, Features
from tsmlib.models.layers import chunked
from tsmlib.models.recurrence import Memory, Recurrent
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window

SAMPLES = 2  # of the energy score


class Decoder(nn.Module):
    """Cell, codes V and head. seen: features and actions. hidden: size of h and c, and of the head."""

    def __init__(self, seen: int, state_dim: int, *, hidden: int, latent_dim: int) -> None:
        super().__init__()
        self.cell = nn.Linear(seen + hidden, 4 * hidden)  # gates: forget, write, read, candidate
        self.codes = nn.Linear(latent_dim, 4 * hidden, bias=False)  # V
        out = nn.Linear(hidden, state_dim)
        self.head = nn.Sequential(nn.Linear(hidden + seen, hidden), nn.SiLU(), out)
        with torch.no_grad():
            self.cell.bias[:hidden] = 1.0  # forget gates start open
            out.weight.mul_(
                0.1
            )  # and predictions near standing still, so that long windows stay finite
            self.codes.weight.mul_(
                0.1
            )  # so that the mode, learned first, is not lost when samples are drawn

    def over(self, features: Features) -> Recurrent:
        """As it runs."""
        hidden, _, out = self.head
        layers = dict(
            cell=self.cell,
            codes=self.codes,
            hidden=cast(nn.Linear, hidden),
            out=cast(nn.Linear, out),
        )
        return Recurrent.of(features, **layers)


class RecurrentTSM(Featured, Configured):
    """Recurrent segment model of one environment.

    state_dim, action_dim: dx, du. angles: state dimensions in radians. hidden: size of h and c.
    code_len: H, steps for which a code is held: the segment of the analyses of codes, as TSM's own.
    segment_len: as the LSTM, it keeps its hidden state for as many steps as one call asks for, so a whole horizon is
    one segment; within it ``begin`` draws a new code every H steps.
    mode_weight: of the distance of the mode (z = 0) from the truth, beside the energy score.
    """

    stochastic, code_statistics = True, None  # no encoder

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (),
        hidden: int = 160,
        latent_dim: int = 8,
        past_len: int = 10,
        code_len: int = 10,  # H, section 5.1
        segment_len: int = 100,  # the length of an episode
        mode_weight: float = 0.0,
    ) -> None:
        super().__init__()
        self.hidden, self.latent_dim, self.mode_weight = hidden, latent_dim, mode_weight
        self.past_len, self.code_len, self.segment_len = past_len, code_len, segment_len
        self.features = Features(state_dim, tuple(angles))
        seen = self.features.dim + action_dim
        self.decoder = Decoder(seen, state_dim, hidden=hidden, latent_dim=latent_dim)
        self.output_layers = ("decoder.head",)
        self.adam_only = (
            "decoder.codes",
        )  # not Muon: its columns are the codes' dimensions, of which some go unused

    @property
    def code_layers(self) -> tuple[nn.Linear, list[nn.Linear]]:
        """V and the gates."""
        return self.decoder.codes, [self.decoder.cell]

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past (B, L, .). No generator: z = 0; with one: z ~ N(0, I), a new one every H steps."""
        x, taken = past.states[:, -1], 0
        codes = x.new_zeros(len(x), self.latent_dim)
        advance = self._recurrent().begin(past, lambda: codes)

        def step(u: Tensor) -> Tensor:
            nonlocal codes, taken
            if generator is not None and taken % self.code_len == 0:
                codes = self._draw(x, generator)
            taken += 1
            return advance(u)

        return step

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """The states (B, K, dx) that ``begin`` steps through, by blocks of rows."""
        return chunked(
            self._decode,
            *past,
            actions,
            self._codes(past.states[:, -1], actions.shape[1], generator),
        )

    def decode(self, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
        """States (B, K, dx) under ``actions`` (B, K, du) and codes: free-running, each from the predicted one before.

        z: (B, dz), of the first H steps, or (B, n, dz), of the first n times H; z = 0 after them.
        """
        return chunked(self._decode, *past, actions, z if z.ndim == 3 else z[:, None])

    def _decode(self, states: Tensor, before: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        decoder = self._recurrent()
        return self._run(decoder, states[:, -1], decoder.read(Segment(states, before)), actions, z)

    def _recurrent(self) -> Recurrent:
        return self.decoder.over(self.features)

    def point_loss(self, window: Window, generator: Noise) -> Tensor:
        """|m - x|, m the mode (z = 0), of each H steps as a whole, and the mean of these."""
        (past, future), x, decoder = window, window.past.states[:, -1], self._recurrent()
        states = self._run(decoder, x, decoder.read(past), future.actions, self._codes(x, 0, None))
        parts = self._parts(states, future.states)
        return torch.stack([distance(mode, x) for mode, x in parts]).mean()

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """mean_i |X_i - x| - |X_1 - X_2| / 2 + w |m - x| of each H steps as a whole, and the mean of these.

        X_1, X_2: samples. m: the mode. w: ``mode_weight``. All of them free-running through the whole future.
        """
        (past, future), draws, decoder = window, SAMPLES + (self.mode_weight > 0), self._recurrent()
        n, steps = future.actions.shape[:2]
        x = past.states[:, -1].repeat(draws, 1)
        z = self._codes(x[: SAMPLES * n], steps, generator)
        if self.mode_weight > 0:
            z = torch.cat([z, z.new_zeros(n, *z.shape[1:])])
        h, c = (part.repeat(draws, 1) for part in decoder.read(past))
        states = self._run(decoder, x, (h, c), future.actions.repeat(draws, 1, 1), z)
        total = x.new_zeros(())
        parts = self._parts(states.unflatten(0, (draws, n)), future.states)
        for samples, truth in parts:
            total = total + energy_score(samples[:SAMPLES], truth)
            if self.mode_weight > 0:
                total = total + self.mode_weight * distance(samples[-1], truth)
        return total / len(parts)

    def _run(
        self, decoder: Recurrent, x: Tensor, memory: Memory, actions: Tensor, z: Tensor
    ) -> Tensor:
        """(B, dx), (B, K, du), (B, n, dz) -> (B, K, dx)."""
        each = z.transpose(0, 1)[:, None].expand(-1, self.code_len, -1, -1).flatten(0, 1)
        held = F.pad(each, (0, 0, 0, 0, 0, actions.shape[1]))
        states, _ = decoder.run(x, memory, actions.transpose(0, 1), held[: actions.shape[1]])
        return states.transpose(0, 1)

    def _codes(self, x: Tensor, steps: int, generator: Noise | None) -> Tensor:
        """Codes (B, n, dz) of so many steps, drawn one by one as by ``begin``; no generator: none, the mode."""
        if generator is None:
            return x.new_zeros(len(x), 0, self.latent_dim)
        return torch.stack(
            [self._draw(x, generator) for _ in range(0, steps, self.code_len)], dim=1
        )

    def _draw(self, x: Tensor, generator: Noise) -> Tensor:
        return standard_normal((len(x), self.latent_dim), generator, x)

    def _parts(self, states: Tensor, truth: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Features of states (..., B, K, dx) and truths (B, K, dx), in pieces of H steps."""
        pieces = (self.features(part).split(self.code_len, dim=-2) for part in (states, truth))
        return list(zip(*pieces, strict=True))
