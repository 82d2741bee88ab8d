"""The pushing task: how damping, duration, walls, object and starts decide what there is to win in it.

Each line of the table is one setting, judged without any learned model:

    zero, oracle      mean cost (minus the return) of doing nothing, and of plans made through the true simulator:
                      cross-entropy method, 96 candidates x 10 iterations, over the codes of the action prior
    within 5 cm       share of the oracle's plans that end with the object within 5 cm of the target
    moved, at a wall  share of episodes of random torques, as in the training data, in which the object moves by more
                      than 5 mm; and of those, in which it meets a wall

Starts and targets are drawn here from seeds of their own, never those of the frozen tasks in ``data/tasks``.

    python benchmarks/settings/push_task.py                 all settings, 25 targets: about a minute and a half for each
    python benchmarks/settings/push_task.py --targets 0     random torques alone, a few seconds for each
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib import rewards
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs import geometry, mujoco_arm, pymunk_arm, render, variant
from tsmlib.envs.geometry import BLOCK_MASS, DT, START_VELOCITY, closest_gap, fingertip
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.action_prior import ActionPrior
from tsmlib.planning.base import Plan, Predictor
from tsmlib.planning.planners import cem
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.storage import artifacts
from tsmlib.study.runs import ROOT

ENV, OTHER = "tsm/ReacherPush-v1", "tsm/PymunkPush-v1"  # whose numbers are changed
# Every module that has the numbers by name. All are imported before a number is changed: what is imported after it
# would keep the changed one.
PLACES = (geometry, mujoco_arm, pymunk_arm, render)
HERE = Path(__file__).resolve().parent
SEED = {"random": 2_000_001, "targets": 2_000_002}
MOVED = 0.005  # m


@dataclass(frozen=True)
class Setting:
    """One pushing task, by default version 0's. Lengths in metres.

    Rings are distances from the shoulder, uniform over the area.
    """

    decay: float = 0.2  # s; a free object slows down by a factor e in this time
    horizon: int = 100  # steps of 0.02 s
    radius: float = 0.03  # of the object
    wall: float = 0.28  # from the shoulder to each of the four walls' faces
    mass: float = 1.0  # kg
    start: tuple[float, float] = (0.08, 0.17)  # ring of the object's first positions
    target: tuple[float, float] = (0.0, 0.2)  # ring of targets
    shoulder: float = 0.1  # rad; first angles are uniform within plus and minus this
    elbow: float = 0.1


@contextlib.contextmanager
def physics(setting: Setting) -> Iterator[None]:
    """The pushing environments, both simulators, with this drag and these walls; mass and radius are a variant's."""
    numbers = dict(BLOCK_DECAY=setting.decay * BLOCK_MASS / setting.mass, WALL=setting.wall)
    places = [(module, name) for module in PLACES for name in numbers if hasattr(module, name)]
    before = [getattr(module, name) for module, name in places]
    caches = (mujoco_arm.load_model, mujoco_arm.physics_hash)
    try:
        for module, name in places:
            setattr(module, name, numbers[name])
        for kept in caches:
            kept.cache_clear()
        yield
    finally:
        for (module, name), value in zip(places, before, strict=True):
            setattr(module, name, value)
        for kept in caches:
            kept.cache_clear()


def named(setting: Setting, env_id: str = ENV) -> str:
    """The id of the variant with this mass and radius."""
    return variant(env_id, mass=setting.mass, object_radius=setting.radius)


def draw(setting: Setting, n: int, seed: int) -> tuple[np.ndarray, Tensor]:
    """``n`` starts (n, 10) in which arm and object do not touch, and targets (n, 2). Within ``physics``."""
    starts, targets = [], []
    for i in range(n):
        rng = np.random.default_rng((seed, i))
        q = rng.uniform(-1, 1, 2) * (setting.shoulder, setting.elbow)
        arm = np.concatenate([q, rng.uniform(-START_VELOCITY, START_VELOCITY, 2), fingertip(q)])
        targets.append(in_ring(rng, *setting.target))
        while True:
            state = np.concatenate([arm, in_ring(rng, *setting.start), np.zeros(2)])
            if closest_gap(state, named(setting)) > 0.005:
                break
        starts.append(state)
    return np.stack(starts).astype(np.float32), torch.from_numpy(np.stack(targets)).float()


def in_ring(rng: np.random.Generator, inner: float, outer: float) -> np.ndarray:
    """A point (2,) uniform over the area between two radii."""
    radius, angle = np.sqrt(rng.uniform(inner**2, outer**2)), rng.uniform(-np.pi, np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])


def simulate(starts: np.ndarray, actions: Tensor, env_id: str = ENV) -> np.ndarray:
    """States (N, T + 1, 10) from ``starts`` (N, 10) under ``actions`` (N, T, 2), by one thread."""
    threads: dict[str, Any] = {"threads": 1} if EnvSpec.parse(env_id).simulator == "mujoco" else {}
    env = gymnasium.make_vec(env_id, num_envs=len(starts), **threads)
    seen = collect(env, open_loop(actions), horizon=actions.shape[1], states=starts)
    env.close()
    return seen.states


def at_wall(states: np.ndarray, setting: Setting) -> np.ndarray:
    """Episodes (N,) in which the object is within 2 mm of a wall, or would be by the speed that it enters a step with.

    Between two states 20 ms apart it can have been there and back.
    """
    slides = setting.decay * (1 - np.exp(-DT / setting.decay))
    position, velocity = states[:, :-1, 6:8], states[:, :-1, 8:10]
    reached = np.maximum(np.abs(states[:, 1:, 6:8]).max((1, 2)), np.abs(position + slides * velocity).max((1, 2)))
    return reached > setting.wall - setting.radius - 0.002


