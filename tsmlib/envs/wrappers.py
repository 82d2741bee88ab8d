"""Imperfect sensors and actuators, as a Gymnasium wrapper of N arms (section 5.3.3)."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper

from tsmlib.envs.arm import ArmVectorEnv, Info
from tsmlib.envs.geometry import HALF_RANGE
from tsmlib.envs.spec import EnvSpec

# It keeps the noise apart from the starts and targets of any reset, counted from 0, of this seed.
NOISE_STREAM = 2**32 - 1


class ImperfectArms(VectorWrapper):
    """N arms with noisy sensors and late actions, with ``rollout`` for whole sequences.

    The observed state is x + sigma * scale * eps with eps ~ N(0, 1), drawn anew at each step. Step
    t applies u_{t - tau}, the first ``tau`` steps apply zero, and ``reset`` forgets the actions on
    the way. World and reward stay as they are: the reward is that of the true states and charges
    the action that is applied; ``info["state"]`` (N, dx) holds the true states. The noise of
    episode i is a function of the seed given to ``reset`` and of i, so it does not depend on N.
    """

    def __init__(self, env: VectorEnv, *, sigma: float, scale: np.ndarray, tau: int) -> None:
        """Wrap N arms.

        Args:
            env: the arms.
            sigma: noise in units of data scaled to [-1, 1].
            scale: (dx,), half of each dimension's range in the data.
            tau: delay, steps.
        """
        super().__init__(env)
        self.sigma, self.scale, self.tau = sigma, np.asarray(scale, np.float64), tau
        assert isinstance(env.unwrapped, ArmVectorEnv)
        self._arms = env.unwrapped
        self._noise = [np.random.default_rng() for _ in range(env.num_envs)]
        self._seen: list[np.ndarray] = []
        self._on_the_way = np.zeros((env.num_envs, tau, 2))

    @property
    def truth(self) -> np.ndarray:
        """The true states (N, t + 1, dx) since the last reset."""
        return np.concatenate(self._seen, axis=1)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        if seed is not None:
            roots = [[seed, NOISE_STREAM, i] for i in range(self.num_envs)]
            self._noise = [np.random.default_rng(root) for root in roots]
        states, info = self._arms.reset(seed=seed, options=options)
        self._seen, self._on_the_way = [], np.zeros_like(self._on_the_way)
        return self._observed(states[:, None])[:, 0], info | {"state": states}

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        """Take actions (N, T, 2), apply those from tau steps ago; the noisy states (N, T, dx)."""
        arrived, later = self._arrived(actions)
        states = self._arms.rollout(arrived)
        self._on_the_way = later
        return self._observed(states)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """As the arms', with the noisy states; ``info["state"]`` (N, dx) holds the true ones."""
        arrived, later = self._arrived(np.asarray(actions)[:, None])
        states, reward, terminated, truncated, info = self._arms.step(arrived[:, 0])
        self._on_the_way = later
        seen = self._observed(states[:, None])[:, 0]
        return seen, reward, terminated, truncated, info | {"state": states}

    def _arrived(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The actions (N, T, 2) that arrive while ``actions`` are sent, and those on the way."""
        sent = np.concatenate([self._on_the_way, self._arms.checked(actions)], axis=1)
        steps = sent.shape[1] - self.tau
        return sent[:, :steps], sent[:, steps:]

    def _observed(self, states: np.ndarray) -> np.ndarray:
        self._seen.append(states)
        if not self.sigma:
            return states.copy()
        drawn = np.stack([generator.standard_normal(states.shape[1:]) for generator in self._noise])
        return states + self.sigma * self.scale * drawn


def imperfect_arms(
    num_envs: int, env_id: str, noise: float, delay: int, **options: Any
) -> ImperfectArms:
    """N arms with both, as Gymnasium makes them; other options are those of `ArmVectorEnv`."""
    arms = gymnasium.make_vec(env_id, num_envs=num_envs, **options)
    return ImperfectArms(arms, sigma=noise, scale=_half_range(env_id), tau=delay)


def _half_range(env_id: str) -> np.ndarray:
    spec = EnvSpec.parse(env_id)
    scale = np.array(HALF_RANGE[: spec.state_dim])
    if spec.task == "obstacle":  # it does not move, and nobody measures how fast
        scale[6:] = 0.25, 0.25, 0.0, 0.0
    return scale
