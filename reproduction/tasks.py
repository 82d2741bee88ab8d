"""The frozen starts and targets of each environment's task."""

from contextlib import closing
from dataclasses import replace

import gymnasium
import numpy as np
import torch

from tsmlib.envs.physics import Physics
from tsmlib.envs.spec import EnvSpec
from tsmlib.planning.tasks import Task
from tsmlib.storage import artifacts
from reproduction.data import TASK_SEED, remade_by
from reproduction.runs import ROOT

FROZEN = ROOT / "data" / "tasks"


def load_task(env: str, split: str = "test") -> Task:
    """100 starts and targets of an environment's task. ``test`` ones are frozen in data/tasks and choose nothing.

    The same with noisy sensors or delayed actions as without; starts are the true states. The same for a variant with
    another mass, damping or gain, drawn from its own reset where lengths or radius are others.
    """
    spec = EnvSpec.parse(env)
    shape = Physics(
        link_lengths=spec.physics.link_lengths, object_radius=spec.physics.object_radius
    )
    arm = replace(spec.arm, physics=shape).id
    if arm != env:
        return replace(load_task(arm, split), env=env)
    path = FROZEN / f"{EnvSpec.parse(env).name}.safetensors"
    if split == "test" and path.exists():
        tensors, header = artifacts.load(path, kind="task")
        with remade_by("python benchmarks/settings/freeze_tasks.py", path):
            artifacts.require_fit(path, header, {"env": env})
        return Task.standard(env, tensors["start"].numpy(), tensors["target"])
    return draw_task(env, seed=TASK_SEED[split])


def draw_task(env: str, *, seed: int, n: int = 100) -> Task:
    """Starts and targets from the environment's reset."""
    with closing(gymnasium.make_vec(env, num_envs=n)) as copies:
        start, info = copies.reset(seed=seed)
    return Task.standard(env, start.astype(np.float32), torch.from_numpy(info["target"]).float())
