"""Episodes of any environment: our arms in bulk, any other one stepped, N copies for N episodes.

No copy is shared between episodes. An observation is not a state, so an episode begins by the seed
of a reset. One that ended is not stepped any further: its last state repeats. What reset and step
return is copied (``spaces``).

Letters in shapes: N episodes, T steps, dx size of a state, du of an action.
"""

from __future__ import annotations

import secrets
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space, iterate

from tsmlib.checks import require_count
from tsmlib.envs import spaces
from tsmlib.envs.spaces import (
    Description,
    UnsupportedEnvironment,
    canonical,
    describe,
    environment_id,
    find_spec,
    flat,
    idle_action,
    layers,
    said,
    within_bounds,
)
from tsmlib.envs.unstable import SimulationUnstable, import_mujoco, without_log

TRIED = 10  # steps of a copy, before the first episode
Seeds = int | Sequence[int] | None  # of the first episode, those after it following; or of each


class Simulation(Protocol):
    """N episodes of one environment.

    Attributes:
        id: of the environment, with its arguments: ``"Pendulum-v1(g=1.0)"``.
        dt: seconds per step.
        names, units: of the state, one word per dimension.
        angles: dimensions of the state in radians.
        action_dim: du.
        idle: the action (du,) in [-1, 1] that does nothing.
        steps: (N,), taken by each episode until now.
        ended, terminated: (N,), whether it is over, and whether the environment ended it, as
            opposed to a limit of time.
        returns: (N,), by the environment's own reward; NaN where none is kept.
    """

    id: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    action_dim: int
    idle: np.ndarray
    steps: np.ndarray
    ended: np.ndarray
    terminated: np.ndarray
    returns: np.ndarray

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
    """The episodes of a vector environment.

    Raises:
        UnsupportedEnvironment: its spaces are not supported, or its copies are one object.
    """
    made = env.unwrapped.spec
    if hasattr(env, "rollout") and made is not None and made.namespace == "tsm":
        return Arms(env)
    return Stepping(env.envs, env.env_fns[0]) if type(env) is SyncVectorEnv else Vectorised(env)


def make_simulation(env_id: str, n: int) -> Simulation:
    """N episodes of the environment of an id, foreign ones in N copies.

    Args:
        env_id: ``"tsm/ReacherPush-v1"``, ``"Pendulum-v1(g=1.0)"``, ...
        n: episodes.

    Raises:
        UnsupportedEnvironment: its spaces are not supported, or the id does not say how to make it.
    """
    spec = find_spec(env_id)
    if spec.namespace == "tsm" or spec.entry_point is None:
        return simulation(gymnasium.make_vec(spec, num_envs=n))
    envs = copies(env_id, n)
    try:
        return Stepping(envs, lambda: make(env_id), canonical(env_id))
    except BaseException:
        for env in envs:
            env.close()
        raise


def copies(env_id: str, n: int) -> list[gymnasium.Env]:
    """N copies of an environment, closed again where they cannot be used."""
    made: list[gymnasium.Env] = []
    try:
        for _ in range(require_count("episodes", n)):
            made.append(make(env_id))
            spaces.state_names(env_id, made[0].observation_space)
            spaces.require_actions(env_id, made[0].action_space)
    except BaseException:
        for env in made:
            env.close()
        raise
    return made


def make(env_id: str, *, render_mode: str | None = None) -> gymnasium.Env:
    """The environment of an id, which may carry arguments; ``render_mode`` only where it is asked
    for.

    What MuJoCo has to say of Gymnasium's own robots, whose files are old, is left out.
    """
    spec = find_spec(env_id)
    quiet = str(spec.entry_point).startswith("gymnasium.envs.mujoco")
    if quiet:
        import_mujoco()
    shown = {} if render_mode is None else {"render_mode": render_mode}
    with without_log() if quiet else nullcontext():
        return gymnasium.make(spec, disable_env_checker=True, **shown)


class Arms:
    """The arms, and what else of ours simulates whole sequences by ``rollout``; they never end."""

    def __init__(self, env: VectorEnv) -> None:
        arms: Any = env.unwrapped
        self.env: Any = env
        self.id, self.dt = arms.spec.id, arms.dt
        self.names, self.units = tuple(arms.names), tuple(arms.units)
        self.angles = tuple(arms.angles)
        self.action_dim = arms.single_action_space.shape[0]
        self.idle = idle_action(arms.single_action_space)
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


