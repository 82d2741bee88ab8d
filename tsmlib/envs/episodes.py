"""What all episodes of foreign environments share, and what is tried on copies before the first."""

from __future__ import annotations

import secrets
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import gymnasium
import numpy as np

from tsmlib.checks import require_count
from tsmlib.envs.ids import UnsupportedEnvironment, layers
from tsmlib.envs.spaces import Description, flat, within_bounds
from tsmlib.envs.unstable import SimulationUnstable

TRIED = 10  # steps of a copy, before the first episode
Seeds = int | Sequence[int] | None  # of the first episode, those after it following; or of each


class Episodes:
    """What is the same however an environment is stepped: its description, and its episodes."""

    def __init__(self, robot: Description, n: int) -> None:
        self.robot, self.num_envs = robot, n
        self.id, self.dt, self.idle, self.actions = robot.id, robot.dt, robot.idle, robot.actions
        self.names, self.units, self.angles = robot.names, robot.units, robot.angles
        self.action_dim = len(robot.idle)
        self._begin([np.zeros(len(robot.names))] * n)

    def _begin(self, states: list[np.ndarray]) -> np.ndarray:
        self.last = np.stack(states)
        self.steps, self.returns = np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs)
        self.ended, self.terminated = (np.zeros(self.num_envs, bool) for _ in range(2))
        for i, state in enumerate(self.last):
            self._require_finite(state[None], i)
        return self.last.copy()

    def _seeds(self, seed: Seeds, states: np.ndarray | None) -> list[int]:
        if states is not None:
            raise UnsupportedEnvironment(
                f"{self.id} cannot begin in given states, since an observation is not all of its "
                "state; name the seed "
                "of its reset instead, or one for each episode: seed=[0, 1, ...]"
            )
        if seed is None:
            seed = secrets.randbits(31)
        if isinstance(seed, Iterable):
            seeds = [require_count("a seed", s, least=0) for s in seed]
        else:
            first = require_count("seed", seed, least=0)
            seeds = list(range(first, first + self.num_envs))
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"{len(seeds)} seeds for {self.num_envs} episodes of {self.id}; expected one each"
            )
        return seeds

    def _commands(self, actions: np.ndarray) -> np.ndarray:
        """Actions (N, T, du) as the environment takes them; ValueError where they are something
        else.
        """
        if actions.ndim != 3 or actions.shape[::2] != (self.num_envs, self.action_dim):
            raise ValueError(
                f"actions are {actions.shape}; {self.id} expected ({self.num_envs}, T, "
                f"{self.action_dim})"
            )
        if not np.isfinite(actions).all():
            raise ValueError(f"an action for {self.id} is not finite; nothing was simulated")
        return within_bounds(actions, self.robot.actions)

    def _state(self, observation: Any) -> np.ndarray:
        return flat(self.id, self.robot.observations, observation)

    def _require_finite(self, states: np.ndarray, i: int) -> None:
        """SimulationUnstable unless all that episode i came to (T, dx) is finite."""
        wrong = ~np.isfinite(states)
        if wrong.any():
            t, d = np.argwhere(wrong)[0].tolist()
            reason = f"{self.names[d]} is {states[t, d]}"
            raise SimulationUnstable(self.id, i, int(self.steps[i]) + t, reason)

    def _note(self, i: int, state: np.ndarray, reward: Any, over: Any, late: Any) -> None:
        """One step of episode i."""
        self._require_finite(state[None], i)
        self.returns[i] += one_number(self.id, "reward", reward)
        self.steps[i] += 1
        self.terminated[i] = bool(one_number(self.id, "terminated", over))
        self.ended[i] = self.terminated[i] or bool(one_number(self.id, "truncated", late))
        self.last[i] = state

    def _examine(
        self, another: Callable[[], Any], *, beside: bool, envs: Sequence[Any] = ()
    ) -> None:
        """Try two other copies, before the first episode, unless these are among ``envs``.

        It is said aloud where one does not begin again where it began, and refused where one moves
        as another is stepped, if they run ``beside`` each other. dt is the time that passed, where
        the clocks know.
        """
        with closing(another()) as one, closing(another()) as two:
            if any(one.unwrapped is env.unwrapped for env in (two, *envs)):
                return
            first, ratio = self._tried(one)
            again, _ = self._tried(one)
            if not np.array_equal(first[0], again[0], equal_nan=True):
                d = int(np.argmax(np.abs(first[0] - again[0])))
                warnings.warn(
                    f"{self.id} does not begin again where it began: two resets with seed 0 "
                    f"gave {self.names[d]} = {first[0][d]:g} and {again[0][d]:g}. Its episodes "
                    "cannot be repeated, so plans are executed from elsewhere than they were made "
                    "for. Let its reset draw from self.np_random after super().reset(seed=seed), "
                    "and leave out wrappers that remember",
                    stacklevel=5,
                )
            same = np.array_equal(first, again, equal_nan=True)
            beside = beside and same
            if beside and not np.array_equal(first, self._tried(one, two)[0], equal_nan=True):
                raise UnsupportedEnvironment(
                    f"copies of {self.id} share a state: one moves elsewhere while another is "
                    "stepped. Keep what changes on self, not on the class, in the module or on a "
                    "space; or give each copy a process: gymnasium.make_vec(id, num_envs=N, "
                    "vectorization_mode='async')"
                )
        self.dt *= ratio

    def _tried(
        self, env: gymnasium.Env, other: gymnasium.Env | None = None
    ) -> tuple[list[np.ndarray], float]:
        """What an episode of random actions comes to, while ``other`` has one of its own.

        Also how many times as long as dt its steps took.
        """
        states = [self._state(reset_once(self.id, env, 0))]
        clock, running = _clock(env), [env]
        if other is not None:
            reset_once(self.id, other, 1)
            running = [other, env]
        with _counted(env) as calls:
            for u in np.random.default_rng(0).uniform(-1, 1, (TRIED, self.action_dim)):
                for one in tuple(running):
                    command = within_bounds(-u if one is other else u, self.robot.actions)
                    result = step_once(self.id, one, command)
                    if one is env:
                        states.append(self._state(result[0]))
                    if np.any(result[2]) or np.any(result[3]):
                        running.remove(one)
                if env not in running:
                    break
        taken, passed = len(states) - 1, _clock(env) - clock
        ratio = passed / (self.dt * taken) if passed > 0 else len(calls) / taken
        return states, 1.0 if abs(ratio - 1) < 0.01 else ratio


