"""Policies learned without a model, by Stable-Baselines3, on the arms and the pendulum.

Reward, starts, targets and the steps of an episode are those of the policies that are learned
inside models. The configurations are the best of six each, by return on validation targets; the
search is in ``data/results/model_free.csv.gz``, subset "search".

    python benchmarks/model_free/model_free.py --env tsm/Reacher-v0 --algorithm ppo --seeds 0 1 2
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import torch
from tqdm.auto import tqdm

import tsmlib
from reproduction.rounds import WORLDS
from reproduction.runs import home
from reproduction.tables import Row, place, write
from tsmlib.trajectory import Segment

GAMMA = 0.99  # A.3
MINIBATCH = 250  # steps
RECORDS = 25  # along a curve, and one before
PENDULUM = "Pendulum-v1"
STEPS = {"tsm/Reacher-v0": 300_000, "tsm/ReacherPush-v1": 1_000_000, PENDULUM: 100_000}
SETTINGS: dict[tuple[str, str], dict[str, float]] = {
    ("tsm/Reacher-v0", "ppo"): {"learning_rate": 1e-3, "episodes": 20, "std": 0.37},
    ("tsm/Reacher-v0", "trpo"): {"target_kl": 0.03, "episodes": 80, "std": 0.37},
    ("tsm/ReacherPush-v1", "ppo"): {"learning_rate": 3e-4, "episodes": 80, "std": 0.37},
    ("tsm/ReacherPush-v1", "trpo"): {"target_kl": 0.01, "episodes": 80, "std": 0.37},
    ("tsm/ReacherPush-v1", "sac"): {"learning_rate": 1e-3, "episodes": 20, "updates": 1},
    (PENDULUM, "ppo"): {"learning_rate": 1e-3, "episodes": 20, "std": 0.37},
    (PENDULUM, "trpo"): {"target_kl": 0.03, "episodes": 20, "std": 0.37},
    (PENDULUM, "sac"): {"learning_rate": 1e-3, "episodes": 40, "updates": 1},
}  # episodes: side by side; std: of the actions, at first; updates: per step of the environment


def measured_task(env: str) -> tsmlib.Task:
    """What a policy is measured on: the frozen targets, or the starts of the rounds."""
    return WORLDS["Pendulum"].task(8, 1000) if env == PENDULUM else tsmlib.load_task(env)


class Episodes:
    """Episodes of a task's length in n robots at once; starts and targets are the environment's."""

    def __init__(self, env: str, n: int, *, seed: int) -> None:
        mode = {"vectorization_mode": "sync"} if env == PENDULUM else {}
        self.task = measured_task(env)
        self.robots = gymnasium.make_vec(env, num_envs=n, **mode).unwrapped
        self.actions = gymnasium.spaces.Box(-1, 1, (self.task.action_dim,), np.float32)
        seeds = np.random.SeedSequence(seed).generate_state(n).tolist()
        self.seed: int | list[int] | None = seeds if env == PENDULUM else seed  # of the first reset
        self.taken = 0

    def seen(self, states: np.ndarray, target: np.ndarray) -> np.ndarray:
        """What a policy sees, as ours do: angles as cosine and sine, the rest, the target."""
        if not target.shape[1]:
            return states.astype(np.float32)
        angles = states[:, :2]
        parts = [np.cos(angles), np.sin(angles), states[:, 2:], target]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    @property
    def target(self) -> np.ndarray:
        """Targets of the episodes (n, dg); none of the pendulum."""
        return getattr(self.robots, "target", np.zeros((self.robots.num_envs, 0)))

    def reset(self) -> np.ndarray:
        """Begin n episodes: their first observations (n, k)."""
        states, _ = self.robots.reset(seed=self.seed)
        self.seed, self.taken = None, 0
        return self.seen(states, self.target)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Actions (n, du) -> observations (n, k), rewards (n,), whether the episodes are over."""
        actions = np.clip(actions, -1, 1)
        scaled = actions * self.robots.single_action_space.high
        states, *_ = self.robots.step(scaled.astype(np.float32))
        reward = self.task.reward_for(torch.from_numpy(self.target).float())
        seen = torch.from_numpy(states).float()[:, None], torch.from_numpy(actions).float()[:, None]
        self.taken += 1
        over = self.taken == self.task.horizon
        return self.seen(states, self.target), reward(*seen)[:, 0].numpy(), over


