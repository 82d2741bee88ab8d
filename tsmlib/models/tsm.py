"""TSM, the temporal segment model: a conditional variational autoencoder over segments (section 3).

    encoder   Q(Z | X+)                     1-D convolutions over the future segment
    decoder   P(X+ | X-, U-, U+, Z)         gated dilated causal layers, autoregressive
    prior     P(Z) = N(0, I)

    Eq. 1     tanh(W_f * s + V_f^T z) . sigmoid(W_g * s + V_g^T z)         models.layers.GatedLayer
    A.1       sum |f(x) - f(x^)|^2 + beta KL(Q(Z | X+) || P(Z))            TSM.loss

All that is uncertain about a segment lives in its code z. The decoder predicts increments of the
physical state x; f are its standardised features. Up to a factor of 2 sigma^2 = beta, A.1 is the
negative evidence bound of a Gaussian of variance sigma^2 around f(x^): beta = 1 says that features
deviate by 0.7 from what the code tells, so that few codes are worth their nats (sigma-VAE, Rybkin
et al., 2021); a smaller beta makes codes carry more.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from tsmlib.checks import require_counts, require_number
from tsmlib.models.base import Step
from tsmlib.models.energy import energy_score
from tsmlib.models.free_running import free_running
from tsmlib.models.layers import (
    CausalDecoder,
    Encoder,
    chunked,
    kl_from_standard_normal,
    sample_posterior,
    whole_segments,
)
from tsmlib.models.state_model import StateModel
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window

ROWS = 256  # that are decoded at once where no gradient is to come


class TSM(StateModel):
    """Temporal segment model of one robot: the paper's (section 3, Eq. 1, appendix A.1).

    ``TSM.for_data(data)`` makes one that fits the data. A segment of H steps is predicted at once
    from the H steps before it; segments are chained over a horizon (``rollout``).

    Args:
        state_dim: dx, dimensions of a state.
        action_dim: du, dimensions of an action.
        angles: indices of state dimensions that are angles in radians; the model sees their cosine
            and sine.
        segment_len: H, steps of a segment, and of the past that it reads; 10 in section 5.1.
        latent_dim: dz, dimensions of a code z; 8 in section 5.1.
        beta: weight of the KL divergence (nats) against the squared error in units of the
            training data's deviation, 2 sigma^2; 1 is the plain sum of section 3.1.
        channels: C of every gated layer; 32, and 64 where there are contacts (A.1).
        head_channels: of the extra 1x1 layer before the last; 0 for none, 128 where there are
            contacts (A.1).
        dilations: of the gated layers, in steps; their sum plus one, 20 = 2 H, is what the decoder
            sees.
        plain: neither residual nor skip connections, which section 3.1 finds slightly worse.
    """

    stochastic, output_layers = True, ("decoder.head",)

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: Sequence[int] = (),
        segment_len: int = 10,
        latent_dim: int = 8,
        beta: float = 1.0,
        channels: int = 32,
        head_channels: int = 0,
        dilations: Sequence[int] = (1, 2, 4, 8, 4),
        plain: bool = False,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(segment_len=segment_len, latent_dim=latent_dim)
        self.segment_len = self.past_len = self.code_len = segment_len
        self.latent_dim, self.beta = latent_dim, require_number("beta", beta, 0)
        self.encoder = Encoder(self.features.dim, segment_len, latent_dim)
        self.decoder = CausalDecoder(
            self.features.dim + action_dim,
            state_dim,
            latent_dim,
            channels=channels,
            head_channels=head_channels,
            dilations=dilations,
            plain=plain,
        )

    @property
    def code_layers(self) -> tuple[nn.Linear, list[nn.Linear]]:
        """V and the two taps of every layer."""
        return self.decoder.codes, [cast(nn.Linear, layer.taps) for layer in self.decoder.layers]

    @property
    def code_statistics(self) -> nn.Linear:
        """The last layer of the encoder."""
        return self.encoder.project

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past (B, L, .), with one code for the segment: zero, or a draw of N(0, I).

        Args:
            past: states and actions, H steps or more.
            generator: None for the mode.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to.
        """
        return self._begin(past, self.draw(past, generator))

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """Predict the states that ``begin`` steps through, all at once.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1], up to H of them.
            generator: of the code; None for zero, the mode.

        Returns:
            States (B, K, dx) in physical units.
        """
        return self.decode(past, actions, self.draw(past, generator))

    def draw(self, past: Segment, generator: Noise | None) -> Tensor:
        """Give a code (B, dz) for each past: a draw of N(0, I), or without ``generator`` zero."""
        zeros = past.states.new_zeros(len(past.states), self.latent_dim)
        return zeros if generator is None else standard_normal(zeros.shape, generator, zeros)

    def encode(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Encode future states, Q(Z | X+).

        Args:
            states: (B, H, dx) in physical units.

        Returns:
            Mean and log variance of Z, (B, dz) each.
        """
        return self.encoder(self.features(states))

    def decode(self, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
        """Decode P(X+ | X-, U-, U+, z) free-running, each state from the predicted one before it.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1], up to H of them.
            z: codes (B, dz), without unit.

        Returns:
            States (B, K, dx) in physical units.
        """
        most = None if torch.is_grad_enabled() else ROWS
        return chunked(self._decode, *past, actions, z, most=most)

    def _decode(self, states: Tensor, before: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        return free_running(self.decoder, self.features, Segment(states, before), actions, z)

    def decode_teacher_forced(self, window: Window, z: Tensor) -> Tensor:
        """Decode P(X+ | X-, U-, U+, z) with true states as inputs, all positions at once.

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            z: codes (B, dz), without unit.

        Returns:
            States (B, K, dx) in physical units.
        """
        (past, future), n = window, window.future.actions.shape[1]
        before = torch.cat([past.states, future.states[:, :-1]], dim=1)  # x_{t-L+1} .. x_{t+K-1}
        actions = torch.cat([past.actions[:, 1:], future.actions], dim=1)  # taken in each of them
        increments = self.decoder(self.inputs(before, actions), z, n)
        return before[:, -n:] + self.features.step_std * increments

    def loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Sum squared error and beta KL over segments, free-running through the window (A.1).

        Each segment's code comes from its own true states, its past from the model's own prediction
        of the segment before, so that training meets the drift that rollouts meet.

        Args:
            window: past (B, L, .) and future (B, n H, .), in physical units; actions in [-1, 1].
            generator: of the codes, drawn from Q.

        Returns:
            The mean over the batch, a scalar without unit.

        Raises:
            ValueError: the future is not a whole number of segments.
        """
        return self._bound(window, generator, forced=False)

    def encoder_loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Compute ``loss`` with the decoder held, so that the encoder alone is trained.

        Args:
            window: past (B, L, .) and future (B, n H, .), in physical units; actions in [-1, 1].
            generator: of the codes, drawn from Q.

        Returns:
            The mean over the batch, a scalar without unit.

        Raises:
            ValueError: the future is not a whole number of segments.
        """
        held = copy.deepcopy(self)
        held.decoder.requires_grad_(False)
        held.encoder = self.encoder
        return held.loss(window, generator)

    def teacher_forced_loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Sum squared errors of increments and beta KL over segments, true states as inputs.

        Args:
            window: past (B, L, .) and future (B, n H, .), in physical units; actions in [-1, 1].
            generator: of the codes, drawn from Q.

        Returns:
            The mean over the batch, a scalar without unit.

        Raises:
            ValueError: the future is not a whole number of segments.
        """
        return self._bound(window, generator, forced=True)

    def _bound(self, window: Window, generator: torch.Generator, *, forced: bool) -> Tensor:
        """A.1, with the model's own or, ``forced``, with true states as inputs."""
        past, loss = window.past, window.past.states.new_zeros(())
        for future in self._segments(window.future):
            mean, log_variance = self.encode(future.states)
            z = sample_posterior(mean, log_variance, generator)
            kl = kl_from_standard_normal(mean, log_variance)
            if forced:
                seen = future
                predicted = self.decode_teacher_forced(Window(past, future), z)
                error = self.features.increments(predicted, future.states)
            else:
                predicted = self.decode(past, future.actions, z)
                seen = Segment(predicted, future.actions)
                error = self.features.difference(predicted, future.states)
            loss = loss + (error.square().sum((1, 2)) + self.beta * kl).mean()
            past = past.then(seen).last(self.past_len)
        return loss

    def energy_loss(self, window: Window, generator: Noise) -> Tensor:
        """Sum the energy score of two samples over segments (``models.energy``); not in the paper.

        Both samples are free-running; the encoder is not used.

        Args:
            window: past (B, L, .) and future (B, n H, .), in physical units; actions in [-1, 1].
            generator: of the codes, drawn from the prior.

        Returns:
            The mean over the batch, a scalar without unit.

        Raises:
            ValueError: the future is not a whole number of segments.
        """
        past = Segment(*(torch.cat([part, part]) for part in window.past))
        loss = past.states.new_zeros(())
        for future in self._segments(window.future):
            actions = torch.cat([future.actions, future.actions])
            states = self.predict_segment(past, actions, generator=generator)
            samples = self.features(states).unflatten(0, (2, -1))  # (2, B, H, .)
            loss = loss + energy_score(samples, self.features(future.states))
            past = past.then(Segment(states, actions)).last(self.past_len)
        return loss

    def _begin(self, past: Segment, z: Tensor) -> Step:
        x, codes = past.states[:, -1], self.decoder.codes(z)
        cache = self.decoder.begin(self.inputs(past.states[:, :-1], past.actions[:, 1:]), z)

        def step(u: Tensor) -> Tensor:
            nonlocal x
            x = x + self.features.step_std * self.decoder.step(self.inputs(x, u), codes, cache)
            return x

        return step

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Join what the decoder reads at each position.

        Args:
            states: (..., dx) in physical units.
            actions: (..., du) in [-1, 1].

        Returns:
            Standardised features and actions (..., input_dim).
        """
        return torch.cat([self.features(states), actions], dim=-1)

    def _segments(self, future: Segment) -> list[Segment]:
        parts = zip(*(whole_segments(part, self.segment_len) for part in future), strict=True)
        return [Segment(*part) for part in parts]