def reset_once(env_id: str, env: gymnasium.Env, seed: int) -> Any:
    try:
        result = env.reset(seed=seed)
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        raise UnsupportedEnvironment(
            f"reset of {env_id} does not take what Gymnasium gives it, {error}; expected "
            "reset(self, *, seed=None, options=None)"
        ) from error
    if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
        raise UnsupportedEnvironment(
            f"reset of {env_id} returned {result!s:.80}; Gymnasium expects (observation, info)"
        )
    return result[0]


def step_once(env_id: str, env: gymnasium.Env, command: np.ndarray) -> tuple[Any, ...]:
    try:
        result: Any = env.step(command)
    except ValueError as error:
        if "values to unpack" not in str(error):
            raise
        result = error  # of a wrapper, which unpacks it
    if not isinstance(result, tuple) or len(result) != 5:
        raise UnsupportedEnvironment(
            f"step of {env_id} returned {result!s:.80}; Gymnasium expects (observation, reward, "
            "terminated, truncated, "
            "info)"
        )
    return result


def one_number(env_id: str, what: str, value: Any) -> float:
    """One number, also of shape (1,)."""
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "fiub":
        raise UnsupportedEnvironment(f"{what} of {env_id} is {value!r:.80}; expected one number")
    return float(array.reshape(-1)[0])


def require_steady(env_id: str, env: Any) -> None:
    """UnsupportedEnvironment where an observation depends on all that was seen before."""
    if any(type(layer).__name__ == "NormalizeObservation" for layer in layers(env)):
        raise UnsupportedEnvironment(
            f"{env_id} is wrapped in NormalizeObservation, whose units drift with all that it has "
            "seen: the same seed "
            "and actions do not repeat an episode. Leave it out; models here scale their data "
            "themselves"
        )


def _clock(env: gymnasium.Env) -> float:
    """MuJoCo's seconds; 0 without it."""
    data: Any = getattr(env.unwrapped, "data", None)
    return float(data.time) if type(data).__name__ == "MjData" else 0.0


@contextmanager
def _counted(env: gymnasium.Env) -> Iterator[list[None]]:
    """Within, an entry for every step of the layer that says dt, which wrappers may repeat."""
    layer: Any = next((layer for layer in layers(env) if hasattr(layer, "dt")), env.unwrapped)
    calls, step = list[None](), layer.step

    def counted(action: Any) -> Any:
        calls.append(None)
        return step(action)

    layer.step = counted
    try:
        yield calls
    finally:
        del layer.step
