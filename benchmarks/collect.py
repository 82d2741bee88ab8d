"""Collecting random pushing data: all episodes in one call, against loops over ``env.step`` and over ``mj_step``.

Every round times all of them, in turn, so that whatever else the machine does falls on each. The loops run a few
episodes; the states that they reach must be those of the bulk call, bit for bit. The limit is ``mujoco.rollout`` itself
on as many threads, with the same torques ready in memory and its states thrown away.

    python benchmarks/collect.py        or        python -m tsmlib bench collect
"""

from __future__ import annotations

import os
import time
from functools import partial

import gymnasium
import mujoco
import numpy as np
import torch
from _rounds import Row, interleaved, parsed, parser, peak_bytes, save
from _simulator import ENV, raw

import tsmlib.envs  # noqa: F401 - registers the environments
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs.mujoco_arm import load_model

STEPS = 100


def bulk(starts: np.ndarray, torques: torch.Tensor) -> np.ndarray:
    """States (N, T, dx) from one call for all episodes."""
    env = gymnasium.make_vec(ENV, num_envs=len(starts))
    states = collect(env, open_loop(torques), horizon=STEPS, states=starts).states[:, 1:]
    env.close()
    return states


def step_by_step(starts: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """The same from one environment and its ``step``."""
    env = gymnasium.make(ENV)
    states = []
    for start, actions in zip(starts, torques, strict=True):
        env.reset(options={"states": start})
        states.append([env.step(action)[0] for action in actions])
    env.close()
    return np.array(states, np.float32)


def by_mj_step(starts: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """The same from MuJoCo's own ``mj_step``; the joints' and the block's positions and velocities alone."""
    model = load_model(ENV)
    data = mujoco.MjData(model)
    substeps = round(0.02 / model.opt.timestep)
    states = []
    for start, actions in zip(starts, torques, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = start[[0, 1, 6, 7]], start[[2, 3, 8, 9]]
        for action in actions:
            data.ctrl[:] = action
            mujoco.mj_step(model, data, nstep=substeps)
            states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states, np.float32).reshape(len(starts), STEPS, 8)[
        ..., [0, 1, 4, 5, 2, 3, 6, 7]
    ]


def main() -> None:
    options = parser(__doc__, rounds=9)
    options.add_argument("--episodes", type=int, default=500, help="in the bulk call (default 500)")
    options.add_argument("--loop-episodes", type=int, default=20, help="in each loop (default 20)")
    arguments = parsed(options)
    n, few = arguments.episodes, min(arguments.loop_episodes, arguments.episodes)
    threads = min(os.cpu_count() or 1, 8, n)  # as the environment takes them

    torques = smooth_torques(n, STEPS, generator=torch.Generator().manual_seed(0))
    env = gymnasium.make_vec(ENV, num_envs=n)
    starts, _ = env.reset(seed=0)
    env.close()
    reached: dict[str, np.ndarray] = {}
    used: dict[str, list[float]] = {"bulk": [], "env.step": [], "mj_step": []}
    calls = {
        "bulk": partial(bulk, starts, torques),
        "env.step": partial(step_by_step, starts[:few], torques[:few].numpy()),
        "mj_step": partial(by_mj_step, starts[:few], torques[:few].numpy()),
    }

    def keep(way: str) -> None:
        began = time.process_time()
        reached[way] = calls[way]()
        used[way].append(time.process_time() - began)

    peaks = {way: peak_bytes(partial(keep, way)) for way in calls}
    if not np.array_equal(reached["bulk"][:few], reached["env.step"]):
        raise SystemExit("the loop over env.step reached other states than the bulk call")
    if not np.array_equal(reached["bulk"][:few][..., [0, 1, 2, 3, 6, 7, 8, 9]], reached["mj_step"]):
        raise SystemExit("the loop over mj_step reached other states than the bulk call")
    limit = raw(starts, torques.numpy(), threads=threads)
    ways = {**{way: partial(keep, way) for way in calls}, "raw": limit}
    seconds = interleaved(ways, arguments.rounds, warm=False)
    speeds = {
        way: (few if way in ("env.step", "mj_step") else n) * STEPS / seconds[way] for way in ways
    }
    bound = f"mujoco.rollout, {threads} threads"
    rows = [
        Row.of(
            "collect in one call: steps",
            speeds["bulk"],
            f"loop over {way}",
            speeds[way],
            limit=bound,
            bound=speeds["raw"],
            peak=peaks["bulk"],
            threads=threads,
            env=ENV,
            sim="mujoco",
            model="none",
            horizon=STEPS,
            configuration=way,
            metric="steps_per_second",
        )
        for way in ("env.step", "mj_step")
    ]
    cores = {
        way: (n if way == "bulk" else few) * STEPS / np.array(taken[1:])
        for way, taken in used.items()
    }
    rows.append(
        Row.of(
            "collect in one call: steps per CPU second",
            cores["bulk"],
            "loop over env.step",
            cores["env.step"],
            peak=peaks["bulk"],
            threads=threads,
            env=ENV,
            sim="mujoco",
            model="none",
            horizon=STEPS,
            configuration="env.step",
            metric="steps_per_core_second",  # fairer where others load the machine
        )
    )
    print(f"{ENV}, {n} episodes of {STEPS} steps, {threads} threads, {arguments.rounds} rounds")
    save("collect", rows)


if __name__ == "__main__":
    main()
