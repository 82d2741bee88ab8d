"""Search spaces: actions (Eq. 2) and codes of the action prior (Eq. 3).

Letters in shapes: C candidates, B targets, T horizon, du action size, K segments of H steps.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import MOST, as_tensor, require_count, require_number, require_type
from tsmlib.collection import smooth_torques
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.layers import on_device_of
from tsmlib.trajectory import Trajectories

SETTLE = 20  # steps until smooth noise has its full variance
UNIT = 0.02  # seconds of a step of the noise, which cancel


class DirectActions:
    """Eq. 2: the actions themselves, squashed to their bounds by tanh.

    Args:
        horizon: T, steps.
        action_dim: du.
        rms: root mean square of the actions to search, of full action: that of the data that the
            model was trained on (0.1 for the arms), since a model is right where it has seen data.
        smoothness: time constant of the noise of candidates, in steps, as of ``smooth_torques``;
            0 is white noise. The arms' data have 1.5.

    Raises:
        TypeError: no ``rms``.
        ValueError: a number out of its range.
    """

    def __init__(
        self,
        horizon: int,
        action_dim: int = 2,
        *,
        rms: float | None = None,
        smoothness: float = 1.5,
    ) -> None:
        if rms is None:
            raise TypeError(
                "rms is missing, the size of the actions to search as a share of full action; "
                "expected that of the model's data: DirectActions.for_data(data, horizon), or "
                "rms=0.1 for the arms"
            )
        steps = require_count("horizon", horizon, most=MOST)
        self.shape: tuple[int, ...] = (steps, require_count("action_dim", action_dim, most=MOST))
        self.scale = require_number("rms", rms, 0, above=True)
        self.smoothness = require_number("smoothness", smoothness, 0)

    @classmethod
    def for_data(cls, data: Trajectories, horizon: int) -> DirectActions:
        """The actions that are like those of ``data``: as large, and as smooth.

        Args:
            data: what the model was trained on.
            horizon: T, steps.

        Returns:
            The search space.

        Raises:
            ValueError: the data hold no action but zero.
        """
        require_type("data", data, Trajectories, "Trajectories, as collect_random gives")
        rms, smoothness = _like_data(data)
        return cls(horizon, data.robot.action_dim, rms=rms, smoothness=smoothness)

    def __repr__(self) -> str:
        steps, du = self.shape
        noise = f"noise of {self.smoothness:.3g} steps" if self.smoothness else "white noise"
        return f"DirectActions({steps} steps, {du} actions, rms {self.scale:.3g}, {noise})"

    def decode(self, parameters: Tensor) -> Tensor:
        """Squash parameters to the bounds of actions by tanh (Eq. 2).

        Args:
            parameters: (C, B, T, du), any real numbers.

        Returns:
            Actions (C, B, T, du) in [-1, 1].
        """
        return parameters.tanh()

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        """Draw white noise, or smooth noise of the same variance.

        Args:
            n: C, candidates.
            n_targets: B, targets.
            generator: of the noise.

        Returns:
            Noise (C, B, T, du), of variance 1.
        """
        horizon, action_dim = self.shape
        if not self.smoothness:
            return torch.randn(n, n_targets, *self.shape, generator=generator)
        torques = smooth_torques(
            n * n_targets,
            SETTLE + horizon,
            generator=generator,
            action_dim=action_dim,
            rms=0.1,
            time_constant=self.smoothness * UNIT,
            dt=UNIT,
        )
        return torques[:, SETTLE:].unflatten(0, (n, n_targets)) / 0.1

    def after(self, parameters: Tensor, steps: int) -> tuple[DirectActions, Tensor]:
        """Take away the actions of a plan that are done.

        Args:
            parameters: (B, T, du), the plan.
            steps: of the plan that are done, fewer than its horizon.

        Returns:
            The space of the rest, and the rest of the parameters.
        """
        horizon, action_dim = self.shape
        rest = DirectActions(
            horizon - steps, action_dim, rms=self.scale, smoothness=self.smoothness
        )
        return rest, parameters[:, steps:]


def _like_data(data: Trajectories) -> tuple[float, float]:
    """Root mean square and time constant, in steps, of the actions of ``data``.

    Noise through two poles e^(-1 / tau) has the autocorrelation 2 k / (1 + k^2), k = e^(-1 / tau).
    """
    episodes = [data.episode(i)[1].astype(np.float64) for i in range(len(data))]
    square = float(np.mean(np.concatenate(episodes) ** 2))
    if not square > 0:
        raise ValueError(
            f"all actions of the {len(data)} episodes of {data.env} are zero; expected data that "
            "move the robot, or DirectActions(horizon, action_dim, rms=...)"
        )
    products = np.concatenate([(u[1:] * u[:-1]).ravel() for u in episodes])
    correlation = float(products.mean()) / square if products.size else 0.0
    if correlation < 0.05:
        return math.sqrt(square), 0.0
    correlation = min(correlation, 0.995)  # 10 steps
    pole = (1 - math.sqrt(1 - correlation**2)) / correlation
    return math.sqrt(square), -1 / math.log(pole)


class LatentActions:
    """Eq. 3: one latent code per segment, decoded by the action prior.

    Args:
        prior: trained, of the robot's actions.
        horizon: T, steps, a multiple of the prior's segment length H.
        past: the actions before the plan (B, L, du); without, the paper's U_0 = 0.
        whole: whether to refuse a horizon that is no multiple of H; if not, the end of the last
            segment is cut off.

    Raises:
        ValueError: a horizon that does not fit; the message names one that does.
    """

    scale = 1.0

    def __init__(
        self,
        prior: ActionPrior,
        horizon: int,
        *,
        past: Tensor | None = None,
        whole: bool = True,
    ) -> None:
        hint = 'an ActionPrior, such as tsmlib.load_pretrained("prior", env=env)'
        require_type("prior", prior, ActionPrior, hint)
        horizon = require_count("horizon", horizon, most=MOST)
        n_segments = -(-horizon // prior.segment_len)
        if whole and n_segments * prior.segment_len != horizon:
            raise ValueError(
                f"horizon is {horizon} steps, not a whole number of segments of "
                f"{prior.segment_len}; choose "
                f"{max(1, horizon // prior.segment_len) * prior.segment_len}"
            )
        self.prior, self.horizon = prior, horizon
        self.past = past
        if past is not None:
            self.past = as_tensor("past", past, ("B", "L", len(prior.std)))
            if self.past.shape[1] < prior.past_len:
                raise ValueError(
                    f"past holds {self.past.shape[1]} actions; expected at least {prior.past_len}"
                )
        self.shape: tuple[int, ...] = (n_segments, prior.latent_dim)

    def __repr__(self) -> str:
        n, dz = self.shape
        return f"LatentActions({self.horizon} steps, {n} codes of {dz} numbers)"

    def decode(self, parameters: Tensor) -> Tensor:
        """Decode codes by the action prior (Eq. 3).

        Args:
            parameters: codes (C, B, K, dz).

        Returns:
            Actions (C, B, T, du) in [-1, 1].
        """
        return self._whole(parameters)[:, :, : self.horizon]

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        """Draw codes from N(0, I).

        Args:
            n: C, candidates.
            n_targets: B, targets.
            generator: of the noise.

        Returns:
            Codes (C, B, K, dz).
        """
        return torch.randn(n, n_targets, *self.shape, generator=generator)

    @torch.no_grad()
    def after(self, parameters: Tensor, steps: int) -> tuple[LatentActions, Tensor]:
        """Take away the actions of a plan that are done.

        Codes that begin with a segment stay as they are. Otherwise the rest of the plan is cut into
        new segments, whose codes come from the prior's encoder: nearly the same actions.

        Args:
            parameters: codes (B, K, dz), the plan.
            steps: of the plan that are done, fewer than its horizon.

        Returns:
            The space of the rest, and its codes.
        """
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
        segments = rest.reshape(-1, prior.segment_len, rest.shape[2])
        codes, _ = prior.encode(*on_device_of(prior, segments))
        return space, codes.to(parameters.device).unflatten(0, (len(rest), -1))

    def _whole(self, parameters: Tensor) -> Tensor:
        """Actions (C, B, K H, du)."""
        n, n_targets = parameters.shape[:2]
        start = self._before(n_targets).repeat(n, 1, 1)
        actions = self.prior.plan(*on_device_of(self.prior, start, parameters.flatten(0, 1)))
        return actions.to(parameters.device).unflatten(0, (n, n_targets))

    def _before(self, n_targets: int) -> Tensor:
        if self.past is None:
            return self.prior.std.new_zeros(n_targets, self.prior.past_len, len(self.prior.std))
        if len(self.past) != n_targets:
            raise ValueError(
                f"past holds the actions before {len(self.past)} plans; expected {n_targets}, one "
                "for each target"
            )
        return self.past
