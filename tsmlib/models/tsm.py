"""TSM, the temporal segment model: a conditional variational autoencoder over segments (section 3).

    encoder   Q(Z | X+)                     1-D convolutions over the future segment
    decoder   P(X+ | X-, U-, U+, Z)         gated dilated causal layers, autoregressive
    prior     P(Z) = N(0, I), or P(Z | X-, U-, U+), a small network; the second not in the paper

    Eq. 1     tanh(W_f * s + V_f^T z) . sigmoid(W_g * s + V_g^T z)         models.layers.GatedLayer
    A.1       sum |f(x) - f(x^)|^2 + beta KL(Q(Z | X+) || P(Z))            TSM.loss

All that is uncertain about a segment lives in its code z. The decoder predicts increments of the
physical state x; f are its standardised features. Up to a factor of 2 sigma^2 = beta, A.1 is the
negative evidence bound of a Gaussian of variance sigma^2 around f(x^): beta = 1 says that features
deviate by 0.7 from what the code tells, so that few codes are worth their nats (sigma-VAE, Rybkin
et al., 2021); a smaller beta makes codes carry more. The distance |f(x) - f(x^)| in place of its
square is the bound of a density with heavier tails, exp(-distance / beta).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, cast

import torch
from torch import Tensor, nn

from tsmlib.checks import require_choice, require_counts, require_flag, require_number
from tsmlib.models.base import Step
from tsmlib.models.energy import energy_score
from tsmlib.models.free_running import free_running
from tsmlib.models.layers import (
    CausalDecoder,
    CodePrior,
    Encoder,
    chunked,
    kl_divergence,
    sample_posterior,
    whole_segments,
)
from tsmlib.models.state_model import StateModel
from tsmlib.sampling import Noise, random_indices
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
        prior: of the codes; "normal" for N(0, I), the paper's, or "learned" for a network of the
            past and the planned actions, which goes with full_encoder, a smaller beta and
            residual="distance" (``zoo``, "tsm+prior").
        beta: weight of the KL divergence (nats) against the squared error in units of the
            training data's deviation, 2 sigma^2; 1 is the plain sum of section 3.1.
        residual: of a segment in the loss; "square", the paper's, or "distance", which few wild
            segments move less.
        full_encoder: Q(Z | X+, X-, U-, U+) in place of Q(Z | X+), which section 3.1 finds as good.
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
        prior: Literal["normal", "learned"] = "normal",
        beta: float = 1.0,
        residual: Literal["square", "distance"] = "square",
        full_encoder: bool = False,
        channels: int = 32,
        head_channels: int = 0,
        dilations: Sequence[int] = (1, 2, 4, 8, 4),
        plain: bool = False,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(segment_len=segment_len, latent_dim=latent_dim)
        self.segment_len = self.past_len = self.code_len = segment_len
        self.latent_dim, self.beta = latent_dim, require_number("beta", beta, 0)
        self.full_encoder = require_flag("full_encoder", full_encoder)
        seen = self.features.dim + (action_dim if full_encoder else 0)
        self.encoder = Encoder(seen, segment_len * (2 if full_encoder else 1), latent_dim)
        require_choice("prior", prior, ("normal", "learned"))
        self.residual = require_choice("residual", residual, ("square", "distance"))
        sizes = (self.features.dim + action_dim, action_dim, segment_len, latent_dim)
        self.code_prior = CodePrior(*sizes) if prior == "learned" else None
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

    def take_decoder(self, other: TSM) -> None:
        """Take the decoder and statistics of a trained model whose codes carry nothing yet.

        V, by which the decoder knows codes, is drawn anew and small, so that they matter a little.

        Args:
            other: a model of the same robot and sizes; its encoder and prior stay behind.

        Raises:
            ValueError: the two are of other robots or sizes.
        """
        if other.robot is not None and self.robot is not None:
            self.robot.require_same(other.robot, "the model and the one whose decoder it takes")
        v = 0.2 * self.decoder.codes.weight.detach()
        try:
            self.decoder.load_state_dict(other.decoder.state_dict())
        except RuntimeError as error:
            raise ValueError(f"the decoders differ in size: {error}") from error
        self.features.load_state_dict(other.features.state_dict())
        self.decoder.codes.weight.data.copy_(v)

    def begin(
        self, past: Segment, *, planned: Tensor | None = None, generator: Noise | None = None
    ) -> Step:
        """Read the past (B, L, .), with one code for the segment: the prior's mean, or a draw.

        Args:
            past: states and actions, H steps or more.
            planned: (B, k, du), the first k actions of the segment, as far as they are known. A
                learned prior reads them; without them its code may not suit what will be done.
            generator: None for the mode.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to.
        """
        return self._begin(past, self.draw(past, planned, generator=generator))

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """Predict the states that ``begin`` steps through with all of its actions planned.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1], up to H of them.
            generator: of the code; None for the prior's mean.

        Returns:
            States (B, K, dx) in physical units.
        """
        return self.decode(past, actions, self.draw(past, actions, generator=generator))

    def prior(
        self, past: Segment, planned: Tensor | None = None, *, k: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Give P(Z), the prior of the code of the segment that follows.

        Args:
            past: states (B, L, dx) in physical units and actions (B, L, du), H steps or more.
            planned: (B, K, du), the first K <= H actions of the segment; None, none are known.
            k: (B, 1), how many of them a learned prior is shown; None, all.

        Returns:
            Mean and log variance of Z, (B, dz) each.
        """
        if self.code_prior is None:
            zeros = past.states.new_zeros(len(past.states), self.latent_dim)
            return zeros, zeros
        seen = past.last(self.segment_len)
        planned = past.actions[:, :0] if planned is None else planned
        return self.code_prior(self.inputs(seen.states, seen.actions), planned, k)

    def draw(
        self, past: Segment, planned: Tensor | None = None, *, generator: Noise | None = None
    ) -> Tensor:
        """Draw a code of the ``prior``.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            planned: (B, K, du), the first K <= H actions of the segment; None, none are known.
            generator: of the draw; None for the mean.

        Returns:
            Codes (B, dz).
        """
        mean, log_variance = self.prior(past, planned)
        return mean if generator is None else sample_posterior(mean, log_variance, generator)

    def encode(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Encode future states, Q(Z | X+).

        Args:
            states: (B, H, dx) in physical units.

        Returns:
            Mean and log variance of Z, (B, dz) each.

        Raises:
            ValueError: the encoder sees past and actions as well; ``posterior`` gives it both.
        """
        if self.full_encoder:
            raise ValueError(
                "this model has full_encoder, Q(Z | X+, X-, U-, U+), which states alone do not "
                "tell; call model.posterior(past, future)"
            )
        return self.encoder(self.features(states))

    def posterior(self, past: Segment, future: Segment) -> tuple[Tensor, Tensor]:
        """Encode a future, Q(Z | X+), or Q(Z | X+, X-, U-, U+) where there is a ``full_encoder``.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            future: states (B, H, dx) in physical units, and actions (B, H, du).

        Returns:
            Mean and log variance of Z, (B, dz) each.
        """
        if not self.full_encoder:
            return self.encode(future.states)
        whole = past.last(self.segment_len).then(future)
        return self.encoder(self.inputs(whole.states, whole.actions))

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
        """Sum residual and beta KL over segments, free-running through the window (A.1).

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

    def teacher_forced_loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Sum residual of one-step increments and beta KL over segments, true states as inputs.

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
            z, kl = self._posterior_code(past, future, generator)
            if forced:
                seen = future
                predicted = self.decode_teacher_forced(Window(past, future), z)
                error = self.features.increments(predicted, future.states)
            else:
                predicted = self.decode(past, future.actions, z)
                seen = Segment(predicted, future.actions)
                error = self.features.difference(predicted, future.states)
            loss = loss + (self._misfit(error) + self.beta * kl).mean()
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

    def _posterior_code(
        self, past: Segment, future: Segment, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """z ~ Q, (B, dz), and KL(Q || P), (B,).

        A learned prior meets Q a second time with a part of the plan, of which Q learns nothing.
        """
        mean, log_variance = self.posterior(past, future)
        kl = kl_divergence(mean, log_variance, *self.prior(past, future.actions))
        if self.code_prior is not None:
            k = random_indices(self.segment_len, (len(kl), 1), generator, kl.device)
            part = self.prior(past, future.actions, k=k)
            kl = kl + kl_divergence(mean.detach(), log_variance.detach(), *part)
        return sample_posterior(mean, log_variance, generator), kl

    def _misfit(self, error: Tensor) -> Tensor:
        """What segments' errors (B, H, .) cost: (B,)."""
        square = error.square().sum((1, 2))
        return square if self.residual == "square" else (square + 1e-4).sqrt()

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
