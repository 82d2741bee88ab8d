"""The frozen starts and targets of each environment's task."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import torch

import tsmlib.envs
from tsmlib.envs.spec import imperfections
from tsmlib.planning.tasks import Task
from tsmlib.storage import artifacts
from tsmlib.study.data import short
from tsmlib.study.runs import ROOT

TASK_SEED = {"validation": 1_000_003, "test": 1_000_004}
FROZEN = ROOT / "data" / "tasks"


def task(env: str, split: str = "test") -> Task:
    """100 starts and targets of an environment's task. ``test`` ones are frozen in data/tasks and choose nothing.

    The same with noisy sensors or delayed actions as without; starts are the true states.
    """
    arm, _, _ = imperfections(env)
    if arm != env:
        return replace(task(arm, split), env=env)
    path = FROZEN / f"{short(env)}.safetensors"
    if split == "test" and path.exists():
        tensors, header = artifacts.load(path, kind="task")
        return Task(header["task"], header["env"], tensors["start"].numpy(), tensors["target"])
    return draw_task(env, seed=TASK_SEED[split])


def draw_task(env: str, *, seed: int, n: int = 100) -> Task:
    """Starts from the environment's reset, targets uniform in the disc of radius 0.2 m."""
    copies = gymnasium.make_vec(env, num_envs=n)
    start, info = copies.reset(seed=seed)
    copies.close()
    name = "push" if "Push" in env else "reach"
    return Task(name, env, start.astype(np.float32), torch.from_numpy(info["target"]).float())


def freeze_tasks() -> None:
    """Write the test tasks of every environment into data/tasks. Done once; a test compares them with a new draw."""
    for env in tsmlib.envs.ENV_IDS:
        drawn = draw_task(env, seed=TASK_SEED["test"])
        path = FROZEN / f"{short(env)}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        header = {"task": drawn.name, "env": env, "seed": TASK_SEED["test"]}
        artifacts.save(path, {"start": drawn.start, "target": drawn.target}, kind="task", header=header)
