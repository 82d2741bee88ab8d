"""Models of any robot's data, trained for the same time and scored alike, and plans beside the true simulator's.

What 09_your_own measures. An update takes another time on another robot, so the number of updates that fit into a
budget is measured first, on a copy of the model: it is no function of the seed alone.
"""

from __future__ import annotations

import copy
import time
from dataclasses import replace
from typing import Any, NamedTuple, cast

from tsmlib.evaluation.prediction import score
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.base import Planner, SearchSpace
from tsmlib.planning.execution import Trial, execute, mpc
from tsmlib.planning.tasks import Task, random_torques, zero_torques
from tsmlib import zoo
from reproduction.models import TrainedModel
from reproduction.results import robots as results
from reproduction.results.table import Row
from reproduction.runs import Run
from tsmlib.zoo import Stage, Updates
from tsmlib.training.fit import fit
from tsmlib.trajectory import Trajectories


class Recipe(NamedTuple):
    """How a model is trained on another robot: arguments of its class, and stages in shares of the time."""

    arguments: dict[str, bool | int]
    stages: tuple[Stage, ...]


def _stage(loss: str, share: float = 1.0, **options: Any) -> Stage:
    """Muon at the best rate of short trainings of the baselines at pushing. The rate of updates is measured."""
    return Stage(loss, rate=0.0, share=share, muon=0.02, **options)


MODELS = {  # the first half of the segment model's training is of its mode over short windows, which costs least
    "rtsm": Recipe(
        {"hidden": 96},
        (
            _stage("point_loss", 0.4, future_len=10, batch=128, bf16=False, span=(0.0, 0.4)),
            _stage("loss", 0.6, batch=128, bf16=False, span=(0.4, 1.0)),
        ),
    ),
    "onestep": Recipe({}, (_stage("loss", lr=2e-3),)),
    "lstm": Recipe({"hidden": 96}, (_stage("loss", batch=128, lr=2e-3),)),
    "ensemble+mse": Recipe({"gaussian": False}, (_stage("loss", lr=2e-3),)),
}
SAMPLES, SEEN = 32, 10  # of a prediction; steps observed before it
FEWEST = 4  # updates of a stage
WARMUP = 20  # updates


def train_for(
    seconds: float, word: str, data: Trajectories, held_out: Trajectories, *, seed: int = 0
) -> tuple[TrainedModel, float]:
    """One of MODELS after ``seconds`` of training on one core, and the CPU seconds that it really took.

    seconds: 0 is the fewest updates that show that all of it runs.
    """
    arguments, stages = MODELS[word]
    made_for = cast(type[RecurrentTSM], zoo.find(word).load())  # what is used here of one, all have
    net, taken = made_for.for_data(data, seed=seed, **arguments), 0.0
    for stage, key in zip(stages, zoo.keys(stages), strict=True):
        updates = stage.within(0.0, False)
        rate = 1 / _update_seconds(net, updates, data, held_out) if seconds else 0.0
        steps = replace(stage, rate=rate).within(seconds, False).steps if seconds else FEWEST
        options = updates.options(
            net.past_len, steps=steps, validate_every=max(1, steps // 4), warmup=WARMUP
        )
        curve = fit(
            net,
            getattr(net, stage.loss),
            data,
            held_out,
            options,
            seed=seed,
            progress=f"{data.env} {word}: {key}",
        )
        taken += curve.seconds[-1]
    return net, taken


def _update_seconds(
    net: RecurrentTSM, stage: Updates, data: Trajectories, held_out: Trajectories
) -> float:
    """CPU seconds of one update of a copy of ``net``."""
    few, tried = held_out.take(slice(8)), copy.deepcopy(net)
    for updates in (2, 10):  # the first are slower
        began = time.process_time()
        options = stage.options(net.past_len, steps=updates, validate_every=updates, warmup=WARMUP)
        fit(tried, getattr(tried, stage.loss), data, few, options)
        each = (time.process_time() - began) / updates
    return each


def model_rows(
    run: Run, train: Trajectories, held_out: Trajectories, test: Trajectories, seconds: float
) -> list[Row]:
    """Rows of every model's scores on ``test``, each after ``seconds`` of training; see ``results.robots``."""
    rows: list[Row] = []
    for word in MODELS:
        net, taken = train_for(seconds, word, train, held_out, seed=run.seed)
        scores = score(
            net,
            net.features,
            test,
            held_out,
            samples=SAMPLES,
            horizon=max(results.AHEAD),
            starts=(SEEN,),
            seed=run.seed,
            progress=f"{train.env} {word}: scores",
        )
        rows += results.score_rows(run, train.env, word, scores, taken)
    return rows


def reference_rows(
    run: Run,
    task: Task,
    model: str,
    trial: Trial,
    space: SearchSpace,
    planner: Planner,
    *,
    every: int,
    n: int = 4,
) -> list[Row]:
    """Rows of a trial planned through ``model``; on its task also of doing nothing, random actions, and the simulator.

    space, planner, every: those of the trial. The oracle plans by them too, from the first ``n`` starts.
    """
    few = task.take(min(n, len(task)))
    trials = {
        model: (task, trial),
        "oracle": (
            few,
            mpc(few, None, space, planner, every=every, progress=f"{task.env}: oracle"),
        ),
        "zero": (task, execute(task, zero_torques(task))),
        "random": (task, execute(task, random_torques(task, seed=run.seed))),
    }
    return [
        row
        for word, (own, each) in trials.items()
        for row in results.plan_rows(run, own, word, each)
    ]