def of_random_torques(setting: Setting, n: int, env_id: str = ENV) -> dict[str, float]:
    """What happens in ``n`` episodes of the training data's kind."""
    starts, _ = draw(setting, n, SEED["random"])
    torques = smooth_torques(n, setting.horizon, generator=torch.Generator().manual_seed(SEED["random"]))
    states = simulate(starts, torques, named(setting, env_id))
    way = np.linalg.norm(states[..., 6:8] - states[:, :1, 6:8], axis=-1)
    moved = way.max(1) > MOVED
    gap = closest_gap(states, named(setting))
    return {
        "episodes": n,
        "moved": float(moved.mean()),
        "at_wall_of_moved": float(at_wall(states, setting)[moved].mean()),
        "steps_touching": float((gap < 0.002).mean()),
        "way_of_moved": float(way[moved, -1].mean()),
        "penetration_mm": float(1000 * max(0.0, -gap.min())),
    }


@cache
def action_prior() -> ActionPrior:
    """The shipped one. Random torques do not depend on the object, so neither does it."""
    return artifacts.load_model(ROOT / "data" / "pretrained" / "ReacherObstacle" / "prior.safetensors", ActionPrior)


def simulator_predictor(starts: np.ndarray, env_id: str = ENV) -> Predictor:
    """As ``planning.predictors.simulator_predictor``, by one thread."""

    def predict(actions: Tensor) -> Tensor:
        n, n_targets = actions.shape[:2]
        states = simulate(np.tile(starts, (n, 1)), actions.flatten(0, 1), env_id)
        return torch.from_numpy(states[:, 1:]).unflatten(0, (n, n_targets))[None]

    return predict


def oracle(setting: Setting, n: int, *, seed: int, candidates: int = 96, iterations: int = 10) -> tuple[Plan, Tensor]:
    """Plans through the true simulator for ``n`` targets, and the targets."""
    starts, targets = draw(setting, n, SEED["targets"])
    space = LatentActions(action_prior(), setting.horizon)
    plan = cem(
        simulator_predictor(starts, named(setting)), rewards.push(targets), space, n,
        candidates=candidates, elites=max(2, candidates // 10), iterations=iterations, seed=seed,
    )  # fmt: skip
    return plan, targets


def of_plans(setting: Setting, n: int, seed: int) -> dict[str, float]:
    """What doing nothing costs, and what the oracle's plans cost and reach."""
    plan, targets = oracle(setting, n, seed=seed)
    starts, _ = draw(setting, n, SEED["targets"])
    zero = setting.horizon * (torch.from_numpy(starts[:, 6:8]) - targets).norm(dim=1)
    cost, final = -plan.predicted_return, rewards.final_distance(plan.states[0], targets, rewards.BLOCK)
    return {
        "targets": n,
        "zero": float(zero.mean()),
        "oracle": float(cost.mean()),
        "oracle_sem": float(cost.std() / n**0.5),
        "zero_over_oracle": float(zero.mean() / cost.mean()),
        "torque_cost": float(plan.actions.square().sum((1, 2)).mean()),
        "final_mean": float(final.mean()),
        "final_median": float(final.median()),
        "within_5cm": float((final < 0.05).float().mean()),
        "never_moved": float(((plan.states[0][:, -1, 6:8] - torch.from_numpy(starts[:, 6:8])).norm(dim=1) < MOVED)
                             .float().mean()),
        "plan_seconds": plan.seconds,
    }  # fmt: skip


TURNED: dict[str, Any] = dict(shoulder=3.1416, elbow=2.5)  # every direction, and bent
NEAR = Setting(decay=0.05, wall=0.24, **TURNED)
SETTINGS = (
    Setting(horizon=50),  # version 0
    Setting(),
    *(Setting(decay=decay) for decay in (0.1, 0.05, 0.03)),
    Setting(decay=0.05, wall=0.24),
    NEAR,
    replace(NEAR, decay=0.1),
    replace(NEAR, decay=0.03),
    replace(NEAR, horizon=50),
    replace(NEAR, target=(0.05, 0.2)),
    replace(NEAR, radius=0.04, start=(0.09, 0.18), target=(0.05, 0.19)),
    replace(NEAR, mass=0.3),
    replace(NEAR, wall=0.22, target=(0.05, 0.18)),
)

CHOSEN = SETTINGS[10]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=25, help="plans of each setting (default 25; 0: none)")
    parser.add_argument("--episodes", type=int, default=1000, help="of random torques (default 1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the planner")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of settings, from 0 (default all)")
    parser.add_argument("--out", type=Path, default=HERE / "push_task.csv")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    if arguments.out.exists():
        with arguments.out.open(newline="") as file:
            rows = list(csv.DictReader(file))
    for number in arguments.only or range(len(SETTINGS)):
        setting, began = SETTINGS[number], time.process_time()
        with physics(setting):
            found = of_random_torques(setting, arguments.episodes)
            if arguments.targets:
                found |= of_plans(setting, arguments.targets, arguments.seed)
        found |= {"cpu_seconds": time.process_time() - began, "seed": arguments.seed}
        named = {"number": str(number), **{word: str(value) for word, value in asdict(setting).items()}}
        row = named | {word: f"{value:.4g}" for word, value in found.items()}
        rows = [old for old in rows if old["number"] != str(number)] + [row]
        rows.sort(key=lambda row: int(row["number"]))
        with arguments.out.open("w", newline="") as file:
            columns = max((list(row) for row in rows), key=len)
            writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(number, setting, {word: row[word] for word in found}, flush=True)


if __name__ == "__main__":
    main()
