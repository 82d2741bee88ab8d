"""RecurrentTSM, a segment model with a recurrent decoder, its codes in the gates. Not in the paper.

    h_t, c_t = cell([x_t, u_t], h_{t-1}, c_{t-1}; gates + V z_k)     z_k ~ N(0, I), for H steps
    x_{t+1}  = x_t + s * head(h_t, x_t, u_t)                         s: deviation of one step

The hidden state reads the past with z = 0 and is carried on from code to code, so that nothing is
forgotten where one ends and the next begins. All that is uncertain lives in the codes. There is no
encoder: it is trained by the energy score of its own free-running samples.
"""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.checks import require_counts
from tsmlib.models.base import Step
from tsmlib.models.energy import distance, energy_score
from tsmlib.models.features import Features
from tsmlib.models.layers import chunked
from tsmlib.models.recurrence import Memory, Recurrent
from tsmlib.models.state_model import StateModel
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window

SAMPLES = 2  # of the energy score


class Decoder(nn.Module):
    """Cell, codes V and head; ``hidden`` is the size of h, c and the head."""

    def __init__(self, seen: int, state_dim: int, *, hidden: int, latent_dim: int) -> None:
        super().__init__()
        self.cell = nn.Linear(seen + hidden, 4 * hidden)  # gates: forget, write, read, candidate
        self.codes = nn.Linear(latent_dim, 4 * hidden, bias=False)  # V
        out = nn.Linear(hidden, state_dim)
        self.head = nn.Sequential(nn.Linear(hidden + seen, hidden), nn.SiLU(), out)
        with torch.no_grad():
            self.cell.bias[:hidden] = 1.0  # forget gates start open
            # Predictions start near standing still, so that long windows stay finite.
            out.weight.mul_(0.1)
            # The mode is learned first, and not lost when samples are drawn.
            self.codes.weight.mul_(0.1)

    def over(self, features: Features) -> Recurrent:
        """As it runs."""
        hidden, _, out = cast(Sequence[nn.Linear], self.head)
        return Recurrent.of(features, self.cell, out, hidden=hidden, codes=self.codes)


class RecurrentTSM(StateModel):
    """Recurrent segment model of one robot: the most accurate model here; not in the paper.

    ``RecurrentTSM.for_data(data)`` makes one that fits the data. H is ``code_len``: a code is held
    for H = 10 steps, as a segment of ``TSM``. The hidden state is carried through all of them:
    ``segment_len`` is how long, and no H.

    Args:
        state_dim: dx, dimensions of a state.
        action_dim: du, dimensions of an action.
        angles: indices of state dimensions that are angles in radians; the model sees their cosine
            and sine.
        hidden: size of h and c; 160 trains as fast as TSM's stack.
        latent_dim: dz, dimensions of a code z; 8 as in section 5.1.
        past_len: steps of past that the hidden state reads; 10 as TSM reads.
        code_len: H, steps for which a code is held; 10 as in section 5.1.
        segment_len: most steps until the hidden state is read anew from the last ``past_len``
            states; 100, an episode of section 5.1, so that it is carried to the end.
    """

    stochastic, code_statistics = True, None  # no encoder
    output_layers = ("decoder.head",)
    # Not for Muon: columns are the codes' dimensions, of which some go unused.
    adam_only = ("decoder.codes",)

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: Sequence[int] = (),
        hidden: int = 160,
        latent_dim: int = 8,
        past_len: int = 10,
        code_len: int = 10,
        segment_len: int = 100,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(hidden=hidden, latent_dim=latent_dim, past_len=past_len)
        require_counts(code_len=code_len, segment_len=segment_len)
        self.hidden, self.latent_dim = hidden, latent_dim
        self.past_len, self.code_len, self.segment_len = past_len, code_len, segment_len
        seen = self.features.dim + action_dim
        self.decoder = Decoder(seen, state_dim, hidden=hidden, latent_dim=latent_dim)

    @property
    def code_layers(self) -> tuple[nn.Linear, list[nn.Linear]]:
        """V and the gates."""
        return self.decoder.codes, [self.decoder.cell]

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past, then carry the hidden state from step to step.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            generator: None for the mode, z = 0; else of z ~ N(0, I), drawn anew every H steps.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to, in physical units.
        """
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
        """Predict the states that ``begin`` steps through, by blocks of rows.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1].
            generator: as of ``begin``.

        Returns:
            States (B, K, dx) in physical units.
        """
        z = self._codes(past.states[:, -1], actions.shape[1], generator)
        return chunked(self._decode, *past, actions, z)

    def decode(self, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
        """Decode actions and codes into states, each from the predicted one before it.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1].
            z: codes (B, dz) of the first H steps, or (B, n, dz) of the first n H; z = 0 after them.

        Returns:
            States (B, K, dx) in physical units.
        """
        return chunked(self._decode, *past, actions, z if z.ndim == 3 else z[:, None])

    def _decode(self, states: Tensor, before: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        decoder = self._recurrent()
        return self._run(decoder, states[:, -1], decoder.read(Segment(states, before)), actions, z)

    def _recurrent(self) -> Recurrent:
        return self.decoder.over(self.features)

    def point_loss(self, window: Window, generator: Noise) -> Tensor:
        """Average |m - x| over the pieces of H steps, where m is the mode (z = 0).

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: unused; nothing is drawn.

        Returns:
            The mean over the batch, a scalar without unit.
        """
        (past, future), x, decoder = window, window.past.states[:, -1], self._recurrent()
        states = self._run(decoder, x, decoder.read(past), future.actions, self._codes(x, 0, None))
        parts = self._parts(states, future.states)
        return torch.stack([distance(mode, x) for mode, x in parts]).mean()

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Average mean_i |X_i - x| - |X_1 - X_2| / 2 over the pieces of H steps.

        X_1, X_2: samples, free-running through the future.

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: of the codes of the samples.

        Returns:
            The mean over the batch, a scalar without unit.
        """
        (past, future), decoder = window, self._recurrent()
        x = past.states[:, -1].repeat(SAMPLES, 1)
        z = self._codes(x, future.actions.shape[1], generator)
        h, c = (part.repeat(SAMPLES, 1) for part in decoder.read(past))
        states = self._run(decoder, x, (h, c), future.actions.repeat(SAMPLES, 1, 1), z)
        total = x.new_zeros(())
        parts = self._parts(states.unflatten(0, (SAMPLES, -1)), future.states)
        for samples, truth in parts:
            total = total + energy_score(samples, truth)
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
        """Codes (B, n, dz) of so many steps, drawn as by ``begin``; the mode has none."""
        if generator is None:
            return x.new_zeros(len(x), 0, self.latent_dim)
        draws = [self._draw(x, generator) for _ in range(0, steps, self.code_len)]
        return torch.stack(draws, dim=1)

    def _draw(self, x: Tensor, generator: Noise) -> Tensor:
        return standard_normal((len(x), self.latent_dim), generator, x)

    def _parts(self, states: Tensor, truth: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Features of states (..., B, K, dx) and truths (B, K, dx), in pieces of H steps."""
        pieces = (self.features(part).split(self.code_len, dim=-2) for part in (states, truth))
        return list(zip(*pieces, strict=True))
