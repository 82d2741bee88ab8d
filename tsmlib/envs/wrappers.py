"""Imperfect sensors and actuators, as ordinary Gymnasium wrappers (the paper's robustness study, section 5)."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

NOISE_STREAM = 1  # keeps the noise apart from the draws that the environment makes from the same seed


class SensorNoise(gymnasium.Wrapper, RecordConstructorArgs):
    """The observed state is x + sigma * scale * eps with eps ~ N(0, 1), drawn anew at each step and dimension.

    sigma: noise in units of data scaled to [-1, 1]; scale (dx,): half of each dimension's range in the data.
    The world and the reward stay as they are; ``info["state"]`` (dx,) holds the true state.
    Drawn from the seed given to ``reset``. ValueError where sigma or scale make no sense.
    """

    def __init__(self, env: gymnasium.Env, sigma: float, scale: np.ndarray) -> None:
        RecordConstructorArgs.__init__(self, sigma=sigma, scale=scale)
        super().__init__(env)
        self.sigma, self.scale = float(sigma), np.array(scale, np.float64)
        if not (np.isfinite(self.sigma) and self.sigma >= 0.0):
            raise ValueError(f"sigma is {sigma}; expected a finite number of at least 0")
        expected = env.observation_space.shape
        if self.scale.shape != expected:
            raise ValueError(f"scale is {self.scale.shape}; expected {expected}, one half range per state dimension")
        if not (np.isfinite(self.scale).all() and (self.scale >= 0.0).all()):
            raise ValueError(f"scale is {self.scale}; expected finite half ranges of at least 0")
        self._noise = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """As the environment's, with the noisy state."""
        if seed is not None:
            self._noise = np.random.default_rng([seed, NOISE_STREAM])
        state, info = self.env.reset(seed=seed, options=options)
        return self._observed(state), info | {"state": state}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As the environment's, with the noisy state."""
        state, reward, terminated, truncated, info = self.env.step(action)
        return self._observed(state), float(reward), terminated, truncated, info | {"state": state}

    def _observed(self, state: np.ndarray) -> np.ndarray:
        return state + self.sigma * self.scale * self._noise.standard_normal(state.shape)


class ActionDelay(gymnasium.Wrapper, RecordConstructorArgs):
    """Actions arrive ``tau`` steps late: step t applies u_{t - tau}, and the first ``tau`` steps apply zero.

    The reward charges the action that is applied. ValueError where tau is not a whole number of at least 0.
    """

    def __init__(self, env: gymnasium.Env, tau: int) -> None:
        RecordConstructorArgs.__init__(self, tau=tau)
        super().__init__(env)
        if isinstance(tau, bool) or not isinstance(tau, int | np.integer) or tau < 0:
            raise ValueError(f"tau is {tau!r}; expected a whole number of steps, at least 0")
        if not isinstance(env.action_space, gymnasium.spaces.Box):
            raise ValueError(f"the action space is {env.action_space}; expected a Box, where zero means no torque")
        self.tau, self._nothing = int(tau), np.zeros_like(env.action_space.low)
        self._on_the_way: deque[np.ndarray] = deque()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """As the environment's; actions still on the way are forgotten."""
        self._on_the_way = deque([self._nothing] * self.tau)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take ``action`` now, apply the one from ``tau`` steps ago."""
        self._on_the_way.append(np.array(action))
        state, reward, terminated, truncated, info = self.env.step(self._on_the_way.popleft())
        return state, float(reward), terminated, truncated, info
