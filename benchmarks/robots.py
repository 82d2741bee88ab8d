"""Collecting from one of Gymnasium's robots: MuJoCo's bulk simulation against stepping it, for HalfCheetah-v5.

Every round times all of them, in turn. The states that they reach must agree to 1e-6. The limit is ``mujoco.rollout``
itself on as many threads; beyond it, the environment's own code makes each observation, reward and end.

    python benchmarks/robots.py        or        python -m tsmlib bench robots
"""

from __future__ import annotations

import os
import time
from functools import partial

import gymnasium
import numpy as np
import torch
from _rounds import Row, interleaved, parsed, parser, peak_bytes, save

from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs.snapshots import abilities
from tsmlib.envs.stepping import make_simulation, within_bounds

ENV = "HalfCheetah-v5"
STEPS = 100


def bulk(actions: torch.Tensor) -> np.ndarray:
    """States (N, T, dx) as ``collect`` gets them."""
    episodes = make_simulation(ENV, len(actions))
    return collect(episodes, open_loop(actions), horizon=STEPS, seed=0).states[:, 1:]


def vector_step(env: gymnasium.vector.VectorEnv, actions: np.ndarray) -> np.ndarray:
    """The same by the ``step`` of Gymnasium's vector environment, its copies made beforehand."""
    env.reset(seed=0)
    return np.stack([env.step(each)[0] for each in actions.swapaxes(0, 1)], 1, dtype=np.float32)


def single_step(env: gymnasium.Env, actions: np.ndarray) -> np.ndarray:
    """The same by the ``step`` of one environment."""
    states = []
    for seed, each in enumerate(actions):
        env.reset(seed=seed)
        states.append([env.step(action)[0] for action in each])
    return np.array(states, np.float32)


def physics(env: gymnasium.Env, actions: np.ndarray) -> np.ndarray:
    """The physics alone."""
    found = abilities(env).bulk
    assert found is not None
    env.reset(seed=0)
    return found.physics(np.tile(found.start(env), (len(actions), 1)), actions)


def main() -> None:
    options = parser(__doc__, rounds=9)
    options.add_argument("--episodes", type=int, default=64, help="in the bulk call (default 64)")
    options.add_argument("--loop-episodes", type=int, default=16, help="in each loop (default 16)")
    arguments = parsed(options)
    n, few = arguments.episodes, min(arguments.loop_episodes, arguments.episodes)
    threads = min(os.cpu_count() or 1, 8)

    one, many = gymnasium.make(ENV), gymnasium.make_vec(ENV, num_envs=few)
    actions = smooth_torques(n, STEPS, generator=torch.Generator().manual_seed(0), action_dim=6, rms=0.5)
    commands = within_bounds(actions.numpy(), one.action_space)  # type: ignore[arg-type]
    calls = {
        "bulk": partial(bulk, actions),
        "VectorEnv.step": partial(vector_step, many, commands[:few]),
        "env.step": partial(single_step, one, commands[:few]),
    }
    reached: dict[str, np.ndarray] = {}
    used: dict[str, list[float]] = {way: [] for way in calls}

    def keep(way: str) -> None:
        began = time.process_time()
        reached[way] = calls[way]()
        used[way].append(time.process_time() - began)

    peaks = {way: peak_bytes(partial(keep, way)) for way in calls}
    for way in ("VectorEnv.step", "env.step"):
        if not np.allclose(reached["bulk"][:few], reached[way], rtol=1e-6, atol=1e-6):
            raise SystemExit(f"the loop over {way} reached other states than the bulk call")
    ways = {**{way: partial(keep, way) for way in calls}, "raw": partial(physics, one, commands)}
    seconds = interleaved(ways, arguments.rounds, warm=False)
    speeds = {way: (n if way in ("bulk", "raw") else few) * STEPS / seconds[way] for way in ways}
    bound = f"mujoco.rollout, {threads} threads"
    about = {"env": ENV, "sim": "mujoco", "model": "none", "horizon": STEPS, "threads": threads}
    rows = [
        Row.of(
            "collect from any robot of MuJoCo's: steps", speeds["bulk"], f"loop over {way}", speeds[way],
            limit=bound, bound=speeds["raw"], peak=peaks["bulk"], configuration=way, metric="steps_per_second", **about,
        )
        for way in ("VectorEnv.step", "env.step")
    ]  # fmt: skip
    cores = {way: (n if way == "bulk" else few) * STEPS / np.array(taken[1:]) for way, taken in used.items()}
    rows.append(
        Row.of(
            "collect from any robot of MuJoCo's: steps per CPU second", cores["bulk"], "loop over VectorEnv.step",
            cores["VectorEnv.step"], peak=peaks["bulk"], configuration="VectorEnv.step",
            metric="steps_per_core_second", **about,
        )
    )  # fmt: skip
    print(f"{ENV}, {n} episodes of {STEPS} steps, {threads} threads, {arguments.rounds} rounds")
    save("robots", rows)


if __name__ == "__main__":
    main()
