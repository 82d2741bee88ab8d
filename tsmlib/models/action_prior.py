"""ActionPrior: a conditional variational autoencoder over action segments (section 4.2, A.2).

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

from tsmlib.checks import as_tensor, require_counts, require_number, require_type
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
from tsmlib.trajectory import Robot, Trajectories, Window


class ActionPrior(Configured):
    """Latent prior over the action segments of one data set (section 4.2).

    ``ActionPrior.for_data(data)`` makes one that fits the data. Actions leave it within [-1, 1].

    Args:
        action_dim: du, dimensions of an action.
        segment_len: H, steps of a segment, and of the past actions that it reads; 10 (section 5.1).
        latent_dim: dz, dimensions of a code z; 8 (section 5.1).
        channels: C of every gated layer; 32, as of TSM (A.2).
        dilations: of the gated layers, in steps; as of TSM.
        beta: weight of the KL divergence (nats) against the summed squared error in units of the
            training actions' deviation; 0.03, chosen on validation.

    Attributes:
        robot: whose actions it was trained on; None until there are data.
    """

    std: Tensor  # (du,) of the training actions

    def __init__(
        self,
        action_dim: int,
        *,
        segment_len: int = 10,
        latent_dim: int = 8,
        channels: int = 32,
        dilations: Sequence[int] = (1, 2, 4, 8, 4),
        beta: float = 0.03,
    ) -> None:
        super().__init__()
        require_counts(action_dim=action_dim, segment_len=segment_len, latent_dim=latent_dim)
        self.action_dim, self.latent_dim = action_dim, latent_dim
        self.segment_len = self.past_len = self.code_len = segment_len
        self.beta = require_number("beta", beta, 0)
        self.encoder = Encoder(action_dim, segment_len, latent_dim)
        self.decoder = CausalDecoder(
            action_dim, action_dim, latent_dim, channels=channels, dilations=dilations
        )
        self.register_buffer("std", torch.ones(action_dim))
        self.robot: Robot | None = None

    @classmethod
    def for_data(cls, data: Trajectories, *, seed: int = 0, **options: Json) -> Self:
        """Make the prior of ``data``, ready to be trained on them.

        Args:
            data: training episodes, whose robot and scale of actions the prior takes.
            seed: of the first weights.
            options: arguments of the class by name, beyond action_dim.

        Returns:
            The untrained prior.
        """
        require_type("data", data, Trajectories, "tsmlib.Trajectories")
        robot, make = data.robot, cast(Callable[..., Self], cls)
        with weights_from(seed):
            prior = make(robot.action_dim, **options)
        prior.take_robot(data)
        return prior

    def take_robot(self, data: Trajectories) -> None:
        """Take the robot of training data and, the first time, the scale of their actions.

        Args:
            data: training episodes.
        """
        if self.robot is None:
            self.fit_scale(data)
        self.robot = data.robot

    def fit_scale(self, data: Trajectories | Tensor) -> ActionPrior:
        """Take the standard deviation of training actions as their scale.

        Args:
            data: training episodes, or actions (N, T, du) in [-1, 1].

        Returns:
            The prior itself, where an action that never changes has the scale 1.
        """
        if isinstance(data, Trajectories):
            actions = torch.from_numpy(data.flat_actions)
        else:
            actions = as_tensor("data", data, ("N", "T", self.action_dim)).flatten(0, 1)
        actions = actions.double()
        varies = actions.amax(0) > actions.amin(0)
        self.std.copy_(actions.std(0).where(varies, 1.0))
        return self

    def encode(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Encode action segments, Q(Z | U+).

        Args:
            actions: (B, H, du) in [-1, 1].

        Returns:
            Mean and log variance of Z, (B, dz) each.
        """
        return self.encoder(actions / self.std)

    def decode(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """Decode one action segment per code, P(U+ | U-, z).

        Args:
            past_actions: (B, L, du) in [-1, 1]; zeros at the start of an episode.
            z: codes (B, dz), without unit.

        Returns:
            Actions (B, H, du) in [-1, 1].
        """
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
        """Decode the first action of a segment alone, by which a segment policy acts.

        Args:
            past_actions: (B, L, du) in [-1, 1]; zeros at the start of an episode.
            z: codes (B, dz), without unit.

        Returns:
            Actions (B, du) in [-1, 1], those with which ``decode`` begins.
        """
        step = self.decoder(past_actions / self.std, z, 1)[:, 0]
        return (past_actions[:, -1] + self.std * step).clamp(-1, 1)

    def plan(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """Chain action segments (Eq. 3).

        Args:
            past_actions: (B, L, du), zeros at the start of an episode.
            z: codes (B, K, dz), one for each segment of H steps.

        Returns:
            Actions (B, K H, du) in [-1, 1].
        """
        z = self._own("z", z, ("B", "K", self.latent_dim))
        shape = (len(z), "L", self.action_dim)
        past_actions = self._own("past_actions", past_actions, shape)
        segments = []
        for code in z.unbind(1):
            past_actions = self.decode(past_actions[:, -self.past_len :], code)
            segments.append(past_actions)
        return torch.cat(segments, dim=1)

    def _own(self, name: str, value: Tensor, shape: tuple[int | str, ...]) -> Tensor:
        return as_tensor(name, value, shape, dtype=self.std.dtype, device=self.std.device)

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """Sum squared error and beta KL over segments, free-running over the window's future (A.2).

        The past of the first segment is the window's, that of each later one the decoded segment
        before it.

        Args:
            window: past (B, L, .) and future (B, n H, .), of which the actions in [-1, 1] are read.
            generator: of the codes, drawn from Q.

        Returns:
            The mean over the batch, a scalar without unit.

        Raises:
            ValueError: the future is not a whole number of segments.
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