def measured(episodes: Episodes, predict: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
    """Executed return, success and distance of a policy: means over the task's targets."""
    task = episodes.task

    def control(past: Segment) -> torch.Tensor:
        seen = episodes.seen(past.states[:, -1].numpy(), task.target.numpy())
        return torch.from_numpy(np.asarray(predict(seen), np.float32))[:, None]

    done = tsmlib.execute(task, control)
    found = {"return_true": float(done.executed_return.mean())}
    if done.success is not None:
        found["success"] = float(done.success.float().mean())
    if task.position is not None:
        found["final_distance"] = float(done.final_distance.mean())
    return found


def vectorised(episodes: Episodes) -> object:
    """``episodes`` as a vector environment of Stable-Baselines3; an end is a limit of time."""
    from stable_baselines3.common.vec_env import VecEnv

    first = episodes.reset()

    class Vectorised(VecEnv):
        def __init__(self) -> None:
            space = gymnasium.spaces.Box(-np.inf, np.inf, first.shape[1:], np.float32)
            super().__init__(len(first), space, episodes.actions)

        def reset(self) -> np.ndarray:
            return episodes.reset()

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, object]]]:
            seen, rewards, over = episodes.step(self.actions)
            infos: list[dict[str, object]] = [{} for _ in seen]
            if over:
                infos = [{"terminal_observation": x, "TimeLimit.truncated": True} for x in seen]
                seen = episodes.reset()
            return seen, rewards.astype(np.float32), np.full(self.num_envs, over), infos

        def close(self) -> None:
            episodes.robots.close()

        def get_attr(self, attr_name: str, indices: object = None) -> list[object]:
            return [getattr(episodes.robots, attr_name)] * self.num_envs

        def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
            raise NotImplementedError("the episodes share their attributes")

        def env_method(self, name: str, *args: object, **kwargs: object) -> list[object]:
            raise NotImplementedError("the episodes share their methods")

        def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
            return [False] * self.num_envs

    return Vectorised()


def learner(algorithm: str, episodes: Episodes, setting: dict[str, float], *, seed: int) -> object:
    """The library's algorithm; what is not named here is the library's default."""
    from sb3_contrib import TRPO
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.vec_env import VecNormalize

    own = {k: v for k, v in setting.items() if k not in ("episodes", "std", "updates")}
    robots = VecNormalize(vectorised(episodes), gamma=GAMMA)
    how = {"gamma": GAMMA, "seed": seed, "device": "cpu", **own}
    if algorithm == "sac":
        updates = max(1, round(setting["updates"] * setting["episodes"]))
        network = {"net_arch": [64, 64]}
        return SAC("MlpPolicy", robots, policy_kwargs=network, gradient_steps=updates, **how)
    network = {"net_arch": [64, 64], "activation_fn": torch.nn.ReLU}
    network["log_std_init"] = math.log(setting["std"])
    how |= {"n_steps": episodes.task.horizon, "batch_size": MINIBATCH}
    return {"ppo": PPO, "trpo": TRPO}[algorithm]("MlpPolicy", robots, policy_kwargs=network, **how)


def learn(env: str, algorithm: str, *, steps: int, seed: int) -> list[Row]:
    """One run: rows before it and RECORDS times along the way."""
    setting = SETTINGS[env, algorithm]
    episodes = Episodes(env, int(setting["episodes"]), seed=seed)
    model = learner(algorithm, episodes, setting, seed=seed)

    def predict(seen: np.ndarray) -> np.ndarray:
        return model.predict(model.env.normalize_obs(seen), deterministic=True)[0]

    about = place(env) | {"model": algorithm, "planner": "policy", "execution": "policy"}
    about |= {"task": episodes.task.name, "n": len(episodes.task), "seed": seed, "scale": "paper"}
    about["configuration"] = " ".join(f"{k}={v:g}" for k, v in setting.items())
    rows: list[Row] = []
    spent, last = 0.0, -1
    for goal in tqdm(np.linspace(0, steps, RECORDS + 1).round().astype(int), desc=f"{env} {seed}"):
        began = time.process_time()
        if goal > model.num_timesteps:
            model.learn(int(goal) - model.num_timesteps, reset_num_timesteps=False)
        spent += time.process_time() - began
        if model.num_timesteps > last:
            last = model.num_timesteps
            found = {**measured(episodes, predict), "cpu_seconds": spent}
            rows += [about | {"env_steps": last, "metric": k, "value": v} for k, v in found.items()]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", choices=STEPS, required=True)
    parser.add_argument("--algorithm", nargs="+", choices=("ppo", "trpo", "sac"), required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=0, help="default: those of the tables")
    parser.add_argument("--out", type=Path, default=home() / "runs" / "model_free")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for algorithm, seed in itertools.product(arguments.algorithm, arguments.seeds):
        steps = arguments.steps or STEPS[arguments.env]
        rows = learn(arguments.env, algorithm, steps=steps, seed=seed)
        name = f"{arguments.env.rpartition('/')[2]}-{algorithm}-{seed}.csv"
        print(write(arguments.out / name, rows))


if __name__ == "__main__":
    main()
