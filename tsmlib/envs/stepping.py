"""Any Gymnasium environment with flat Box spaces, simulated by stepping; of MuJoCo's, in bulk where that is the same.

An observation is not a state. An episode is begun by the seed of a reset; one that has begun goes on from a snapshot of
the environment's variables, where it has been tried that this brings it back (`snapshots.abilities`). Actions here lie
in [-1, 1], the bounds of the environment's action space. An episode that ended is not stepped any further: its last
state repeats.

Letters in shapes: N episodes, T steps, dx size of an observation, du of an action.
"""

from __future__ import annotations

import secrets
import warnings
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Space
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from tsmlib.envs.mujoco_bulk import CHUNK, Mismatch, without_log
from tsmlib.envs.snapshots import Snapshot, Step, abilities, play, restore, save
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.unstable import SimulationUnstable

Seeds = int | Sequence[int] | None  # of the first episode, those after it following; or of each

SUPPORTED = "supported are observations that are a Box of one dimension, and actions that are one too, with finite bounds"


class UnsupportedEnvironment(ValueError):
    """An environment that cannot do what was asked of it; the message names it, and what is supported."""


class Simulation(Protocol):
    """N episodes of one environment.

    id: of Gymnasium. dt: seconds per step. names, units: of the state, one word per dimension; angles: its dimensions
    in radians. steps (N,): taken by each until now; ended (N,) and terminated (N,): whether it is over, and whether the
    environment ended it, as opposed to a limit of time. returns (N,): by the environment's own reward; NaN: none kept.
    path: how it simulates, in words.
    """

    id: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    action_dim: int
    steps: np.ndarray
    ended: np.ndarray
    terminated: np.ndarray
    returns: np.ndarray
    path: str

    def reset(self, *, seed: Seeds = None, states: np.ndarray | None = None) -> np.ndarray:
        """Begin N episodes, from ``seed`` or in ``states`` (N, dx); the first states (N, dx)."""
        ...

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        """Go on by ``actions`` (N, T, du) in [-1, 1]: the states (N, T, dx) after each.

        SimulationUnstable where one of them is not finite, or, for the arms, not possible.
        """
        ...

    def close(self) -> None:
        """Give back what the environment holds."""
        ...


def simulation(env: VectorEnv) -> Simulation:
    """The episodes of a vector environment. UnsupportedEnvironment where its spaces are not supported."""
    if hasattr(env, "rollout"):
        return Arms(env)
    return Stepping(env.envs) if type(env) is SyncVectorEnv else Vectorised(env)


def make_simulation(env_id: str, n: int, *, returns: bool = False) -> Simulation:
    """N episodes of the environment of an id: in one copy of it where its state can be set, else in N.

    returns: keep those of the environment's own reward.
    """
    if env_id.startswith("tsm/"):
        EnvSpec.parse(env_id)  # a variant of an arm is registered by this
    if gymnasium.spec(env_id).vector_entry_point is not None:
        return simulation(gymnasium.make_vec(env_id, num_envs=n))
    first = make_supported(env_id)
    if abilities(first).restores:
        return Stepping([first], n, returns=returns)
    more = (make(env_id) for _ in range(n - 1))
    return Stepping([first, *more], returns=returns)


def make_supported(env_id: str) -> gymnasium.Env:
    """The environment of an id; UnsupportedEnvironment, with it closed, where its spaces are not supported."""
    env = make(env_id)
    try:
        require_supported(env_id, env.observation_space, env.action_space)
    except UnsupportedEnvironment:
        env.close()
        raise
    return env


def make(env_id: str, *, render_mode: str | None = None) -> gymnasium.Env:
    """The environment of an id. What MuJoCo has to say of Gymnasium's own robots, whose files are old, is left out."""
    quiet = str(gymnasium.spec(env_id).entry_point).startswith("gymnasium.envs.mujoco")
    with without_log() if quiet else nullcontext():
        return gymnasium.make(env_id, render_mode=render_mode, disable_env_checker=True)


