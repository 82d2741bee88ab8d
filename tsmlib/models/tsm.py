"""TSM, the temporal segment model: a conditional variational autoencoder over whole segments (section 3, A.1).

    encoder   Q(Z | X+)                     1-D convolutions over the future segment
    decoder   P(X+ | X-, U-, U+, Z)         gated dilated causal layers, autoregressive in the states
    prior     P(Z) = N(0, I)

The decoder is deterministic given z: all that is uncertain about a segment lives in its code. It reads cosine and sine
of the angles, standardised velocities and positions, and predicts the increment of the physical state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.features import Features
from tsmlib.models.layers import CausalDecoder, Encoder, chunked, kl_from_standard_normal, sample_posterior
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window


class TSM(nn.Module):
    """Temporal segment model of one environment.

    state_dim, action_dim: dx, du. angles: state dimensions in radians.
    channels, head_channels: 32 and 0 on the basic arm, 64 and 128 where there are contacts (appendix A.1).
    direct_channels: above 0, a head of that width that sees state and torque themselves, beyond the paper.
    beta: weight of the KL divergence against the summed squared error in standardised units.
    full_encoder, plain: ablations, Q(Z | X+, X-, U-, U+) in place of Q(Z | X+), and no residual or skip connections.
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: tuple[int, ...] = (0, 1),
        segment_len: int = 10,  # H, section 5.1
        latent_dim: int = 8,  # section 5.1
        channels: int = 32,
        head_channels: int = 0,
        direct_channels: int = 0,
        dilations: tuple[int, ...] = (1, 2, 4, 8, 4),  # receptive field 20 = 2 H
        beta: float = 1.0,
        full_encoder: bool = False,
        plain: bool = False,
    ) -> None:
        super().__init__()
        self._config = dict(
            state_dim=state_dim, action_dim=action_dim, angles=list(angles), segment_len=segment_len,
            latent_dim=latent_dim, channels=channels, head_channels=head_channels, direct_channels=direct_channels,
            dilations=list(dilations), beta=beta, **({"full_encoder": True} if full_encoder else {}),
            **({"plain": True} if plain else {}),
        )  # fmt: skip
        self.segment_len = self.past_len = segment_len
        self.latent_dim = latent_dim
        self.beta = beta
        self.features = Features(state_dim, tuple(angles))
        self.full_encoder = full_encoder
        seen = (self.features.dim + action_dim, 2 * segment_len) if full_encoder else (self.features.dim, segment_len)
        self.encoder = Encoder(*seen, latent_dim)
        self.decoder = CausalDecoder(
            self.features.dim + action_dim, state_dim, latent_dim,
            channels=channels, head_channels=head_channels, direct_channels=direct_channels, dilations=tuple(dilations),
            plain=plain,
        )  # fmt: skip

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        """(B, L, .), (B, K <= H, du) -> states (B, K, dx). No generator: z = 0; with one: z ~ N(0, I)."""
        return self.decode(past, actions, self._code(past, generator))

    def decode(self, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
        """P(X+ | X-, U-, U+, z), free-running: each state is computed from the predicted one before it."""
        return chunked(self._decode, *past, actions, z)

    def _decode(self, states: Tensor, before: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        step = self._begin(Segment(states, before), z)
        return torch.stack([step(u) for u in actions.unbind(1)], dim=1)  # (B, K, dx)

    def stepper(self, past: Segment, *, generator: Noise | None = None) -> Callable[[Tensor], Tensor]:
        """``predict_segment`` one action at a time, with one code for the segment; see ``dynamics.stepper``."""
        return self._begin(past, self._code(past, generator))

    def decode_teacher_forced(self, window: Window, z: Tensor) -> Tensor:
        """P(X+ | X-, U-, U+, z) with the true states as inputs, all positions at once: (B, K, dx)."""
        (past, future), n = window, window.future.actions.shape[1]
        before = torch.cat([past.states, future.states[:, :-1]], dim=1)  # x_{t-L+1} .. x_{t+K-1}
        actions = torch.cat([past.actions[:, 1:], future.actions], dim=1)  # the action taken in each of them
        increments = self.decoder(self._inputs(before, actions), z, n)
        return before[:, -n:] + self.features.step_std * increments

    def encode(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Q(Z | X+): (B, H, dx) -> mean and log variance (B, dz)."""
        return self.encoder(self.features(states))

    def posterior(self, past: Segment, future: Segment) -> tuple[Tensor, Tensor]:
        """``encode`` of the future states; of the ablation's encoder, which sees past and actions too, its own."""
        if not self.full_encoder:
            return self.encode(future.states)
        whole = past.last(self.segment_len).then(future)
        return self.encoder(self._inputs(whole.states, whole.actions))

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error plus beta KL per segment, free-running through every segment that the window holds.

        The future is a chain of K = n H steps. Each segment's code comes from its own true states, its past from the
        model's own prediction of the segment before, so that training meets the drift that rollouts meet.
        """
        past, loss = window.past, window.past.states.new_zeros(())
        for future in self._segments(window.future):
            mean, log_variance = self.posterior(past, future)
            predicted = self.decode(past, future.actions, sample_posterior(mean, log_variance, generator))
            loss = loss + self._elbo(predicted, future.states, mean, log_variance)
            past = past.then(Segment(predicted, future.actions)).last(self.past_len)
        return loss

    def teacher_forced_loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error of one-step increments plus beta KL, with true states as inputs."""
        loss, past = window.past.states.new_zeros(()), window.past
        for future in self._segments(window.future):
            mean, log_variance = self.posterior(past, future)
            z = sample_posterior(mean, log_variance, generator)
            error = self.features.increments(self.decode_teacher_forced(Window(past, future), z), future.states)
            kl = kl_from_standard_normal(mean, log_variance)
            loss = loss + (error.square().sum((1, 2)) + self.beta * kl).mean()
            past = past.then(future).last(self.past_len)
        return loss

    def energy_loss(self, window: Window, generator: Noise) -> Tensor:
        """Energy score of two free-running samples with codes from the prior, beyond the paper (model tsm+energy).

        E|X - x| - |X - X'| / 2 over each whole segment, a strictly proper score: its minimum is the true conditional
        distribution. The encoder is not used.
        """
        actions, truth = window.future.actions, self.features(window.future.states)
        samples, loss = [], truth.new_zeros(())
        twice = Segment(*(torch.cat([part, part]) for part in window.past))
        past = twice
        for segment_actions in actions.split(self.segment_len, dim=1):
            u = torch.cat([segment_actions, segment_actions])
            states = self.predict_segment(past, u, generator=generator)
            past = past.then(Segment(states, u)).last(self.past_len)
            samples.append(states)
        first, second = self.features(torch.cat(samples, dim=1)).chunk(2)
        for a, b, x in zip(*(s.split(self.segment_len, dim=1) for s in (first, second, truth)), strict=True):
            distances = [_norm(a - x), _norm(b - x), _norm(a - b)]
            loss = loss + ((distances[0] + distances[1] - distances[2]) / 2).mean()
        return loss

    def _code(self, past: Segment, generator: Noise | None) -> Tensor:
        shape = (len(past.states), self.latent_dim)
        return past.states.new_zeros(shape) if generator is None else standard_normal(shape, generator, past.states)

    def _begin(self, past: Segment, z: Tensor) -> Callable[[Tensor], Tensor]:
        x, codes = past.states[:, -1], self.decoder.codes(z)
        cache = self.decoder.begin(self._inputs(past.states[:, :-1], past.actions[:, 1:]), z)

        def step(u: Tensor) -> Tensor:
            nonlocal x
            x = x + self.features.step_std * self.decoder.step(self._inputs(x, u), codes, cache)
            return x

        return step

    def _inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        return torch.cat([self.features(states), actions], dim=-1)

    def _segments(self, future: Segment) -> list[Segment]:
        parts = zip(*(part.split(self.segment_len, dim=1) for part in future), strict=True)
        return [Segment(*part) for part in parts]

    def _elbo(self, predicted: Tensor, states: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
        error = self.features.difference(predicted, states)
        return (error.square().sum((1, 2)) + self.beta * kl_from_standard_normal(mean, log_variance)).mean()


def _norm(difference: Tensor) -> Tensor:
    return (difference.flatten(1).square().sum(1) + 1e-8).sqrt()
