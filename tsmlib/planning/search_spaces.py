"""Search spaces: torques (Eq. 2) and codes of the action prior (Eq. 3)."""

from __future__ import annotations

import torch
from torch import Tensor

from tsmlib.collection import smooth_torques
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.layers import on_device_of


class DirectActions:
    """Eq. 2: the torques themselves, squashed to the bounds by tanh. Its noise is as smooth as the training torques."""

    def __init__(self, horizon: int, action_dim: int = 2, *, rms: float = 0.1) -> None:
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, expected a positive number of steps")
        self.shape: tuple[int, ...] = (horizon, action_dim)
        self.scale = rms

    def decode(self, parameters: Tensor) -> Tensor:
        return parameters.tanh()

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        (horizon, action_dim), settle = (
            self.shape,
            20,
        )  # steps until the smooth noise has its full variance
        torques = smooth_torques(
            n * n_targets, settle + horizon, generator=generator, action_dim=action_dim, rms=0.1
        )
        return torques[:, settle:].unflatten(0, (n, n_targets)) / 0.1

    def after(self, parameters: Tensor, steps: int) -> tuple[DirectActions, Tensor]:
        return DirectActions(self.shape[0] - steps, self.shape[1], rms=self.scale), parameters[
            :, steps:
        ]


class LatentActions:
    """Eq. 3: one latent code per segment, decoded by the action prior. T must be a multiple of H.

    past: the actions before the plan (B, L, du), U_0 = 0 without. whole: refuse a horizon that is no multiple of H;
    if not, the end of the last segment is cut off.
    """

    scale = 1.0

    def __init__(
        self, prior: ActionPrior, horizon: int, *, past: Tensor | None = None, whole: bool = True
    ) -> None:
        n_segments = -(-horizon // prior.segment_len)
        if horizon < 1 or (whole and n_segments * prior.segment_len != horizon):
            raise ValueError(
                f"a horizon of {horizon} steps is not a whole number of segments of {prior.segment_len}; "
                f"choose {max(1, horizon // prior.segment_len) * prior.segment_len}"
            )
        self.prior, self.horizon, self.past = prior, horizon, past
        self.shape: tuple[int, ...] = (n_segments, prior.latent_dim)

    def decode(self, parameters: Tensor) -> Tensor:
        return self._whole(parameters)[:, :, : self.horizon]

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        return torch.randn(n, n_targets, *self.shape, generator=generator)

    @torch.no_grad()
    def after(self, parameters: Tensor, steps: int) -> tuple[LatentActions, Tensor]:
        """Codes that begin with a segment stay as they are. Otherwise the rest of the plan is cut into new segments,
        and its codes are those that the prior's encoder gives them: nearly the same actions."""
        prior, left = self.prior, self.horizon - steps
        actions = self._whole(parameters[None])[0]  # (B, K H, du)
        past = torch.cat([self._before(len(actions)).to(actions.device), actions[:, :steps]], dim=1)
        space = LatentActions(prior, left, past=past[:, -prior.past_len :], whole=False)
        done, within = divmod(steps, prior.segment_len)
        if not within:
            return space, parameters[:, done:]
        rest = actions[:, steps : steps + space.shape[0] * prior.segment_len]
        missing = space.shape[0] * prior.segment_len - rest.shape[1]
        rest = torch.cat([rest, rest[:, -1:].expand(-1, missing, -1)], dim=1)
        codes, _ = prior.encode(
            *on_device_of(prior, rest.reshape(-1, prior.segment_len, rest.shape[2]))
        )
        return space, codes.to(parameters.device).unflatten(0, (len(rest), -1))

    def _whole(self, parameters: Tensor) -> Tensor:
        """Actions (C, B, K H, du)."""
        n, n_targets = parameters.shape[:2]
        start = self._before(n_targets).repeat(n, 1, 1)
        actions = self.prior.plan(*on_device_of(self.prior, start, parameters.flatten(0, 1)))
        return actions.to(parameters.device).unflatten(0, (n, n_targets))

    def _before(self, n_targets: int) -> Tensor:
        if self.past is not None:
            return self.past
        return torch.zeros(
            n_targets, self.prior.past_len, len(self.prior.std), dtype=self.prior.std.dtype
        )
