"""Bulk simulation of any environment of Gymnasium's ``MujocoEnv``: ``mujoco.rollout`` in place of its own stepping.

The physics of many episodes run in C++ on all threads. Then the environment's own ``step`` is called all the same, with
a ``do_simulation`` that only sets the state that was reached: observation, reward and termination are made by the
environment's own code, however it is written. Whatever that code does beyond (noise on an action, a push, a state that
is set by hand) is noticed at the step where it happens (`Mismatch`), and the episode is stepped instead.
"""

from __future__ import annotations

import ast
import inspect
import os
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import gymnasium
import numpy as np

CHUNK = 64  # episodes whose physics are held at once


class Mismatch(Exception):
    """The environment does something that bulk simulation did not; the message says what."""


class Bulk:
    """``mujoco.rollout`` with the model and frame skip of one environment.

    last_substep: simulate the last substep of every step again by itself, for environments that look at more than
    positions and velocities (places of bodies, forces): MuJoCo leaves those as they were before it. only_observes: its
    ``step`` need not be called where no reward is asked for, see ``observed``.
    """

    def __init__(self, env: Any, *, last_substep: bool) -> None:
        import mujoco
        from mujoco import rollout

        self.model, self.frame_skip, self.last_substep = env.model, env.frame_skip, last_substep
        threads = min(os.cpu_count() or 1, 8)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._kind = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        self._size = mujoco.mj_stateSize(self.model, self._kind)
        applied = (
            mujoco.mjtState.mjSTATE_QFRC_APPLIED.value | mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
        )
        self._watched = self._kind | applied
        self.only_observes = not last_substep and never_ends(type(env))

    @staticmethod
    def refused(env: gymnasium.Env) -> str:
        """Why the physics of ``env`` cannot be simulated apart from it; '' where they may be. It is reset."""
        from gymnasium.envs.mujoco.mujoco_env import MujocoEnv

        simulated: Any = env.unwrapped
        for name in ("do_simulation", "_step_mujoco_simulation"):
            if getattr(type(simulated), name) is not getattr(MujocoEnv, name):
                return f"it has a {name} of its own"
        models = []
        for seed in (3, 4):
            env.reset(seed=seed)
            models.append(_model_bytes(simulated.model))
        if models[0] != models[1]:
            return "a reset changes its model"
        if simulated.model.nmocap or simulated.model.nu != simulated.action_space.shape[0]:
            return "it has bodies that are moved by hand, or its actions are not those of its actuators"
        return ""

    def start(self, env: gymnasium.Env) -> np.ndarray:
        """The physics that ``env`` is in, and what its solver starts from."""
        import mujoco

        simulated: Any = env.unwrapped
        state = np.empty(self._size)
        mujoco.mj_getState(simulated.model, simulated.data, state, self._kind)
        return np.concatenate([state, simulated.data.qacc_warmstart])

    def physics(self, starts: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """States (n, T frame_skip + 1, ...) from ``starts`` (n, ...) on, under actions (n, T, du) as the robot gets."""
        first, warm = starts[:, : self._size], starts[:, self._size :]
        control = np.repeat(actions.astype(np.float64), self.frame_skip, axis=1)
        with without_log():
            states, _ = self._pool.rollout(
                self.model, self._data, first, control, initial_warmstart=warm
            )
        return np.concatenate([first[:, None], states], axis=1)

    def observed(self, env: gymnasium.Env, physics: np.ndarray) -> list[np.ndarray]:
        """Observations after each step of ``physics``, by ``_get_obs`` alone, of an environment that never ends."""
        import mujoco

        simulated: Any = env.unwrapped
        model, data, kind, observations = simulated.model, simulated.data, self._kind, []
        for state in physics[self.frame_skip :: self.frame_skip].copy():
            mujoco.mj_setState(model, data, state, kind)
            observations.append(simulated._get_obs())
        return observations

    @contextmanager
    def playing(
        self,
        env: gymnasium.Env,
        physics: np.ndarray,
        actions: np.ndarray,
        *,
        fill: float | None = None,
    ) -> Iterator[None]:
        """Within, each ``step`` of ``env`` sets the next of ``physics``. fill: a value for all that follows from it."""
        import mujoco

        simulated: Any = env.unwrapped
        model, data, kind, skip = simulated.model, simulated.data, self._kind, self.frame_skip
        reached = np.zeros(
            (len(actions) + 1, mujoco.mj_stateSize(model, self._watched))
        )  # and no force by hand
        reached[:, : self._size] = physics[::skip]
        expected = [row.tobytes() for row in reached]
        now, after, last = (
            np.empty_like(reached[0]),
            list(physics[skip::skip].copy()),
            physics[skip - 1 :: skip].copy(),
        )
        clock = physics[0, 0] + skip * model.opt.timestep * np.arange(len(reached))
        sound = (
            int((np.abs(reached[:, 0] - clock) < model.opt.timestep / 2).cumprod().sum()) - 1
        )  # steps
        step = 0

        def do_simulation(control: np.ndarray, n_frames: int) -> None:
            nonlocal step
            if (
                n_frames != skip
                or step >= len(actions)
                or not np.array_equal(control, actions[step])
            ):
                raise Mismatch("its actuators get something else than its actions")
            mujoco.mj_getState(model, data, now, self._watched)
            if now.tobytes() != expected[step]:
                raise Mismatch("it sets states or forces by itself")
            if step >= sound:
                raise Mismatch("MuJoCo stopped it")
            data.ctrl[:] = control
            if self.last_substep:
                mujoco.mj_setState(model, data, last[step], kind)
                mujoco.mj_step(model, data)
                mujoco.mj_rnePostConstraint(model, data)
            mujoco.mj_setState(model, data, after[step], kind)
            if fill is not None:
                for array in arrays(data).values():
                    array[...] = fill
            step += 1

        simulated.do_simulation = do_simulation
        try:
            yield
        finally:
            del simulated.do_simulation


def is_mujoco(env: gymnasium.Env) -> bool:
    """Whether ``env`` is one of Gymnasium's ``MujocoEnv``, found without importing MuJoCo."""
    return any(
        base.__name__ == "MujocoEnv" and base.__module__.startswith("gymnasium.envs.mujoco")
        for base in type(env.unwrapped).__mro__
    )


def never_ends(kind: type) -> bool:
    """Whether ``kind`` is an environment of Gymnasium's own, each of whose steps returns False for both ends.

    What such a step does beyond is known; of one by somebody else it is not.
    """
    if not kind.__module__.startswith("gymnasium.envs.mujoco."):
        return False
    source = ast.parse(textwrap.dedent(inspect.getsource(kind.step)))  # type: ignore[attr-defined]
    ends = [
        node.value.elts[2:4] if isinstance(node.value, ast.Tuple) else []
        for node in ast.walk(source)
        if isinstance(node, ast.Return)
    ]
    return all(
        len(pair) == 2 and all(isinstance(e, ast.Constant) and e.value is False for e in pair)
        for pair in ends
    )


@cache
def derived() -> tuple[str, ...]:
    """Arrays of MuJoCo's data that follow from positions, velocities and controls, those of constraints left out."""
    import mujoco

    given = {
        "qpos",
        "qvel",
        "act",
        "ctrl",
        "qacc_warmstart",
        "qfrc_applied",
        "xfrc_applied",
        "mocap_pos",
        "mocap_quat",
        "userdata",
        "history",
        "plugin_state",
    }
    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    found = {
        name: getattr(data, name)
        for name in dir(data)
        if not name.startswith(("_", "efc_")) and name not in given
    }
    return tuple(
        n
        for n, array in found.items()
        if isinstance(array, np.ndarray) and array.dtype == np.float64
    )


def arrays(data: Any) -> dict[str, np.ndarray]:
    """Those of ``derived`` that have a size and can be written, as views."""
    found = {name: getattr(data, name) for name in derived()}
    return {name: array for name, array in found.items() if array.size and array.flags.writeable}


def _model_bytes(model: Any) -> bytes:
    import mujoco

    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


@contextmanager
def without_log() -> Iterator[None]:
    """MuJoCo's warnings go nowhere, so that it writes no MUJOCO_LOG.TXT; who asks for this reports what went wrong."""
    import mujoco

    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
