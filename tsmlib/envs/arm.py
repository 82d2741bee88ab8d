"""Base of both simulators: resets, rewards, and the Gymnasium interface. The state's layout is in
``geometry``.

Letters in shapes: N episodes, T steps, dx state size, du = 2 action size. A simulator subclasses
`ArmVectorEnv` with its abstract methods. One arm, `ArmEnv`, is N = 1 of the same code.
"""

import secrets
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tsmlib.envs import geometry
from tsmlib.envs.geometry import DT, MAX_OVERLAP, closest_gap, fingertip
from tsmlib.envs.physics import Changes, Physics
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.unstable import SimulationUnstable

Info = dict[str, np.ndarray]  # of reset and step, and the options of reset


class Variant:
    """An environment that Gymnasium's record names by the physics that it has."""

    physics: Physics

    @property
    def spec(self) -> GymnasiumSpec | None:
        """Gymnasium's record of how this was made, under the id of the variant that it is."""
        return self._spec

    @spec.setter
    def spec(self, made: GymnasiumSpec | None) -> None:
        if made is not None:
            named = replace(EnvSpec.parse(made.id), physics=self.physics).registered()
            made = replace(made, id=named.id)
        self._spec = made


class ArmVectorEnv(Variant, VectorEnv, ABC):
    """N independent arms. Episodes are not reset on their own: ``truncated`` turns true after the
    last step.

    ``reset(seed, options)``: ``options["states"]`` (N, dx) starts the episodes there,
    ``options["target"]`` (2,) or (N, 2) sets the target. Without them, episode i is drawn from
    (seed, i) alone, so it does not depend on N.

    mass, damping, link_lengths, object_radius, torque_gain: those of `Physics`; ``env_id`` and
    Gymnasium's ``spec.id`` name the variant that they make.
    """

    metadata = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / DT),
        "autoreset_mode": AutoresetMode.DISABLED,
    }
    angles = (0, 1)
    dt = DT

    def __init__(
        self,
        num_envs: int,
        env_id: str,
        *,
        max_episode_steps: int = 100,
        render_mode: str | None = None,
        **changes: Unpack[Changes],
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; expected at least 1")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; expected None or 'rgb_array'")
        self._arm = EnvSpec.parse(env_id).varied(**changes).registered()
        self.num_envs = num_envs
        self.env_id = self._arm.id
        self.task = self._arm.task
        self.physics = self._arm.physics
        self.max_episode_steps, self.render_mode = max_episode_steps, render_mode
        dx = self._arm.state_dim
        self.names, self.units = geometry.STATE_NAMES[:dx], geometry.STATE_UNITS[:dx]
        self.single_observation_space = Box(-np.inf, np.inf, (dx,), np.float64)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seed_root: int | None = None  # of the last reset with a seed
        self._resets = 0
        self._elapsed: int | None = None  # steps since reset; None before the first
        self._states = np.zeros((num_envs, dx))
        self.target = np.zeros((num_envs, 2))

    @abstractmethod
    def _start(self, states: np.ndarray) -> None:
        """Put the N episodes into ``states`` (N, dx); the fingertip in them already fits the
        angles.
        """

    @abstractmethod
    def _simulate(self, actions: np.ndarray) -> np.ndarray:
        """Advance by float64 ``actions`` (N, T, 2), finite and in [-1, 1], to states (N, T, dx).

        Raises SimulationUnstable, ``step`` counted from the beginning of ``actions``; `rollout`
        adds those before.
        """

    def image(self, state: np.ndarray, target: np.ndarray) -> np.ndarray:
        """One state (dx,) and target (2,) drawn, as uint8 (height, width, 3)."""
        from tsmlib.envs.render import render_array  # and with it matplotlib

        return render_array(state, self.env_id, target)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start N episodes; gives states (N, dx) and ``{"target": (N, 2)}``."""
        options = options or {}
        if unknown := set(options) - {"states", "target"}:
            raise ValueError(
                f"unknown reset options {sorted(unknown)}; expected 'states' and 'target'"
            )
        super().reset(seed=seed)
        if seed is not None or self._seed_root is None:
            self._seed_root, self._resets = (secrets.randbits(64) if seed is None else seed), 0
        root = (self._seed_root, self._resets)
        rngs = (np.random.default_rng((*root, i)) for i in range(self.num_envs))
        self._resets += 1
        if "states" in options:
            states = self._checked(options["states"], self._states.shape, "states")
            states[:, 4:6] = fingertip(states[:, :2], self.physics.link_lengths)
            self._require_apart(states)
            target = np.stack([_in_ring(rng, *geometry.target_ring(self._arm)) for rng in rngs])
        else:
            states, target = (np.stack(part) for part in zip(*map(self._draw, rngs), strict=True))
        if "target" in options:
            given = np.asarray(options["target"], np.float64)
            target = self._checked(
                np.broadcast_to(given, target.shape) if given.ndim == 1 else given,
                target.shape,
                "target",
            )
        self._states, self.target, self._elapsed = states, target, 0
        self._start(states)
        return states.copy(), {"target": target.copy()}

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        """Advance by ``actions`` (N, T, 2), clipped to [-1, 1], and give the states (N, T, dx)
        after each.

        Raises ValueError (nothing simulated) where an action is not finite, SimulationUnstable as
        its name says.
        """
        if self._elapsed is None:
            raise gymnasium.error.ResetNeeded(
                f"{self.env_id}: call reset() before step() or rollout()"
            )
        actions = self.checked(actions)
        if actions.shape[1] == 0:
            return np.zeros((self.num_envs, 0, len(self.names)))
        try:
            states = self._simulate(np.clip(actions, -1.0, 1.0))
        except SimulationUnstable as fault:
            step = self._elapsed + fault.step
            raise SimulationUnstable(fault.env, fault.episode, step, fault.reason) from None
        self._states = states[:, -1].copy()
        self._elapsed += actions.shape[1]
        return states

    def checked(self, actions: np.ndarray) -> np.ndarray:
        """``actions`` as floats; ValueError where they are not of this shape, or not finite."""
        actions = np.asarray(actions, np.float64)
        if actions.ndim != 3 or actions.shape[0] != self.num_envs or actions.shape[2] != 2:
            raise ValueError(
                f"actions are {actions.shape}; {self.env_id} expected (N={self.num_envs}, T, 2)"
            )
        bad = np.argwhere(~np.isfinite(actions))
        if len(bad):
            episode, step, joint = bad[0]
            raise ValueError(
                f"{len(bad)} action(s) for {self.env_id} are not finite, the first in episode "
                f"{episode}, step {step}, "
                f"joint {joint}: {actions[episode, step, joint]}. Nothing was simulated."
            )
        return actions

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One step by actions (N, 2): states (N, dx), rewards (N,), terminated, truncated (N,) and
        the targets.
        """
        states = self.rollout(np.asarray(actions)[:, None])[:, 0]
        moved = states[:, 6:8] if self.task == "push" else states[:, 4:6]
        torque = np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
        reward = -np.linalg.norm(moved - self.target, axis=-1) - np.sum(torque**2, axis=-1)
        truncated = np.full(self.num_envs, (self._elapsed or 0) >= self.max_episode_steps)
        return (
            states,
            reward,
            np.zeros(self.num_envs, bool),
            truncated,
            {"target": self.target.copy()},
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One uint8 image (height, width, 3) per episode, or None without
        ``render_mode="rgb_array"``.
        """
        if self.render_mode is None:
            return None
        return tuple(
            self.image(state, target)
            for state, target in zip(self._states, self.target, strict=True)
        )

    def _draw(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A state (dx,) and a target (2,) from the reset distribution."""
        most = np.array(geometry.START_ANGLES[self.task])
        q = rng.uniform(-most, most)
        dq = rng.uniform(-geometry.START_VELOCITY, geometry.START_VELOCITY, 2)
        state = np.concatenate([q, dq, fingertip(q, self.physics.link_lengths)])
        target = _in_ring(rng, *geometry.target_ring(self._arm))
        if self.task == "reach":
            return state, target
        while True:  # the block must not touch the arm
            with_block = np.concatenate(
                [state, _in_ring(rng, *geometry.block_ring(self._arm)), np.zeros(2)]
            )
            if closest_gap(with_block, self.env_id) > geometry.BLOCK_CLEARANCE:
                return with_block, target

    def _require_apart(self, states: np.ndarray) -> None:
        """Raise where a start puts the block into the arm, from where a simulator would throw it
        out.
        """
        if self.task == "reach":
            return
        gap = closest_gap(states, self.env_id)
        if (gap < -MAX_OVERLAP).any():
            episode = int(np.argmax(gap < -MAX_OVERLAP))
            reason = f"block and arm overlap by {-1000 * gap[episode]:.1f} mm"
            reason += f", at most {1000 * MAX_OVERLAP:g} mm may"
            raise SimulationUnstable(self.env_id, episode, 0, reason)

    def _checked(self, given: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
        array = np.array(given, np.float64)
        if array.shape != shape:
            raise ValueError(
                f"reset option {name!r} of {self.env_id} is {array.shape}; expected {shape}"
            )
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            raise ValueError(
                f"reset option {name!r} of {self.env_id} is not finite in episode {bad[0][0]}: "
                f"{array[bad[0][0]]}"
            )
        return array


def _in_ring(rng: np.random.Generator, inner: float, outer: float) -> np.ndarray:
    """A point (2,) uniform over the area between two radii."""
    radius, angle = np.sqrt(rng.uniform(inner**2, outer**2)), rng.uniform(-np.pi, np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])


class OneEnv(gymnasium.Env):
    """One episode: a vector environment of ours with N = 1, so single and bulk simulation agree bit
    for bit.
    """

    def __init__(self, made: Any) -> None:
        self._made, self.vector = made, made.unwrapped
        self.render_mode, self.physics = self.vector.render_mode, self.vector.physics
        self.names, self.units = self.vector.names, self.vector.units
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """As of the vector environment, with options of one episode: states (dx,) and so on."""
        super().reset(seed=seed)
        options = {key: np.asarray(value)[None] for key, value in (options or {}).items()}
        states, info = self._made.reset(seed=seed, options=options)
        return states[0], {key: value[0] for key, value in info.items()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """One step by an action (2,). Never terminates; the registered time limit truncates."""
        states, reward, _, _, info = self._made.step(np.asarray(action)[None])
        info = {key: value[0] for key, value in info.items()}
        return states[0], float(reward[0]), False, False, info

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        """States (T, dx) after actions (T, 2)."""
        return self._made.rollout(np.asarray(actions)[None])[0]

    def render(self) -> np.ndarray | None:
        """A uint8 image (height, width, 3), or None without ``render_mode="rgb_array"``."""
        frames = self.vector.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        self._made.close()


class ArmEnv(Variant, OneEnv):
    """One arm."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / DT)}  # noqa: RUF012
    angles, dt = (0, 1), DT

    def __init__(
        self,
        env_id: str,
        render_mode: str | None = None,
        noise: float = 0.0,
        delay: int = 0,
        **changes: Unpack[Changes],
    ) -> None:
        plain = EnvSpec.parse(env_id).varied(**changes)
        name = replace(plain, noise=noise, delay=delay).registered().id
        super().__init__(gymnasium.make_vec(name, num_envs=1, render_mode=render_mode))
        self.env_id, self.task = plain.registered().id, plain.task

    @property
    def target(self) -> np.ndarray:
        """The task's target (2,)."""
        return self.vector.target[0]
