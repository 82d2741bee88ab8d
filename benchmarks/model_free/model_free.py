"""Policies learned without a model, by Stable-Baselines3: the model-free curves of figure 7, and those of 10_explore.

PPO from Stable-Baselines3 and TRPO from sb3-contrib (the paper names no method) on the tasks of section 5.3.2: the
reward, the starts, the targets and the steps of an episode are those of ``reproduction.learn``, which asks a model
where these ask the simulator. A few configurations are tried on validation targets; the best one learns with every
seed, and its executed return on the frozen test targets is measured along the way. README.md tells how to install it.

    OMP_NUM_THREADS=1 python benchmarks/model_free/model_free.py

SAC, which is no policy gradient and learns from all that it has seen, is asked for by name, and so is the pendulum of
10_explore, which compares steps of all three with those of rounds.

Every finished run is kept in the table and not repeated; of one that was stopped the table holds the beginning.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pandas as pd
import torch
from reproduction.results import exploration
from reproduction.results.exploration import PENDULUM
from torch import Tensor
from tqdm.auto import tqdm

import tsmlib.envs  # noqa: F401 - registers the environments
from reproduction import pendulum, worlds
from reproduction.runs import ROOT
from tsmlib import study
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.stepping import within_bounds
from tsmlib.planning.execution import execute
from tsmlib.planning.tasks import HORIZON, Task
from tsmlib.trajectory import Segment

ENVS = ("tsm/Reacher-v0", "tsm/ReacherPush-v1")
GRADIENTS = ("ppo", "trpo")  # those of figure 7
ALGORITHMS = (*GRADIENTS, "sac")
GAMMA = 0.99  # A.3
# The first four are half of all combinations, in which each pair of values meets once; pushing had higher returns with
# more episodes and larger torques, and the last two go further that way.
SETTINGS: dict[str, list[dict[str, float]]] = {
    "ppo": [
        {"learning_rate": 3e-4, "episodes": 20, "std": 0.14},
        {"learning_rate": 3e-4, "episodes": 80, "std": 0.37},
        {"learning_rate": 1e-3, "episodes": 20, "std": 0.37},
        {"learning_rate": 1e-3, "episodes": 80, "std": 0.14},
        {"learning_rate": 1e-3, "episodes": 80, "std": 0.37},
        {"learning_rate": 1e-3, "episodes": 200, "std": 0.37},
    ],
    "trpo": [
        {"target_kl": 0.01, "episodes": 20, "std": 0.14},
        {"target_kl": 0.01, "episodes": 80, "std": 0.37},
        {"target_kl": 0.03, "episodes": 20, "std": 0.37},
        {"target_kl": 0.03, "episodes": 80, "std": 0.14},
        {"target_kl": 0.03, "episodes": 80, "std": 0.37},
        {"target_kl": 0.03, "episodes": 200, "std": 0.37},
    ],
    "sac": [
        {"learning_rate": 3e-4, "episodes": 20, "updates": 0.25},
        {"learning_rate": 3e-4, "episodes": 40, "updates": 1},
        {"learning_rate": 1e-3, "episodes": 20, "updates": 1},
        {"learning_rate": 1e-3, "episodes": 40, "updates": 0.25},
        {"learning_rate": 3e-4, "episodes": 20, "updates": 1},
        {"learning_rate": 1e-3, "episodes": 40, "updates": 1},
    ],
}  # episodes: per update, of SAC side by side; std: of the actions, at first; updates: per step of the environment
MINIBATCH = 250  # steps; of PPO, and of TRPO's value function
STEPS = {
    "tsm/Reacher-v0": 300_000,
    "tsm/ReacherPush-v1": 1_000_000,
    PENDULUM: 100_000,
}  # by each seed
SEARCH_STEPS = {
    "tsm/Reacher-v0": 60_000,
    "tsm/ReacherPush-v1": 200_000,
    PENDULUM: 40_000,
}  # by each configuration
VALIDATION_STARTS = 2000  # seed of the pendulum's that a configuration is chosen by
SEARCH_SEED = 100
RECORDS = 25  # along the way, and one before
UNITS = {
    "return_true": "m",
    "final_distance": "m",
    "success": "share",
    "seconds": "s",
    "cpu_seconds": "s",
}

Predictor = Callable[[np.ndarray], np.ndarray]  # observations (n, k) -> actions (n, du)


# The task ------------------------------------------------------------------------------------------------------------


def observed(states: np.ndarray, target: np.ndarray) -> np.ndarray:
    """What a policy sees, as ours do: cosines and sines of the angles, the rest of the state, the target (n, k)."""
    angles = states[:, :2]
    return np.concatenate(
        [np.cos(angles), np.sin(angles), states[:, 2:], target], axis=1, dtype=np.float32
    )


Robots = gymnasium.vector.VectorEnv


@dataclass(frozen=True)
class Setup:
    """What differs between the arms and the pendulum.

    horizon: steps of an episode; task: split -> the starts and targets that a policy is measured on; made: number of
    robots -> their vector environment; action_space: of one robot, as a policy gives actions; target: robots -> their
    targets (n, 2); seen: (states (n, dx), targets) -> what a policy sees (n, k); seeds: (seed, number of robots) -> of
    their first reset; stepped: (robots, actions (n, du)) -> their states and rewards; unit: of a return.
    """

    horizon: int
    task: Callable[[str], Task]
    made: Callable[[int], Robots]
    action_space: Callable[[Robots], gymnasium.Space]
    target: Callable[[Robots], np.ndarray]
    seen: Callable[[np.ndarray, np.ndarray], np.ndarray]
    seeds: Callable[[int, int], int | list[int]]
    stepped: Callable[[Robots, np.ndarray], tuple[np.ndarray, np.ndarray]]
    unit: str = "m"


def _arm(env: str) -> Setup:
    """An arm, whose environment draws starts and targets."""
    return Setup(
        HORIZON["push" if EnvSpec.parse(env).task == "push" else "reach"],
        task=lambda split: study.load_task(env, split),
        made=lambda n: cast(Robots, gymnasium.make_vec(env, num_envs=n, threads=1).unwrapped),
        action_space=lambda robots: robots.single_action_space,
        target=lambda robots: cast(Any, robots).target,
        seen=observed,
        seeds=lambda seed, _: seed,
        stepped=lambda robots, actions: robots.step(actions)[:2],
    )


def _swings(split: str) -> Task:
    """Starts of the pendulum: those that measure its rounds, or others by which a configuration is chosen."""
    n = worlds.world(PENDULUM).sizes["paper"].starts
    return (
        worlds.world(PENDULUM).tested(n)
        if split == "test"
        else pendulum.swing_up(n, VALIDATION_STARTS)
    )


def _swung(robots: Robots, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Actions and reward are those of ``pendulum.swing_up``."""
    actions = np.clip(actions, -1, 1)
    states, *_ = robots.step(within_bounds(actions, robots.single_action_space))
    return states, pendulum.upright(torch.from_numpy(states), torch.from_numpy(actions)).numpy()