class _Episodes:
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
        if np.ndim(seed) == 0:
            first = require_count("seed", seed, least=0)
            seed = range(first, first + self.num_envs)
        seeds = [require_count("a seed", s, least=0) for s in seed]
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
        self.returns[i] += _number(self.id, "reward", reward)
        self.steps[i] += 1
        self.terminated[i] = bool(_number(self.id, "terminated", over))
        self.ended[i] = self.terminated[i] or bool(_number(self.id, "truncated", late))
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
        states = [self._state(_reset(self.id, env, 0))]
        clock, running = _clock(env), [env]
        if other is not None:
            _reset(self.id, other, 1)
            running = [other, env]
        with _counted(env) as calls:
            for u in np.random.default_rng(0).uniform(-1, 1, (TRIED, self.action_dim)):
                for one in tuple(running):
                    command = within_bounds(-u if one is other else u, self.robot.actions)
                    result = _step(self.id, one, command)
                    if one is env:
                        states.append(self._state(result[0]))
                    if np.any(result[2]) or np.any(result[3]):
                        running.remove(one)
                if env not in running:
                    break
        taken, passed = len(states) - 1, _clock(env) - clock
        ratio = passed / (self.dt * taken) if passed > 0 else len(calls) / taken
        return states, 1.0 if abs(ratio - 1) < 0.01 else ratio


class Stepping(_Episodes):
    """Episodes that are each stepped in a copy of their own."""

    def __init__(
        self,
        envs: Sequence[gymnasium.Env],
        another: Callable[[], gymnasium.Env] | None = None,
        env_id: str = "",
    ) -> None:
        """envs: the copies. another: makes one more, to try things on. env_id: by default what the
        first says.
        """
        env_id = env_id or common_id(envs)
        if len({id(env.unwrapped) for env in envs}) < len(envs):
            raise UnsupportedEnvironment(
                f"the {len(envs)} copies of {env_id} are one and the same object; make a new one "
                "for each episode: "
                "SyncVectorEnv([lambda: Robot()] * N)"
            )
        _require_steady(env_id, envs[0])
        first = envs[0]
        super().__init__(
            describe(env_id, first, first.observation_space, first.action_space),
            len(envs),
        )
        self.envs = envs
        if another is not None:
            self._examine(another, beside=True, envs=envs)

    def reset(self, *, seed: Seeds = None, states: np.ndarray | None = None) -> np.ndarray:
        seeds = self._seeds(seed, states)
        begun = zip(self.envs, seeds, strict=True)
        return self._begin([self._state(_reset(self.id, env, own)) for env, own in begun])

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        commands = self._commands(actions)
        states = np.repeat(self.last[:, None], actions.shape[1], axis=1)
        for i, env in enumerate(self.envs):
            t = 0
            while t < actions.shape[1] and not self.ended[i]:
                observation, *outcome, _ = _step(self.id, env, commands[i, t])
                states[i, t] = self._state(observation)
                self._note(i, states[i, t], *outcome)
                t += 1
            states[i, t:] = self.last[i]
        return states

    def close(self) -> None:
        for env in self.envs:
            env.close()


