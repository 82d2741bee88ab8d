"""How the models of the zoo are trained: stages of a budget of seconds become updates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tsmlib.envs.spec import EnvSpec
from tsmlib.training.options import TrainingOptions
from tsmlib.zoo import ModelSpec, Stage, Updates

BUDGET = {  # seconds of training on one core, the same for every dynamics model of an environment
    "Reacher": 320.0,
    "ReacherObstacle": 480.0,
    "ReacherPush": 2320.0,
    "PymunkReacher": 160.0,
    "PymunkObstacle": 160.0,
    "PymunkPush": 580.0,
}


def schedule(model: ModelSpec, env: EnvSpec, share: float = 1.0) -> list[Updates]:
    """How a model is trained in a share of its budget, on an imperfect arm as on the plain one."""
    seconds = BUDGET[env.standard.name] if model.budget is None else model.budget
    stages = (env.task == "push" and model.pushing) or model.stages
    return [within(stage, share * seconds, env.has_block) for stage in stages]


def within(stage: Stage, seconds: float, block: bool) -> Updates:
    """A stage in its share of a budget: updates in tens, and never fewer than 20."""
    steps = 10 * round(seconds * stage.share * stage.rates[block] / 10)
    return replace(stage.updates, steps=max(20, steps))


def options(stage: Updates, past_len: int | None = None) -> TrainingOptions:
    """What ``fit`` takes, for a model with so many steps of past."""
    return TrainingOptions(
        past_len=past_len,
        future_len=stage.future_len,
        steps=stage.steps,
        batch_size=stage.batch,
        lr=stage.lr,
        muon=stage.muon,
        span=stage.span,
    )


def keys(stages: Sequence[Updates]) -> list[str]:
    """A word for each stage of a training: its loss, numbered from the second time on."""
    losses = [stage.loss for stage in stages]
    counts = [1 + losses[:i].count(loss) for i, loss in enumerate(losses)]
    return [f"{loss}-{n}" if n > 1 else loss for loss, n in zip(losses, counts, strict=True)]