SETUPS = {env: _arm(env) for env in ENVS} | {
    PENDULUM: Setup(
        exploration.HORIZON,
        _swings,
        made=lambda n: gymnasium.make_vec(PENDULUM, num_envs=n, vectorization_mode="sync"),
        action_space=lambda robots: gymnasium.spaces.Box(
            -1, 1, robots.single_action_space.shape, np.float32
        ),
        target=lambda robots: np.zeros((robots.num_envs, 0)),
        seen=lambda states, _: states.astype(np.float32),
        # One for each pendulum, none of another training seed; from neighbouring ones they would start alike.
        seeds=lambda seed, n: np.random.SeedSequence(seed).generate_state(n).tolist(),
        stepped=_swung,
        unit="",
    )
}


class Episodes:
    """Episodes of a task's length in n robots at once, one after another. Starts and targets are the environment's."""

    def __init__(self, env: str, n: int, *, seed: int) -> None:
        self.setup = SETUPS[env]
        self.robots = self.setup.made(n)
        self.actions = self.setup.action_space(self.robots)
        self.seed: int | list[int] | None = self.setup.seeds(
            seed, n
        )  # of the first reset; later ones go on from there
        self.taken = 0

    @property
    def observation_size(self) -> int:
        """Numbers that a policy sees, k."""
        dx = self.robots.single_observation_space.shape[0]
        return self.setup.seen(np.zeros((1, dx)), np.zeros((1, 2))).shape[1]

    def observed(self, states: np.ndarray) -> np.ndarray:
        """What a policy sees of states (n, dx): (n, k)."""
        return self.setup.seen(states, self.setup.target(self.robots))

    def reset(self) -> np.ndarray:
        """Begin n episodes: their first observations (n, k)."""
        states, _ = self.robots.reset(seed=self.seed)
        self.seed, self.taken = None, 0
        return self.observed(states)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Actions (n, du) -> observations (n, k), rewards (n,), and whether the episodes are over."""
        states, rewards = self.setup.stepped(self.robots, actions)
        self.taken += 1
        return self.observed(states), rewards, self.taken == self.setup.horizon


def measured(task: Task, predict: Predictor) -> dict[str, float]:
    """Executed return and distances of a policy, as ``study.assess`` measures ours: means over the targets."""
    target = task.target.numpy()

    def control(past: Segment) -> torch.Tensor:
        states = past.states[:, -1].numpy()
        actions = predict(SETUPS[task.env].seen(states, target))
        return torch.from_numpy(np.asarray(actions, np.float32))[:, None]

    done = execute(task, control)
    found = {
        "return_true": float(done.executed_return.mean()),
        "success": float(cast(Tensor, done.success).float().mean()),
    }
    if task.position is not None:
        found["final_distance"] = float(done.final_distance.mean())
    return found


# Theirs --------------------------------------------------------------------------------------------------------------


def vectorised(episodes: Episodes) -> Any:
    """``episodes`` as a vector environment of Stable-Baselines3. The end of an episode is a limit of time."""
    from stable_baselines3.common.vec_env import VecEnv

    class Vectorised(VecEnv):
        def __init__(self) -> None:
            space = gymnasium.spaces.Box(-np.inf, np.inf, (episodes.observation_size,), np.float32)
            super().__init__(episodes.robots.num_envs, space, episodes.actions)

        def reset(self) -> np.ndarray:
            return episodes.reset()

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
            seen, rewards, over = episodes.step(self.actions)
            infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
            if over:
                infos = [
                    {"terminal_observation": last, "TimeLimit.truncated": True} for last in seen
                ]
                seen = episodes.reset()
            return seen, rewards.astype(np.float32), np.full(self.num_envs, over), infos

        def close(self) -> None:
            episodes.robots.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(episodes.robots, attr_name)] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError("the episodes share their attributes")

        def env_method(
            self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
        ) -> list[Any]:
            raise NotImplementedError("the episodes share their methods")

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return Vectorised()


def learner(algorithm: str, env: str, setting: Mapping[str, float], *, seed: int) -> Any:
    """The library's algorithm with a configuration of the search; what is not named here is the library's default."""
    from sb3_contrib import TRPO
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    special = {
        name: value for name, value in setting.items() if name not in ("episodes", "std", "updates")
    }
    network: dict[str, Any] = dict(net_arch=[64, 64])
    robots = vectorised(Episodes(env, int(setting["episodes"]), seed=seed))
    if algorithm == "sac":
        from sbx import SAC

        return SAC(  # ReLU is its default
            "MlpPolicy",
            VecNormalize(robots, gamma=GAMMA),
            gamma=GAMMA,
            policy_kwargs=network,
            seed=seed,
            device="cpu",
            gradient_steps=max(1, round(setting["updates"] * setting["episodes"])),
            **special,
        )
    network |= dict(activation_fn=torch.nn.ReLU, log_std_init=math.log(setting["std"]))
    return {"ppo": PPO, "trpo": TRPO}[algorithm](
        "MlpPolicy",
        VecNormalize(robots, gamma=GAMMA),
        n_steps=SETUPS[env].horizon,
        batch_size=MINIBATCH,
        gamma=GAMMA,
        policy_kwargs=network,
        seed=seed,
        device="cpu",
        **special,
    )


def learn(
    algorithm: str, task: Task, setting: Mapping[str, float], *, steps: int, records: int, seed: int
) -> Iterator[dict[str, float]]:
    """One run of at least ``steps`` steps: measurements on ``task`` before it and ``records`` times along the way.

    A record holds the steps taken, the seconds of learning (by the clock, and of the CPU) and ``measured``.
    """
    model = learner(algorithm, task.env, setting, seed=seed)

    def predict(seen: np.ndarray) -> np.ndarray:
        return model.predict(model.env.normalize_obs(seen), deterministic=True)[0]

    clock = np.zeros(2)
    last = -1
    title = f"{task.env} {algorithm} {named(setting)}, seed {seed}"
    with tqdm(total=steps, desc=title, unit="step", mininterval=5) as bar:
        for goal in np.linspace(0, steps, records + 1).round().astype(int):
            began = _clock()
            if goal > model.num_timesteps:
                model.learn(int(goal) - model.num_timesteps, reset_num_timesteps=False)
            clock += _clock() - began
            seconds, cpu_seconds = clock.tolist()
            if model.num_timesteps > last:
                last = model.num_timesteps
                found = measured(task, predict)
                bar.update(last - bar.n)
                bar.set_postfix(executed=found["return_true"])
                yield {"steps": last, "seconds": seconds, "cpu_seconds": cpu_seconds} | found
    model.env.close()
    return found


def _clock() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


# The study -----------------------------------------------------------------------------------------------------------


def named(setting: Mapping[str, float]) -> str:
    """A configuration in one line: ``learning_rate=0.001 episodes=20 std=0.14``."""
    return " ".join(f"{name}={value:g}" for name, value in setting.items())


class Table:
    """The rows of all finished runs, in a file. A run is known by environment, algorithm, subset, setting, seed."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, (pd.read_csv(path).to_dict("records") if path.exists() else [])

    def kept(self, key: Mapping[str, Any], steps: int) -> list[dict[str, Any]]:
        """The rows of a run, if it took at least ``steps``."""
        rows = [row for row in self.rows if all(row[name] == value for name, value in key.items())]
        return rows if rows and max(row["env_steps"] for row in rows) >= steps else []

    def put(
        self, key: Mapping[str, Any], task: Task, records: list[dict[str, float]]
    ) -> list[dict[str, Any]]:
        """Write what is known of a run, in place of what was known before."""
        simulator = {} if task.env == PENDULUM else {"sim": EnvSpec.parse(task.env).simulator}
        common = dict(
            key,
            **simulator,
            task=exploration.TASKS.get(task.env, task.name),
            planner="policy",
            execution="policy",
            n=len(task),
            scale="paper",
        )
        new = [
            dict(
                common,
                env_steps=record["steps"],
                metric=metric,
                value=record[metric],
                unit=SETUPS[task.env].unit if unit == "m" else unit,
            )
            for record in records
            for metric, unit in UNITS.items()
            if metric in record
        ]
        others = [
            row for row in self.rows if any(row[name] != value for name, value in key.items())
        ]
        self.rows = [*others, *new]
        pd.DataFrame(self.rows).to_csv(self.path, index=False)
        return new