class Vectorised(_Episodes):
    """N episodes of any other vector environment, by its own ``step``.

    What it makes of ended episodes, be it a reset in the same step, stays out of the data.
    """

    def __init__(self, env: VectorEnv) -> None:
        self.env, self.metadata = env, env.metadata or {}
        makers = getattr(env.unwrapped, "env_fns", None)
        *wrappers, _ = layers(env)
        unlike = list({id(maker): maker for maker in makers or ()}.values())[1:]
        with ExitStack() as opened:
            one = opened.enter_context(closing(makers[0]())) if makers else env
            others = [opened.enter_context(closing(maker())) for maker in unlike]
            env_id = common_id([one, *others])
            if makers:
                words = [type(layer).__name__ for layer in wrappers]
                env_id += "".join(f"+{word}" for word in words if word not in spaces.HARMLESS)
            for layer in (env, one):
                _require_steady(env_id, layer)
            robot = describe(env_id, one, env.single_observation_space, env.single_action_space)
        super().__init__(robot, env.num_envs)
        if makers and not wrappers:
            self._examine(makers[0], beside=False)
        self.batch = batch_space(env.single_observation_space, env.num_envs)

    def reset(self, *, seed: Seeds = None, states: np.ndarray | None = None) -> np.ndarray:
        seeds = self._seeds(seed, states)
        given: Any = seeds  # as copies take them, whatever the signature of VectorEnv.reset says
        if not hasattr(self.env.unwrapped, "env_fns") and (seed is None or np.ndim(seed) == 0):
            given = seeds[0]
        try:
            first, _ = self.env.reset(seed=given)
        except (TypeError, gymnasium.error.Error) as error:
            if given is not seeds:
                raise
            raise UnsupportedEnvironment(
                f"{self.id} takes no seed for each of its episodes ({error!s:.100}); give one for "
                "all of them, seed=0"
            ) from error
        return self._begin([self._state(x) for x in self._rows(first)])

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        commands = self._commands(actions)
        states = np.repeat(self.last[:, None], actions.shape[1], axis=1)
        for t in range(actions.shape[1]):
            if self.ended.all():
                break
            observed, *outcome, info = self.env.step(commands[:, t])
            rows = self._rows(observed)
            rewards, over, late = (self._numbers(part) for part in outcome)
            for i in np.flatnonzero(~self.ended):
                if over[i] or late[i]:
                    rows[i] = self._final(rows[i], info, i)
                states[i, t:] = self._state(rows[i])
                self._note(int(i), states[i, t], rewards[i], over[i], late[i])
            self._restart(over | late)
        return states

    def close(self) -> None:
        self.env.close()

    def _rows(self, observed: Any) -> list[Any]:
        """The observation of each copy."""
        rows = list(iterate(self.batch, observed))
        if len(rows) != self.num_envs:
            raise UnsupportedEnvironment(
                f"{self.id} gave {len(rows)} observations for {self.num_envs} copies"
            )
        return rows

    def _numbers(self, values: Any) -> np.ndarray:
        array = np.asarray(values)
        if array.size != self.num_envs:
            raise UnsupportedEnvironment(
                f"{self.id} gave rewards or ends of shape {array.shape} for {self.num_envs} "
                "copies; expected one each"
            )
        return array.reshape(-1)

    def _final(self, seen: Any, info: Any, i: int) -> Any:
        """What episode i came to with its last step, which may have been reset within it."""
        mode = self.metadata.get("autoreset_mode")
        finals = info.get("final_obs", info.get("final_observation"))
        if finals is not None and finals[i] is not None:
            return finals[i]
        if mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            return seen
        raise UnsupportedEnvironment(
            f"{self.id} does not say what an episode that ended came to: put it into "
            "info['final_obs'], or say in "
            "metadata['autoreset_mode'] that it is not reset within the step, "
            "gymnasium.vector.AutoresetMode.NEXT_STEP"
        )

    def _restart(self, over: np.ndarray) -> None:
        """Let the others go on where copies have to be reset from outside."""
        waits = self.metadata.get("autoreset_mode") == AutoresetMode.DISABLED
        if not waits or not over.any() or self.ended.all():
            return
        observed, _ = self.env.reset(options={"reset_mask": over})
        rows = self._rows(observed)
        for i in np.flatnonzero(~self.ended):
            if not np.array_equal(self._state(rows[i]), self.last[i]):
                raise UnsupportedEnvironment(
                    f"{self.id} was to be reset in the copies that ended, options['reset_mask'], "
                    f"and reset copy {i} "
                    "too, in the middle of its episode; heed the mask, or end all copies together"
                )


def common_id(envs: Sequence[Any]) -> str:
    """The id of all copies; UnsupportedEnvironment where their steps or actions differ."""
    for env in envs[1:]:
        for what, one, other in (
            ("dt", said(envs[0], "dt"), said(env, "dt")),
            ("action_space", envs[0].action_space, env.action_space),
        ):
            if one is not other and repr(one) != repr(other):
                raise UnsupportedEnvironment(
                    f"copies of {environment_id(env)} differ in {what}, {one!s:.60} and "
                    f"{other!s:.60}; collect from each kind by itself"
                )
    ids = {environment_id(env) for env in envs}
    return ids.pop() if len(ids) == 1 else f"{min(ids).partition('(')[0]}(copies differ)"


def _reset(env_id: str, env: gymnasium.Env, seed: int) -> Any:
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


def _step(env_id: str, env: gymnasium.Env, command: np.ndarray) -> tuple[Any, ...]:
    try:
        result = env.step(command)
    except ValueError as error:  # a wrapper that unpacks it
        result = error if "values to unpack" in str(error) else None
        if result is None:
            raise
    if not isinstance(result, tuple) or len(result) != 5:
        raise UnsupportedEnvironment(
            f"step of {env_id} returned {result!s:.80}; Gymnasium expects (observation, reward, "
            "terminated, truncated, "
            "info)"
        )
    return result


def _number(env_id: str, what: str, value: Any) -> float:
    """One number, also of shape (1,)."""
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "fiub":
        raise UnsupportedEnvironment(f"{what} of {env_id} is {value!r:.80}; expected one number")
    return float(array.reshape(-1)[0])


def _require_steady(env_id: str, env: Any) -> None:
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
