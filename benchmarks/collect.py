"""Collecting random pushing data: all episodes in one call, against loops over ``env.step`` and over ``mj_step``.

Every round times all three, in turn, so that whatever else the machine does falls on each. The loops run a few episodes
and are extrapolated; the states that they reach must be those of the bulk call, bit for bit.

    python benchmarks/collect.py        or        python -m tsmlib bench collect
"""

from __future__ import annotations

import argparse
import resource
import time

import gymnasium
import mujoco
import numpy as np
import torch
from tqdm.auto import tqdm

import tsmlib.envs  # noqa: F401 - registers the environments
from tsmlib import runs, store
from tsmlib.collect import collect, once, smooth_torques
from tsmlib.envs.mujoco_arm import load_model

ENV, STEPS = "tsm/ReacherPush-v0", 100
SPREAD = {"median": np.median, "lowest": np.min, "highest": np.max}


def bulk(starts: np.ndarray, torques: torch.Tensor) -> np.ndarray:
    """States (N, T, dx) from one call for all episodes."""
    env = gymnasium.make_vec(ENV, num_envs=len(starts))
    states = collect(env, once(torques), horizon=STEPS, states=starts).states[:, 1:]
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
    return np.array(states, np.float32).reshape(len(starts), STEPS, 8)[..., [0, 1, 4, 5, 2, 3, 6, 7]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=5000, help="in the bulk call (default 5000)")
    parser.add_argument("--loop-episodes", type=int, default=50, help="in each loop (default 50)")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    n, few = arguments.episodes, min(arguments.loop_episodes, arguments.episodes)

    torques = smooth_torques(n, STEPS, generator=torch.Generator().manual_seed(0))
    env = gymnasium.make_vec(ENV, num_envs=n)
    starts, _ = env.reset(seed=0)
    env.close()
    ways = {
        "bulk": (n, lambda: bulk(starts, torques)),
        "env.step": (few, lambda: step_by_step(starts[:few], torques[:few].numpy())),
        "mj_step": (few, lambda: by_mj_step(starts[:few], torques[:few].numpy())),
    }
    speeds: dict[str, list[float]] = {way: [] for way in ways}
    per_core: dict[str, list[float]] = {way: [] for way in ways}  # where others load the machine, the fairer number
    for _ in tqdm(range(arguments.rounds), desc="rounds"):
        reached = {}
        for way, (episodes, run) in ways.items():
            began, used = time.perf_counter(), time.process_time()
            reached[way] = run()
            speeds[way].append(episodes * STEPS / (time.perf_counter() - began))
            per_core[way].append(episodes * STEPS / (time.process_time() - used))
        if not np.array_equal(reached["bulk"][:few], reached["env.step"]):
            raise SystemExit("the loop over env.step reached other states than the bulk call")
        if not np.array_equal(reached["bulk"][:few][..., [0, 1, 2, 3, 6, 7, 8, 9]], reached["mj_step"]):
            raise SystemExit("the loop over mj_step reached other states than the bulk call")

    rows = []
    print(f"{ENV}, {n} episodes of {STEPS} steps, {arguments.rounds} rounds: median (lowest to highest)")
    for way, values in speeds.items():
        speed, core = np.array(values), np.median(per_core[way])
        ratio, core_ratio = np.array(speeds["bulk"]) / speed, np.median(per_core["bulk"]) / core
        print(
            f"{way:9} {np.median(speed):8,.0f} steps/s ({speed.min():,.0f} to {speed.max():,.0f})   "
            f"{n * STEPS / np.median(speed):6.1f} s for all   bulk is {np.median(ratio):.2f}x as fast "
            f"({ratio.min():.2f} to {ratio.max():.2f}), {core_ratio:.2f}x per core"
        )
        common = dict(env=ENV, sim="mujoco", model="none", horizon=STEPS, condition=way, n=arguments.rounds)
        rows.append(dict(common, metric="steps_per_second", value=np.median(speed), unit="1/s"))
        rows.append(dict(common, metric="steps_per_core_second", value=core, unit="1/s"))
        rows += [dict(common, metric=f"ratio_{word}", value=of(ratio)) for word, of in SPREAD.items()]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(f"peak memory of this process: {peak / 2**30:.2f} GiB")
    rows.append(dict(env=ENV, sim="mujoco", metric="peak_bytes", value=peak, unit="B"))
    path = runs.resolve("bench").dir.parents[1] / "bench" / "collect.csv"
    store.save_table(path, rows)
    print(path)


if __name__ == "__main__":
    main()
