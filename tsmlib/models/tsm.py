"""TSM, the temporal segment model: a conditional variational autoencoder over whole segments (section 3, A.1).

    encoder   Q(Z | X+)                     1-D convolutions over the future segment
    decoder   P(X+ | X-, U-, U+, Z)         gated dilated causal layers, autoregressive in the states
    prior     P(Z) = N(0, I)

All that is uncertain about a segment lives in its code. The decoder predicts increments of the physical state.
"""

from typing import Unpack, cast

import torch
from torch import Tensor, nn

from tsmlib.models.base import Step
from tsmlib.models.config import Configured
from tsmlib.models.energy import energy_score
from tsmlib.models.features import Featured, Features
from tsmlib.models.layers import (
    CausalDecoder,
    DecoderOptions,
    Encoder,
    chunked,
    kl_from_standard_normal,
    sample_posterior,
    whole_segments,
)
from tsmlib.sampling import Noise, standard_normal
from tsmlib.storage.files import Json
from tsmlib.trajectory import Segment, Window


class TSM(Featured, Configured):
    """Temporal segment model of one environment.

    state_dim, action_dim: dx, du. angles: state dimensions in radians.
    beta: weight of the KL divergence against the summed squared error in standardised units.
    full_encoder: Q(Z | X+, X-, U-, U+) in place of Q(Z | X+), an ablation.
    decoder: options of the ``CausalDecoder``.
        channels, head_channels: 32 and 0 on the basic arm, 64 and 128 where there are contacts (appendix A.1).
        state_skip: above 0, a head of that width that sees state and torque themselves, beyond the paper.
        dilations: receptive field 1 + sum = 20 = 2 H. plain: no residual or skip connections, an ablation.
    """

    stochastic, output_layers = True, ("decoder.head",)

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (),
        segment_len: int = 10,  # H, section 5.1
        latent_dim: int = 8,  # section 5.1
        beta: float = 1.0,
        full_encoder: bool = False,
        **decoder: Unpack[DecoderOptions],
    ) -> None:
        super().__init__()
        self.segment_len = self.past_len = self.code_len = (
            segment_len  # a code is held for a segment
        )
        self.latent_dim = latent_dim
        self.beta = beta
        self.features = Features(state_dim, tuple(angles))
        self.full_encoder = full_encoder
        seen = (
            (self.features.dim + action_dim, 2 * segment_len)
            if full_encoder
            else (self.features.dim, segment_len)
        )
        self.encoder = Encoder(*seen, latent_dim)
        self.decoder = CausalDecoder(
            self.features.dim + action_dim, state_dim, latent_dim, **decoder
        )

    @property
    def code_layers(self) -> tuple[nn.Linear, list[nn.Linear]]:
        """V and the two taps of every layer."""
        return self.decoder.codes, [cast(nn.Linear, layer.taps) for layer in self.decoder.layers]

    @property
    def code_statistics(self) -> nn.Linear:
        """The last layer of the encoder."""
        return self.encoder.project

    def config(self) -> dict[str, Json]:
        options = DecoderOptions.__annotations__
        return super().config() | {
            name: value for name, value in self.decoder.config().items() if name in options
        }

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past (B, L, .), with one code for the segment. No generator: z = 0; with one: z ~ N(0, I)."""
        return self._begin(past, self._code(past, generator))

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """The states (B, K, dx) that ``begin`` steps through, by blocks of rows."""
        return self.decode(past, actions, self._code(past, generator))

    def decode(self, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
        """P(X+ | X-, U-, U+, z), free-running: each state is computed from the predicted one before it."""
        return chunked(self._decode, *past, actions, z)

    def _decode(self, states: Tensor, before: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        step = self._begin(Segment(states, before), z)
        return torch.stack([step(u) for u in actions.unbind(1)], dim=1)  # (B, K, dx)

    def decode_teacher_forced(self, window: Window, z: Tensor) -> Tensor:
        """P(X+ | X-, U-, U+, z) with the true states as inputs, all positions at once: (B, K, dx)."""
        (past, future), n = window, window.future.actions.shape[1]
        before = torch.cat([past.states, future.states[:, :-1]], dim=1)  # x_{t-L+1} .. x_{t+K-1}
        actions = torch.cat(
            [past.actions[:, 1:], future.actions], dim=1
        )  # the action taken in each of them
        increments = self.decoder(self.inputs(before, actions), z, n)
        return before[:, -n:] + self.features.step_std * increments

    def encode(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Q(Z | X+): (B, H, dx) -> mean and log variance (B, dz)."""
        return self.encoder(self.features(states))

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error plus beta KL per segment, free-running through every segment that the window holds (A.1).

        The future is a chain of K = n H steps. Each segment's code comes from its own true states, its past from the
        model's own prediction of the segment before, so that training meets the drift that rollouts meet.
        """
        past, loss = window.past, window.past.states.new_zeros(())
        for future in self._segments(window.future):
            z, kl = self._posterior_code(past, future, generator)
            predicted = self.decode(past, future.actions, z)
            error = self.features.difference(predicted, future.states)
            loss = loss + (error.square().sum((1, 2)) + self.beta * kl).mean()
            past = past.then(Segment(predicted, future.actions)).last(self.past_len)
        return loss

    def teacher_forced_loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error of one-step increments plus beta KL, with true states as inputs."""
        past, loss = window.past, window.past.states.new_zeros(())
        for future in self._segments(window.future):
            z, kl = self._posterior_code(past, future, generator)
            error = self.features.increments(
                self.decode_teacher_forced(Window(past, future), z), future.states
            )
            loss = loss + (error.square().sum((1, 2)) + self.beta * kl).mean()
            past = past.then(future).last(self.past_len)
        return loss

    def energy_loss(self, window: Window, generator: Noise) -> Tensor:
        """Energy score of two free-running samples with codes from the prior, beyond the paper.

        The sum over whole segments, see ``models.energy``. The encoder is not used.
        """
        actions, truth = window.future.actions, self.features(window.future.states)
        samples = []
        past = Segment(*(torch.cat([part, part]) for part in window.past))
        for segment_actions in actions.split(self.segment_len, dim=1):
            u = torch.cat([segment_actions, segment_actions])
            states = self.predict_segment(past, u, generator=generator)
            past = past.then(Segment(states, u)).last(self.past_len)
            samples.append(states)
        drawn = self.features(torch.cat(samples, dim=1)).unflatten(0, (2, -1))  # (2, B, K, .)
        pieces = (part.split(self.segment_len, dim=-2) for part in (drawn, truth))
        return torch.stack([energy_score(*piece) for piece in zip(*pieces, strict=True)]).sum()

    def _posterior_code(
        self, past: Segment, future: Segment, generator: Noise
    ) -> tuple[Tensor, Tensor]:
        """z ~ Q(Z | X+), or Q(Z | X+, X-, U-, U+), and its KL divergence from N(0, I): (B, dz), (B,)."""
        if self.full_encoder:
            whole = past.last(self.segment_len).then(future)
            mean, log_variance = self.encoder(self.inputs(whole.states, whole.actions))
        else:
            mean, log_variance = self.encode(future.states)
        return sample_posterior(mean, log_variance, generator), kl_from_standard_normal(
            mean, log_variance
        )

    def _code(self, past: Segment, generator: Noise | None) -> Tensor:
        shape = (len(past.states), self.latent_dim)
        return (
            past.states.new_zeros(shape)
            if generator is None
            else standard_normal(shape, generator, past.states)
        )

    def _begin(self, past: Segment, z: Tensor) -> Step:
        x, codes = past.states[:, -1], self.decoder.codes(z)
        cache = self.decoder.begin(self.inputs(past.states[:, :-1], past.actions[:, 1:]), z)

        def step(u: Tensor) -> Tensor:
            nonlocal x
            x = x + self.features.step_std * self.decoder.step(self.inputs(x, u), codes, cache)
            return x

        return step

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """What the decoder reads at each position: (..., dx), (..., du) -> (..., input_dim)."""
        return torch.cat([self.features(states), actions], dim=-1)

    def _segments(self, future: Segment) -> list[Segment]:
        parts = zip(*(whole_segments(part, self.segment_len) for part in future), strict=True)
        return [Segment(*part) for part in parts]
