"""ActionPrior, the latent action prior: a conditional variational autoencoder over action segments (section 4.2, A.2).

    encoder   Q(Z | U+)
    decoder   P(U+ | Z, U-)     gated dilated causal layers, autoregressive in the actions
    prior     P(Z) = N(0, I)

Planning over its codes explores only actions like those the dynamics model was trained on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Self, cast

import torch
from torch import Tensor

from tsmlib.models.config import Configured, weights_from
from tsmlib.models.layers import (
    CausalDecoder,
    Encoder,
    chunked,
    kl_from_standard_normal,
    sample_posterior,
    whole_segments,
)
from tsmlib.sampling import Noise
from tsmlib.storage.files import Json
from tsmlib.trajectory import Trajectories, Window


class ActionPrior(Configured):
    """Prior over the action segments of one data set. Actions are bounded to [-1, 1] by a squash on the way out.

    beta: weight of the KL divergence against the summed squared error in units of the training actions' deviation.
    """

    std: Tensor  # (du,) of the training actions

    def __init__(
        self,
        action_dim: int,
        *,
        segment_len: int = 10,  # H, section 5.1
        latent_dim: int = 8,  # section 5.1
        channels: int = 32,
        dilations: Sequence[int] = (1, 2, 4, 8, 4),
        beta: float = 0.03,
    ) -> None:
        super().__init__()
        self.segment_len = self.past_len = segment_len
        self.latent_dim = latent_dim
        self.beta = beta
        self.encoder = Encoder(action_dim, segment_len, latent_dim)
        self.decoder = CausalDecoder(
            action_dim, action_dim, latent_dim, channels=channels, dilations=dilations
        )
        self.register_buffer("std", torch.ones(action_dim))

    @classmethod
    def for_data(cls, data: Trajectories, *, seed: int = 0, **options: Json) -> Self:
        """The prior of ``data`` as training starts: its scale, and weights drawn from ``seed``.

        options: those of the constructor.
        """
        make = cast(Callable[..., Self], cls)
        with weights_from(seed):
            prior = make(data.robot.action_dim, **options)
        prior.fit_scale(data)
        return prior

    def fit_scale(self, data: Trajectories | Tensor) -> ActionPrior:
        """Take the scale of training data, or of actions (N, T, du); 1 of one that never changes."""
        flat = (
            data.flatten(0, 1) if isinstance(data, Tensor) else torch.from_numpy(data.flat_actions)
        )
        actions = flat.double()
        varies = actions.amax(0) > actions.amin(0)
        self.std.copy_(torch.where(varies, actions.std(0), 1.0))
        return self

    def encode(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Q(Z | U+): (B, H, du) -> mean and log variance (B, dz)."""
        return self.encoder(actions / self.std)

    def decode(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """P(U+ | U-, z): past actions (B, L, du) and codes (B, dz) -> actions (B, H, du) in [-1, 1]."""
        return chunked(self._decode, past_actions, z)

    def _decode(self, past_actions: Tensor, z: Tensor) -> Tensor:
        u, codes = past_actions[:, -1], self.decoder.codes(z)
        cache = self.decoder.begin(past_actions[:, :-1] / self.std, z)
        actions = []
        for _ in range(self.segment_len):
            step = self.decoder.step(u / self.std, codes, cache)
            u = (u + self.std * step).clamp(-1, 1)
            actions.append(u)
        return torch.stack(actions, dim=1)  # (B, H, du)

    def first(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """The first action of ``decode`` alone, by which a segment policy acts: (B, L, du), (B, dz) -> (B, du)."""
        step = self.decoder.last(past_actions / self.std, z)
        return (past_actions[:, -1] + self.std * step).clamp(-1, 1)

    def plan(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """Chain segments (Eq. 3): past actions (B, L, du) and codes (B, K, dz) -> actions (B, K H, du)."""
        segments = []
        for code in z.unbind(1):
            past_actions = self.decode(past_actions[:, -self.past_len :], code)
            segments.append(past_actions)
        return torch.cat(segments, dim=1)

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Squared error plus beta KL per segment, free-running over the window's future.

        The past of the first segment is the window's; that of each later one is the decoded segment before it.
        """
        past, loss = window.past.actions, window.past.actions.new_zeros(())
        for future in whole_segments(window.future.actions, self.segment_len):
            mean, log_variance = self.encode(future)
            decoded = self.decode(
                past[:, -self.past_len :], sample_posterior(mean, log_variance, generator)
            )
            error = ((decoded - future) / self.std).square().sum((1, 2))
            loss = loss + (error + self.beta * kl_from_standard_normal(mean, log_variance)).mean()
            past = decoded
        return loss
