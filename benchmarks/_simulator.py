"""MuJoCo itself on the pushing arm: ``mujoco.rollout`` with nothing around it."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco.rollout
import numpy as np

from tsmlib.envs.mujoco_arm import CHUNK, load_model

ENV = "tsm/ReacherPush-v1"


def raw(starts: np.ndarray, actions: np.ndarray, *, threads: int) -> Callable[[], None]:
    """A way that simulates ``actions`` (N, T, du) from ``starts`` (N, dx) and keeps nothing.

    Its inputs are ready beforehand; a few hundred episodes at a time, which fit in a cache better than all.
    """
    model = load_model(ENV)
    substeps = round(0.02 / model.opt.timestep)
    physics = np.zeros(
        (len(starts), mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    )
    physics[:, 1:9] = starts[
        :, [0, 1, 6, 7, 2, 3, 8, 9]
    ]  # after the time, positions and velocities
    data = [mujoco.MjData(model) for _ in range(threads)]
    pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)
    parts = [
        (
            physics[first : first + CHUNK],
            np.repeat(actions[first : first + CHUNK].astype(float), substeps, axis=1),
        )
        for first in range(0, len(starts), CHUNK)
    ]

    def run() -> None:
        for start, control in parts:
            pool.rollout(model, data, start, control)

    return run
