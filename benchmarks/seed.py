"""Cost of one seed of the whole study at scale paper: the sum of its parts, in CPU seconds.

The trainings of every model of the three MuJoCo arms and of two imperfect ones, their scores, plans by CEM on 100
targets of two tasks, and policies: what notebooks 02, 03, 05 and 06 need for every seed. Not counted are the ablations,
the map of seed 0, other planners, closed loops and the oracle in 05, and what 04 and 07 look at. Of
every part a little is done in each round, with one thread, and multiplied by how often the seed does it: updates of
each stage of each training, episodes of each score, iterations of each plan, updates of each policy. Every update does
the same work, and so on. The reference is the budget of two hours on two cores, so this row, unlike all others, depends
on the machine and on what else it does.

    python benchmarks/seed.py        or        python -m tsmlib bench seed
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from _rounds import Row, parsed, parser, peak_bytes, save
from tqdm.auto import tqdm
from train import training

from tsmlib import study
from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, MUJOCO_IDS, NOISE
from tsmlib.evaluation import prediction
from tsmlib.figures.method import Method
from tsmlib.planning.planners import cem, reevaluate
from tsmlib.planning.predictors import fresh_predictor, model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.policies.learning import LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy
from tsmlib.study import needed, runs, zoo
from tsmlib.study.policies import complete
from tsmlib.study.results import planning as planning_results
from tsmlib.study.results import prediction as prediction_results
from tsmlib.trajectory import Trajectories

BUDGET = 2 * 2 * 3600.0  # seconds of two cores in two hours
REACH, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"
IMPERFECT = (imperfect(REACH, noise=NOISE), imperfect(REACH, delay=DELAY))
WORDS = {
    "train": "all trainings of a seed: CPU seconds", "score": "all scores of a seed: CPU seconds",
    "plan": "all plans of a seed: CPU seconds", "policy": "all policies of a seed: CPU seconds",
    "a whole seed": "these parts of a whole seed, the sum: CPU seconds",
}  # fmt: skip


@dataclass(frozen=True)
class Part:
    """Something that a seed does ``times`` times what ``call`` does."""

    kind: str
    call: Callable[[], object]
    times: float


def main() -> None:
    options = parser(__doc__, rounds=2)
    options.add_argument("--models", default=",".join(zoo.words("dynamics")))
    options.add_argument("--envs", default=",".join(MUJOCO_IDS))
    options.add_argument("--little", type=int, default=10, help="episodes, and targets, of each part (default 10)")
    options.add_argument("--updates", type=int, default=3, help="of each training and policy (default 3)")
    arguments = parsed(options)
    parts = list(everything(arguments))
    peaks: dict[str, int] = defaultdict(int)
    seconds: dict[str, list[float]] = defaultdict(list)
    for _ in tqdm(range(arguments.rounds), desc="rounds"):
        spent: dict[str, float] = defaultdict(float)
        for part in tqdm(parts, desc="parts", leave=False):
            taken: list[float] = []
            peak = peak_bytes(lambda part=part, taken=taken: taken.append(cpu_seconds(part.call)))
            spent[part.kind] += part.times * taken[0]
            peaks[part.kind] = max(peaks[part.kind], peak)
        for name, value in spent.items():
            seconds[name].append(value)
    kinds = list(dict.fromkeys(part.kind for part in parts))
    seconds["a whole seed"] = np.sum([seconds[kind] for kind in kinds], 0).tolist()
    peaks["a whole seed"] = max(peaks.values())
    rows = [
        Row.of(
            WORDS[kind], np.array(seconds[kind]), "two hours of two cores", BUDGET, unit="s", peak=peaks[kind],
            configuration=kind, metric="seconds", sim="mujoco",
        )
        for kind in (*kinds, "a whole seed")
    ]  # fmt: skip
    count = {kind: sum(part.kind == kind for part in parts) for kind in kinds}
    print(", ".join(f"{kind}: {n} parts" for kind, n in count.items()) + f"; {arguments.rounds} rounds, one thread")
    save("seed", rows)


def cpu_seconds(call: Callable[[], object]) -> float:
    """Of one call, or what it says itself."""
    began = time.process_time()
    own = call()
    return own if isinstance(own, float) else time.process_time() - began


def everything(arguments: argparse.Namespace) -> Iterator[Part]:
    """The parts of a seed."""
    run, models = runs.resolve("bench", scale="paper"), arguments.models.split(",")
    envs = arguments.envs.split(",")
    data = {env: study.random_data(env, 200, seed=0) for env in (*envs, *(IMPERFECT if REACH in envs else ()))}
    few = {env: study.random_data(env, arguments.little, seed=1) for env in data}
    robust = [word for word in models if word in (zoo.PAPERS, zoo.OURS, "onestep", "multistep", "lstm")]
    nets = {(env, word): study.initialise(run, word, data[env]) for env in data for word in (*models, "prior")}
    for env in data:
        for word in robust if env in IMPERFECT else models:
            yield from trainings(run, env, word, data[env], arguments.updates)
            yield from scores(nets[env, word], few[env])
    for env in (env for env in (REACH, PUSH) if env in envs):
        yield from trainings(run, env, "prior", data[env], arguments.updates)
        task = study.load_task(env, "validation")
        for word in models:
            if word in planning_results.PAPER:
                yield from plans(nets[env, word], nets[env, "prior"], task, arguments.little)
    for env, way, iterations in learned(envs, models):
        prior = nets[REACH if env in IMPERFECT else env, "prior"] if way.search_space == "latent" else None
        yield policies(nets[env, way.model], prior, study.load_task(env), arguments.updates, iterations)


def learned(envs: list[str], models: list[str]) -> list[tuple[str, Method, int]]:
    """The policies of 05 and 06 in environments and models that are asked for: environment, method, iterations."""
    run = runs.resolve("05_control", scale="paper")
    robust = needed.robustness(runs.resolve("06_robustness", scale="paper"))
    asked = needed.control(run).policies
    asked += [(robust.worlds[world], way, budget) for (world, way), budget in robust.policies.items()]
    known = {*envs, *(IMPERFECT if REACH in envs else ())}
    found = {
        (env, way): complete(run, budget).iterations
        for env, way, budget in asked
        if env in known and way.model in models
    }
    return [(*key, iterations) for key, iterations in found.items()]


def trainings(run: runs.Run, env: str, word: str, data: Trajectories, n: int) -> Iterator[Part]:
    """The stages of one model; an update costs the same at any time."""
    net, held_out = study.initialise(run, word, data), data.take(slice(1))
    for stage in study.schedule(run, env, word):
        few = training(net, stage, (data, held_out), updates=n)
        yield Part("train", few, stage.steps / n)


def scores(net: Any, few: Trajectories) -> Iterator[Part]:
    """Open loop and by segments, 1,000 test and 200 validation episodes."""
    for options in ({"horizon": 90}, {"horizon": 10, "starts": list(prediction_results.SEGMENTS)}):
        yield Part("score", partial(prediction.score, net, net.features, few, few, samples=32, **options),
                   1200 / (2 * len(few)))  # fmt: skip


def plans(net: Any, prior: Any, task: Task, n: int) -> Iterator[Part]:
    """CEM of 96 candidates and 10 iterations in both search spaces, and predicted returns from 32 other samples."""
    few, horizon = task.take(n), task.horizon
    past = few.past(net.past_len)
    for space in (LatentActions(prior, horizon), DirectActions(horizon)):
        predict, judge = model_predictor(net, past), fresh_predictor(net, past, seed=1)

        def call(space: Any = space, predict: Any = predict) -> None:
            cem(predict, few.reward, space, len(few), candidates=96, elites=9, iterations=2)

        found = cem(predict, few.reward, space, len(few), candidates=2, elites=2, iterations=1)
        yield Part("plan", call, 10 / 2 * len(task) / len(few))
        yield Part("plan", partial(reevaluate, found, judge, few.reward), len(task) / len(few))


def policies(net: Any, prior: Any, task: Task, n: int, iterations: int) -> Part:
    """Three copies; acting through the prior where there is one."""
    draw = episodes_from(torch.from_numpy(task.start))
    dx, angles = task.start.shape[1], net.features.angles
    learner: Any = (
        OneStepPolicy(dx, 2, angles=angles, copies=3) if prior is None
        else SegmentPolicy(dx, prior, angles=angles, copies=3)
    )  # fmt: skip
    few = LearningOptions(iterations=n, record_every=n)
    return Part("policy", lambda: learn_policy(learner, net, task.reward_for, draw, few).seconds[-1], iterations / n)


if __name__ == "__main__":
    main()
