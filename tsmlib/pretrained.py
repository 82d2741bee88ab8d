"""Models and tasks that come with the package."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Literal, cast

import gymnasium
import numpy as np
import torch

import tsmlib.envs
from tsmlib import shipped, zoo
from tsmlib.checks import require_choice, require_type
from tsmlib.envs.physics import Physics
from tsmlib.envs.pusht_field import GOAL
from tsmlib.envs.spec import EnvSpec
from tsmlib.planning.pusht import pusht_task
from tsmlib.planning.tasks import Task
from tsmlib.shipped import INSTALLED as INSTALLED
from tsmlib.shipped import ROOT as ROOT
from tsmlib.storage import artifacts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsmlib.models.base import DynamicsModel
    from tsmlib.policies.networks import OneStepPolicy
    from tsmlib.storage.files import Json

PRETRAINED, TASKS = ROOT / "data" / "pretrained", ROOT / "data" / "tasks"
TASK_SEED = {"validation": 1_000_003, "test": 1_000_004}


def load_pretrained(model: str, *, env: str) -> DynamicsModel:
    """A trained model that comes with the package.

    Args:
        model: its word in the zoo, such as "rtsm", "tsm", "onestep" or "prior".
        env: id of the environment that it predicts.

    Returns:
        The model, on the CPU.

    Raises:
        ValueError: no such model ships for this environment; the message names those that do.
    """
    if env.startswith("tsm/PushT-"):
        return _pusht_model(model)
    trained_on = zoo.trained_on(env, model)
    arm = EnvSpec.parse(trained_on).name
    if not (path := shipped.find(f"data/pretrained/{arm}/{model}.safetensors")).exists():
        files = [*(PRETRAINED / arm).glob("*.safetensors"), *map(PurePath, shipped.digests())]
        there = sorted({file.stem for file in files if file.parent.name == arm} & zoo.ZOO.keys())
        known = f"there are {', '.join(there)}" if there else "there are none"
        raise ValueError(
            f"no pretrained {model} of {env} in {PRETRAINED / arm}: {known}. To train one, type: "
            f"python -m tsmlib make models/{arm}/{model} --scale paper"
        )
    expect = cast("Mapping[str, Json]", tsmlib.envs.fingerprint(trained_on))
    cls = zoo.find(model).load()
    return cast("DynamicsModel", artifacts.load_model(path, cls, expect=expect))


def load_policy(*, env: str) -> OneStepPolicy:
    """A policy that was learned inside the recurrent model and comes with the package.

    Args:
        env: id of the environment that it acts in.

    Returns:
        The policy, on the CPU; ``tsmlib.policies.networks.controller`` makes it act.

    Raises:
        ValueError: none ships for this environment.
    """
    from tsmlib.policies.networks import OneStepPolicy  # heavy

    require_type("env", env, str, "an id, such as 'tsm/ReacherPush-v1'")
    trained_on = zoo.trained_on(env, "rtsm")
    path = PRETRAINED / EnvSpec.parse(trained_on).name / "policy-rtsm-value.safetensors"
    if not path.exists():
        raise ValueError(
            f"no policy of {env} ships; expected tsm/ReacherPush-v1. To learn one: "
            "tsmlib.learn_policy(...)"
        )
    expect = cast("Mapping[str, Json]", tsmlib.envs.fingerprint(trained_on))
    return artifacts.load_model(path, OneStepPolicy, expect=expect)


def load_task(env: str, split: Literal["validation", "test"] = "test") -> Task:
    """A hundred starts and targets of an arm's task; the test ones are frozen.

    A variant with noise, delay, another mass, damping or gain has the task of the standard arm.

    Args:
        env: id of the environment.
        split: "test", which no choice was made on, or "validation".

    Returns:
        The task.
    """
    require_type("env", env, str, "an id, such as 'tsm/ReacherPush-v1'")
    require_choice("split", split, TASK_SEED)
    if env.startswith("tsm/PushT-"):
        return load_pusht(split, env=env)
    spec = EnvSpec.parse(env)
    shape = Physics(
        link_lengths=spec.physics.link_lengths, object_radius=spec.physics.object_radius
    )
    arm = replace(spec.arm, physics=shape).id
    if arm != env:
        return replace(load_task(arm, split), env=env)
    path = TASKS / f"{spec.name}.safetensors"
    if split == "test" and path.exists():
        tensors, header = artifacts.load(path, kind="task")
        artifacts.require_fit(path, header, {"env": env})
        return Task.standard(env, tensors["start"].numpy(), tensors["target"])
    return draw_task(env, seed=TASK_SEED[split])


def load_pusht(
    split: Literal["validation", "test"] = "test", protocol: str = "B", *, env: str = "tsm/PushT-v0"
) -> Task:
    """The pairs (start, goal) of PushT: 500 frozen ones for tests, 200 to make choices on.

    A goal is what random play came to 25 steps after the start. No pair is solved at the start, in
    each the T moves by at least 10 px, and goals lie in the field. Protocol A has one goal, and
    100 starts of each kind, which are resets of ``gym-pusht``.

    Args:
        split: "test", which no choice was made on, or "validation".
        protocol: "A", "B" or "C", see ``planning.pusht``.
        env: id of the field.

    Returns:
        The task.
    """
    name = "PushT-A" if protocol == "A" else "PushT"
    tensors, _ = artifacts.load(TASKS / f"{name}.safetensors", kind="task")
    word = "" if require_choice("split", split, TASK_SEED) == "test" else "validation_"
    start = tensors[f"{word}start"].numpy()
    goal = np.tile(GOAL, (len(start), 1))
    if protocol != "A":
        goal = tensors[f"{word}target"].numpy()
    return pusht_task(start, goal, protocol, env=env)


def _pusht_model(word: str) -> DynamicsModel:
    from tsmlib.models.egocentric import Egocentric  # heavy

    if word != "egocentric":
        raise ValueError(f"no pretrained {word} of PushT; there is egocentric")
    return artifacts.load_model(
        shipped.find(f"data/pretrained/PushT/{word}.safetensors"), Egocentric
    )


def draw_task(env: str, *, seed: int, n: int = 100) -> Task:
    """Starts and targets from the resets of an arm.

    Args:
        env: id of the environment.
        seed: of the first reset.
        n: number of starts.

    Returns:
        The task.
    """
    with closing(gymnasium.make_vec(env, num_envs=n)) as copies:
        start, info = copies.reset(seed=seed)
    return Task.standard(env, start.astype(np.float32), torch.from_numpy(info["target"]).float())
