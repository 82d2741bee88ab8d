"""Imperfect sensors and actuators, as ordinary Gymnasium wrappers (the paper's robustness study,
section 5).
"""

from collections import deque
from typing import Unpack

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from tsmlib.envs.arm import ArmVectorEnv, Info
from tsmlib.envs.geometry import HALF_RANGE
from tsmlib.envs.physics import Changes
from tsmlib.envs.spec import EnvSpec

NOISE_STREAM = (
    2**32 - 1
)  # keeps the noise apart from the starts and targets of any reset, counted from 0, of this seed


class SensorNoise(gymnasium.Wrapper, RecordConstructorArgs):
    """The observed state is x + sigma * scale * eps with eps ~ N(0, 1), drawn anew at each step and
    dimension.

    sigma: noise in units of data scaled to [-1, 1]; scale (dx,): half of each dimension's range in
    the data. The world and the reward stay as they are; ``info["state"]`` (dx,) holds the true
    state. Drawn from the seed given to ``reset``. ValueError where sigma or scale make no sense.
    """

    def __init__(self, env: gymnasium.Env, sigma: float, scale: np.ndarray) -> None:
        RecordConstructorArgs.__init__(self, sigma=sigma, scale=scale)
        super().__init__(env)
        self.sigma, self.scale = float(sigma), np.array(scale, np.float64)
        if not (np.isfinite(self.sigma) and self.sigma >= 0.0):
            raise ValueError(f"sigma is {sigma}; expected a finite number of at least 0")
        expected = env.observation_space.shape
        if self.scale.shape != expected:
            raise ValueError(
                f"scale is {self.scale.shape}; expected {expected}, one half range per state "
                "dimension"
            )
        if not (np.isfinite(self.scale).all() and (self.scale >= 0.0).all()):
            raise ValueError(f"scale is {self.scale}; expected finite half ranges of at least 0")
        self._noise = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        if seed is not None:
            self._noise = np.random.default_rng([seed, NOISE_STREAM])
        state, info = self.env.reset(seed=seed, options=options)
        return self._observed(state), info | {"state": state}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        state, reward, terminated, truncated, info = self.env.step(action)
        return self._observed(state), float(reward), terminated, truncated, info | {"state": state}

    def _observed(self, state: np.ndarray) -> np.ndarray:
        return state + self.sigma * self.scale * self._noise.standard_normal(state.shape)


class ActionDelay(gymnasium.Wrapper, RecordConstructorArgs):
    """Actions arrive ``tau`` steps late: step t applies u_{t - tau}, and the first ``tau`` steps
    apply zero.

    The reward charges the action that is applied; ``reset`` forgets those on the way. ValueError
    where tau is not a whole number of at least 0.
    """

    def __init__(self, env: gymnasium.Env, tau: int) -> None:
        RecordConstructorArgs.__init__(self, tau=tau)
        super().__init__(env)
        if isinstance(tau, bool) or not isinstance(tau, int | np.integer) or tau < 0:
            raise ValueError(f"tau is {tau!r}; expected a whole number of steps, at least 0")
        if not isinstance(env.action_space, gymnasium.spaces.Box):
            raise ValueError(
                f"the action space is {env.action_space}; expected a Box, where zero means no "
                "torque"
            )
        self.tau, self._nothing = int(tau), np.zeros_like(env.action_space.low)
        self._on_the_way: deque[np.ndarray] = deque()

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        self._on_the_way = deque([self._nothing] * self.tau)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Take ``action`` now, apply the one from ``tau`` steps ago."""
        self._on_the_way.append(np.array(action))
        state, reward, terminated, truncated, info = self.env.step(self._on_the_way.popleft())
        return state, float(reward), terminated, truncated, info


class ImperfectArms(VectorWrapper):
    """What `SensorNoise` and `ActionDelay` do to one arm, done to N of them, with ``rollout`` for
    whole sequences.

    sigma, scale (dx,): noise of the observed states; tau: delay of the actions, steps. The noise of
    episode i is a function of the seed given to ``reset`` and of i, so it does not depend on N. The
    reward is that of the true states.
    """

    def __init__(self, env: VectorEnv, *, sigma: float, scale: np.ndarray, tau: int) -> None:
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
            self._noise = [
                np.random.default_rng([seed, NOISE_STREAM, i]) for i in range(self.num_envs)
            ]
        states, info = self._arms.reset(seed=seed, options=options)
        self._seen, self._on_the_way = [states[:, None]], np.zeros_like(self._on_the_way)
        return self._observed(states[:, None])[:, 0], info | {"state": states}

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        """Take actions (N, T, 2), apply those from tau steps ago, and give the noisy states (N, T,
        dx) after each.
        """
        given = np.concatenate([self._on_the_way, self._arms.checked(actions)], axis=1)
        split = given.shape[1] - self.tau
        states = self._arms.rollout(given[:, :split])
        self._on_the_way = given[:, split:]
        self._seen.append(states)
        return self._observed(states)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """As the arms', with the noisy states; ``info["state"]`` (N, dx) holds the true ones."""
        given = np.concatenate(
            [self._on_the_way, self._arms.checked(np.asarray(actions)[:, None])], axis=1
        )
        states, reward, terminated, truncated, info = self._arms.step(given[:, 0])
        self._on_the_way = given[:, 1:]
        self._seen.append(states[:, None])
        return (
            self._observed(states[:, None])[:, 0],
            reward,
            terminated,
            truncated,
            info | {"state": states},
        )

    def _observed(self, states: np.ndarray) -> np.ndarray:
        if not self.sigma:
            return states.copy()
        drawn = np.stack([generator.standard_normal(states.shape[1:]) for generator in self._noise])
        return states + self.sigma * self.scale * drawn


def imperfect_arm(
    env_id: str,
    noise: float,
    delay: int,
    render_mode: str | None = None,
    **changes: Unpack[Changes],
) -> ActionDelay:
    """One arm behind both wrappers, as Gymnasium makes it."""
    arm = gymnasium.make(
        env_id, disable_env_checker=True, render_mode=render_mode, **changes
    ).unwrapped
    return ActionDelay(SensorNoise(arm, noise, _half_range(env_id)), delay)


def imperfect_arms(
    num_envs: int,
    env_id: str,
    noise: float,
    delay: int,
    *,
    max_episode_steps: int = 100,
    render_mode: str | None = None,
    **changes: Unpack[Changes],
) -> ImperfectArms:
    """N arms with both, as Gymnasium makes them."""
    arms = gymnasium.make_vec(
        env_id,
        num_envs=num_envs,
        max_episode_steps=max_episode_steps,
        render_mode=render_mode,
        **changes,
    )
    return ImperfectArms(arms, sigma=noise, scale=_half_range(env_id), tau=delay)


def _half_range(env_id: str) -> np.ndarray:
    scale = np.array(HALF_RANGE[: EnvSpec.parse(env_id).state_dim])
    if EnvSpec.parse(env_id).task == "obstacle":  # it does not move, and nobody measures how fast
        scale[6:] = 0.25, 0.25, 0.0, 0.0
    return scale