def run(
    table: Table,
    env: str,
    algorithm: str,
    setting: Mapping[str, float],
    *,
    split: str,
    steps: int,
    records: int,
    seed: int,
) -> dict[str, float]:
    """The last record of a run, on targets of ``split``: from the table, or learned now and put there."""
    subset = {"validation": "search", "test": ""}[split]
    key = dict(env=env, model=algorithm, subset=subset, configuration=named(setting), seed=seed)
    rows = table.kept(key, steps)
    if not rows:
        task, found = SETUPS[env].task(split), []
        for record in learn(algorithm, task, setting, steps=steps, records=records, seed=seed):
            found.append(record)
            rows = table.put(key, task, found)
    last = {row["metric"]: row["value"] for row in rows}  # rows are in the order of time
    print(
        f"{env} {algorithm} {named(setting)}, seed {seed}, {split}: "
        + ", ".join(f"{metric} {value:.3f}" for metric, value in last.items()),
        flush=True,
    )
    return last


def search(table: Table, env: str, algorithm: str, *, steps: int) -> dict[str, float]:
    """The configuration with the highest return on the validation targets."""
    options = dict(split="validation", steps=steps, records=2, seed=SEARCH_SEED)
    return max(
        SETTINGS[algorithm], key=lambda s: run(table, env, algorithm, s, **options)["return_true"]
    )


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument(
        "--env", choices=(*ENVS, PENDULUM), help=f"one task instead of {' and '.join(ENVS)}"
    )
    found.add_argument(
        "--algorithm", nargs="+", choices=ALGORITHMS, default=GRADIENTS, help="default ppo and trpo"
    )
    found.add_argument(
        "--steps", type=int, default=0, help=f"of the environment, by each seed (default {STEPS})"
    )
    found.add_argument("--seeds", type=int, default=3, help="0, 1, ... (default 3)")
    found.add_argument(
        "--records", type=int, default=RECORDS, help=f"along each curve (default {RECORDS})"
    )
    found.add_argument(
        "--out",
        type=Path,
        default=ROOT / "runs/paper/seed0/metrics/model_free.csv",
        help="the table",
    )
    return found


def main(given: list[str] | None = None) -> None:
    """The command."""
    arguments = parser().parse_args(given)
    if arguments.steps < 0 or min(arguments.seeds, arguments.records) < 1:
        raise SystemExit(
            f"steps {arguments.steps}, seeds {arguments.seeds}, records {arguments.records}: expected positive numbers"
        )
    torch.set_num_threads(1)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    table = Table(arguments.out)
    pairs = list(itertools.product([arguments.env] if arguments.env else ENVS, arguments.algorithm))
    steps = {env: arguments.steps or most for env, most in STEPS.items()}
    tried = {env: min(steps[env], most) for env, most in SEARCH_STEPS.items()}
    best = {
        (env, algorithm): search(table, env, algorithm, steps=tried[env])
        for env, algorithm in pairs
    }
    for seed in range(arguments.seeds):
        for env, algorithm in pairs:
            run(
                table,
                env,
                algorithm,
                best[env, algorithm],
                split="test",
                steps=steps[env],
                records=arguments.records,
                seed=seed,
            )
    print(arguments.out)


if __name__ == "__main__":
    main()