def require_supported(env_id: str, observations: Space, actions: Space) -> tuple[Box, Box]:
    """Both spaces, flat and bounded as they have to be; UnsupportedEnvironment, naming what is supported."""
    if not isinstance(observations, Box) or len(observations.shape) != 1:
        kind = (
            "images"
            if isinstance(observations, Box) and len(observations.shape) in (2, 3)
            else "not flat"
        )
        raise UnsupportedEnvironment(
            f"observations of {env_id} are {kind}, {observations!s:.100}; {SUPPORTED}. Wrap it, for example in "
            "gymnasium.wrappers.FlattenObservation, or in one that gives its features"
        )
    if not isinstance(actions, Box) or len(actions.shape) != 1:
        kind = "discrete" if not isinstance(actions, Box) else "not flat"
        raise UnsupportedEnvironment(
            f"actions of {env_id} are {kind}, {actions!s:.100}; {SUPPORTED}"
        )
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise UnsupportedEnvironment(
            f"actions of {env_id} have no bounds, {actions!s:.100}; {SUPPORTED}. Give it some by "
            "gymnasium.wrappers.RescaleAction, or in its own action space"
        )
    return observations, actions


def within_bounds(actions: np.ndarray, space: Box) -> np.ndarray:
    """Actions (..., du) in [-1, 1] to the bounds of ``space``, in its type."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    scaled = (low + high) / 2 + (high - low) / 2 * np.clip(np.asarray(actions, np.float64), -1, 1)
    return np.clip(scaled.astype(space.dtype), space.low, space.high)


class Arms:
    """The arms, and what else simulates whole sequences by a ``rollout`` of its own; they never end."""

    def __init__(self, env: VectorEnv) -> None:
        arms: Any = env.unwrapped
        self.env: Any = env
        self.id, self.dt = arms.spec.id, arms.dt
        self.names, self.units, self.angles = (
            tuple(arms.names),
            tuple(arms.units),
            tuple(arms.angles),
        )
        self.action_dim = arms.single_action_space.shape[0]
        self.path = "bulk simulation"
        self.steps = np.zeros(env.num_envs, np.int64)
        self.ended = self.terminated = np.zeros(env.num_envs, bool)
        self.returns = np.full(env.num_envs, np.nan)

    def reset(self, *, seed: Seeds = None, states: np.ndarray | None = None) -> np.ndarray:
        self.steps = np.zeros_like(self.steps)
        return self.env.reset(seed=seed, options=None if states is None else {"states": states})[0]

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        states = self.env.rollout(actions)
        self.steps = self.steps + states.shape[1]
        return states

    def close(self) -> None:
        self.env.close()


class _Described:
    """What is the same however an environment is stepped: its description, and the episodes so far."""

    def __init__(
        self, env_id: str, described: Any, observations: Space, actions: Space, n: int
    ) -> None:
        self.id, self.num_envs = env_id, n
        self.space, self.actions = require_supported(env_id, observations, actions)
        dx = self.space.shape[0]
        self.dt = _dt(env_id, described)
        self.names = tuple(getattr(described, "names", ())) or tuple(f"x{d}" for d in range(dx))
        self.units = tuple(getattr(described, "units", ())) or ("",) * dx
        self.angles = tuple(getattr(described, "angles", ()))
        self.action_dim = self.actions.shape[0]
        self._begin(np.zeros((n, dx)))

    def _begin(self, states: np.ndarray) -> None:
        self.last = states
        self.steps, self.returns = np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs)
        self.ended, self.terminated = (np.zeros(self.num_envs, bool) for _ in range(2))

    def _seeds(self, seed: Seeds, states: np.ndarray | None) -> list[int]:
        if states is not None:
            raise UnsupportedEnvironment(
                f"{self.id} cannot begin in given states, since an observation is not all of its state; name the seed "
                "of its reset instead, or one for each episode: seed=[0, 1, ...]"
            )
        if seed is None:
            seed = secrets.randbits(31)
        seeds = (
            [seed + i for i in range(self.num_envs)]
            if isinstance(seed, int)
            else [int(s) for s in seed]
        )
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"{len(seeds)} seeds for {self.num_envs} episodes of {self.id}; expected one each"
            )
        return seeds

    def _commands(self, actions: np.ndarray) -> np.ndarray:
        """Actions (N, T, du) as the environment takes them; ValueError where they are something else."""
        if actions.ndim != 3 or (actions.shape[0], actions.shape[2]) != (
            self.num_envs,
            self.action_dim,
        ):
            raise ValueError(
                f"actions are {actions.shape}; {self.id} expected ({self.num_envs}, T, {self.action_dim})"
            )
        if not np.isfinite(actions).all():
            raise ValueError(f"an action for {self.id} is not finite; nothing was simulated")
        return within_bounds(actions, self.actions)

    def _require_finite(self, states: np.ndarray, i: int) -> None:
        """SimulationUnstable unless all that episode i came to (T, dx) is finite."""
        wrong = ~np.isfinite(states)
        if wrong.any():
            t, d = np.argwhere(wrong)[0].tolist()
            raise SimulationUnstable(
                self.id, i, int(self.steps[i]) + t, f"{self.names[d]} is {states[t, d]}"
            )

    def _checked(self, observation: object) -> np.ndarray:
        found = np.asarray(observation)
        if found.shape != self.space.shape:
            raise UnsupportedEnvironment(
                f"{self.id} gave an observation of shape {found.shape}, but says that they are {self.space.shape}: it "
                f"changes its space; {SUPPORTED}, the same throughout"
            )
        return found


class Stepping(_Described):
    """Episodes that are each stepped in a copy of their own; or ``n`` of them in one copy, from snapshots."""

    def __init__(
        self, envs: Sequence[gymnasium.Env], n: int | None = None, *, returns: bool = False
    ) -> None:
        first = envs[0]
        env_id = first.spec.id if first.spec else type(first.unwrapped).__name__
        super().__init__(
            env_id, first.unwrapped, first.observation_space, first.action_space, n or len(envs)
        )
        self.envs, self.shared = envs, n is not None
        known = abilities(first)
        alike = len(envs) == 1 or (
            first.spec is not None and all(env.spec == first.spec for env in envs)
        )
        self.bulk = known.bulk if alike else None
        why = known.why or "it cannot be told that its copies are alike"
        self.path = "bulk simulation (mujoco.rollout)" if self.bulk else f"stepping: {why}"
        self.keeps_returns, self.derived = returns, known.derived
        self.snapshots: list[Snapshot | None] = [None] * self.num_envs

    def reset(self, *, seed: Seeds = None, states: np.ndarray | None = None) -> np.ndarray:
        first = []
        for i, own in enumerate(self._seeds(seed, states)):
            first.append(self._checked(self._env(i).reset(seed=own)[0]))
            self._leave(i)
        self._begin(np.stack(first).astype(np.float64))
        if not self.keeps_returns:
            self.returns[:] = np.nan
        return self.last

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        commands = self._commands(actions)
        states = np.repeat(self.last[:, None], actions.shape[1], axis=1)
        running = np.flatnonzero(~self.ended) if actions.shape[1] else np.arange(0)
        for i, steps in zip(
            running.tolist(),
            self._simulated(running, commands[running], self.keeps_returns),
            strict=True,
        ):
            self._fill(states[i], steps)
            self._require_finite(states[i, : len(steps)], i)
            self._count(i, steps)
            self._leave(i)
        self.last = states[:, -1].copy() if actions.shape[1] else self.last
        return states

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def outcomes(self, actions: np.ndarray) -> np.ndarray:
        """What would follow under each of C candidates (C, N, T, du): states (C, N, T, dx). The episodes stay."""
        n, _, horizon, _ = actions.shape
        states = np.repeat(np.tile(self.last, (n, 1))[:, None], horizon, axis=1)
        commands = within_bounds(actions, self.actions).reshape(n * self.num_envs, horizon, -1)
        episodes = np.tile(np.arange(self.num_envs), n)
        rows = np.flatnonzero(~self.ended[episodes])
        for row, steps in zip(
            rows, self._simulated(episodes[rows], commands[rows], False), strict=True
        ):
            self._fill(states[row], steps)
        return states.reshape(n, self.num_envs, horizon, -1)

    def _simulated(
        self, episodes: np.ndarray, commands: np.ndarray, rewards: bool
    ) -> Iterator[list[Step]]:
        """What each of ``episodes`` (n,) does under commands (n, T, du); its environment is left where it came to.

        rewards: whether they are asked for; else they may be NaN.
        """
        for at in range(0, len(episodes), CHUNK):
            part = slice(at, at + CHUNK)
            physics: list[np.ndarray | None] = [None] * len(episodes[part])
            if self.bulk is not None:
                starts = np.stack([self.bulk.start(self._enter(i)) for i in episodes[part]])
                physics = [*self.bulk.physics(starts, commands[part])]
            for i, each, simulated in zip(episodes[part], commands[part], physics, strict=True):
                yield self._played(i, each, simulated, rewards)

    def _played(
        self, i: int, commands: np.ndarray, physics: np.ndarray | None, rewards: bool
    ) -> list[Step]:
        """The steps of one episode, from bulk physics where they turn out to be its own."""
        env = self._enter(i)
        if physics is None or self.bulk is None:
            return play(env, commands)
        if self.bulk.only_observes and not rewards and (left := steps_left(env)) is not None:
            seen = self.bulk.observed(
                env, physics[: min(left, len(commands)) * self.bulk.frame_skip + 1]
            )
            spend(env, len(seen))
            return [Step(x, np.nan, False, k + 1 == left) for k, x in enumerate(seen)]
        before = save(env, derived=self.derived) if self.snapshots[i] is None else self.snapshots[i]
        assert before is not None
        try:
            with self.bulk.playing(env, physics, commands):
                return play(env, commands)
        except Mismatch:
            restore(env, before)
            return play(env, commands)

    def _fill(self, states: np.ndarray, steps: list[Step]) -> None:
        """Write what was observed into ``states`` (T, dx), the last of it to the end."""
        seen = np.stack([self._checked(step.observation) for step in steps])
        states[: len(seen)], states[len(seen) :] = seen, seen[-1]

    def _count(self, i: int, steps: list[Step]) -> None:
        self.steps[i] += len(steps)
        self.returns[i] += sum(step.reward for step in steps)
        self.terminated[i] = steps[-1].terminated
        self.ended[i] = steps[-1].terminated or steps[-1].truncated

    def _env(self, i: int) -> gymnasium.Env:
        return self.envs[0 if self.shared else i]

    def _enter(self, i: int) -> gymnasium.Env:
        env, snapshot = self._env(i), self.snapshots[i]
        if self.shared and snapshot is not None:
            restore(env, snapshot)
        return env

    def _leave(self, i: int) -> None:
        if self.shared:
            self.snapshots[i] = save(self._env(i), derived=self.derived)


class Vectorised(_Described):
    """N episodes of any other vector environment, by its own ``step``; what it makes of ended ones is left out."""

    def __init__(self, env: VectorEnv) -> None:
        spec = env.spec or env.unwrapped.spec
        env_id = spec.id if spec else type(env.unwrapped).__name__
        copies = getattr(env.unwrapped, "envs", None)
        described = (
            copies[0].unwrapped if copies else gymnasium.make(spec.id).unwrapped if spec else env
        )
        super().__init__(
            env_id, described, env.single_observation_space, env.single_action_space, env.num_envs
        )
        self.env, self.path = env, "stepping: its copies are stepped together"
        self.mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)

    def reset(self, *, seed: Seeds = None, states: np.ndarray | None = None) -> np.ndarray:
        seeds = self._seeds(seed, states)
        given: Any = seeds  # as copies take them, whatever the signature of VectorEnv.reset says
        if not isinstance(self.env.unwrapped, SyncVectorEnv | AsyncVectorEnv) and (
            seed is None or isinstance(seed, int)
        ):
            given = seeds[0]
        try:
            first, _ = self.env.reset(seed=given)
        except (TypeError, gymnasium.error.Error) as error:
            if given is not seeds:
                raise
            raise UnsupportedEnvironment(
                f"{self.id} takes no seed for each of its episodes ({error!s:.100}); give one for all of them, seed=0"
            ) from error
        self._begin(np.stack([self._checked(x) for x in first]).astype(np.float64))
        return self.last

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        commands = self._commands(actions)
        states = np.repeat(self.last[:, None], actions.shape[1], axis=1)
        for t in range(actions.shape[1]):
            if self.ended.all():
                break
            observed, rewards, terminated, truncated, info = self.env.step(commands[:, t])
            over = terminated | truncated
            for i in np.flatnonzero(~self.ended):
                seen = observed[i]
                if over[i] and self.mode == AutoresetMode.SAME_STEP:
                    seen = info["final_obs"][
                        i
                    ]  # what was observed is the next episode's first state
                states[i, t:] = self._checked(seen)
                self._require_finite(states[i, t : t + 1], int(i))
                self.returns[i] += rewards[i]
                self.steps[i] += 1
                self.terminated[i], self.ended[i] = terminated[i], over[i]
            if over.any() and not self.ended.all() and self.mode == AutoresetMode.DISABLED:
                self.env.reset(options={"reset_mask": over})
        self.last = states[:, -1].copy() if actions.shape[1] else self.last
        return states

    def close(self) -> None:
        self.env.close()


def steps_left(env: gymnasium.Env) -> int | None:
    """Steps until the limit of time of an environment that is wrapped as ``gymnasium.make`` does; None of any other."""
    limit: int | None = None
    layer: Any = env
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, TimeLimit):
            limit = layer._max_episode_steps - (layer._elapsed_steps or 0)
        elif not isinstance(layer, OrderEnforcing | PassiveEnvChecker):
            return None
        layer = layer.env
    return limit


def spend(env: gymnasium.Env, steps: int) -> None:
    """Count ``steps`` towards the limit of time, as if they had been taken one by one."""
    layer: Any = env
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, TimeLimit):
            vars(layer)["_elapsed_steps"] = (layer._elapsed_steps or 0) + steps
        layer = layer.env


def _dt(env_id: str, env: Any) -> float:
    """Seconds per step, as the environment says."""
    found, fps = getattr(env, "dt", None), (getattr(env, "metadata", None) or {}).get("render_fps")
    if isinstance(found, int | float | np.floating) and 0 < found < np.inf:
        return float(found)
    if fps:
        return 1.0 / float(fps)
    warnings.warn(
        f"{env_id} does not say how long a step is; one step counts as one second", stacklevel=4
    )
    return 1.0


def continued(env_id: str, seeds: Sequence[int], actions: np.ndarray) -> Stepping:
    """Episodes that began with the resets of ``seeds`` (B,) and went on by ``actions`` (B, t, du), to go on from.

    UnsupportedEnvironment where its state cannot be set, so that it cannot be tried what would follow.
    """
    one = make_supported(env_id)
    known = abilities(one)
    if not known.restores:
        one.close()
        why = (
            "its state cannot be saved and set"
            if known.repeats
            else "the same seed and actions do not repeat it"
        )
        raise UnsupportedEnvironment(
            f"{env_id} has no oracle and no replay: {why}. Plan through a model instead, tsmlib.model_predictor"
        )
    begun = Stepping([one], len(seeds))
    begun.reset(seed=seeds)
    begun.rollout(actions)
    return begun
