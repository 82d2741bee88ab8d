"""Episodes of any environment: our arms in bulk, any other one stepped, N copies for N episodes.

No copy is shared between episodes. An observation is not a state, so an episode begins by the seed
of a reset. One that ended is not stepped any further: its last state repeats. What reset and step
return is copied (``spaces``).

Letters in shapes: N episodes, T steps, dx size of a state, du of an action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, nullcontext
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space, iterate

from tsmlib.checks import require_count
from tsmlib.envs.episodes import Episodes, Seeds, require_steady, reset_once, step_once
from tsmlib.envs.ids import (
    HARMLESS,
    UnsupportedEnvironment,
    canonical,
    environment_id,
    find_spec,
    layers,
)
from tsmlib.envs.spaces import describe, idle_action, require_actions, said, state_names
from tsmlib.envs.spaces import within_bounds as within_bounds
from tsmlib.envs.unstable import import_mujoco, without_log


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
    if (spec.namespace == "tsm" and spec.vector_entry_point) or spec.entry_point is None:
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
            state_names(env_id, made[0].observation_space)
            require_actions(env_id, made[0].action_space)
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
    shown: dict[str, Any] = {} if render_mode is None else {"render_mode": render_mode}
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


class Stepping(Episodes):
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
        require_steady(env_id, envs[0])
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
        return self._begin([self._state(reset_once(self.id, env, own)) for env, own in begun])

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        commands = self._commands(actions)
        states = np.repeat(self.last[:, None], actions.shape[1], axis=1)
        for i, env in enumerate(self.envs):
            t = 0
            while t < actions.shape[1] and not self.ended[i]:
                observation, *outcome, _ = step_once(self.id, env, commands[i, t])
                states[i, t] = self._state(observation)
                self._note(i, states[i, t], *outcome)
                t += 1
            states[i, t:] = self.last[i]
        return states

    def close(self) -> None:
        for env in self.envs:
            env.close()


class Vectorised(Episodes):
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
                env_id += "".join(f"+{word}" for word in words if word not in HARMLESS)
            for layer in (env, one):
                require_steady(env_id, layer)
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
                    rows[i] = self._final(rows[i], info, int(i))
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
