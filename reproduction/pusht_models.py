"""PushT through other models: ``python -m reproduction.pusht_models``.

All learn from the same play in the same seconds of one core, and plan by the same search, a third
of the shipped one. ``egocentric`` and ``world`` are one network and one schedule, that sees places
from the T or from the world, trained on several of its own steps; the others are the zoo's, by its
settings. States, not pixels; random play, no demonstrations.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

from torch import nn

import tsmlib
from reproduction import pusht, schedules
from tsmlib.models.baselines import OneStep
from tsmlib.models.egocentric import Egocentric
from tsmlib.planning.pusht import random_play
from tsmlib.pretrained import load_pusht
from tsmlib.training.fit import fit
from tsmlib.training.options import TrainingOptions
from tsmlib.trajectory import Trajectories
from tsmlib.zoo import find

EPISODES = 1450  # of play, a quarter of the shipped model's
SECONDS = 200.0
WORDS = ("egocentric", "world", "rtsm", "onestep", "tsm", "lstm", "ensemble+mse")
SEARCH = {"candidates": 64, "elites": 8, "iterations": 3}
Stages = list[tuple[str, TrainingOptions, float]]  # loss, options, share of the seconds


def stages(word: str, data: Trajectories, seed: int) -> tuple[nn.Module, Stages]:
    """An untrained model, and how it is trained."""
    if word in ("egocentric", "world"):
        cls = Egocentric if word == "egocentric" else OneStep
        loss = "loss" if word == "egocentric" else "multi_step_loss"
        spans = [(loss, pusht.options(stage), stage[3][1] - stage[3][0]) for stage in pusht.STAGES]
        return cls.for_data(data, seed=seed, hidden=128), spans
    spec = find(word)
    options = spec.arguments(tsmlib.envs.spec.EnvSpec.parse("tsm/ReacherPush-v1"))
    model = cast("type[tsmlib.OneStep]", spec.load()).for_data(data, seed=seed, **options)
    return model, [
        (stage.updates.loss, schedules.options(stage.updates, model.past_len), stage.share)
        for stage in spec.pushing or spec.stages
    ]


def train(
    model: nn.Module,
    parts: Stages,
    data: Trajectories,
    held_out: Trajectories,
    seconds: float,
    seed: int,
) -> tuple[int, float]:
    """As many updates as fit in the seconds, by the time that a few take: updates and seconds."""
    total, spent, left = 0, 0.0, sum(share for *_, share in parts)
    for loss, options, share in parts:
        trial = copy.deepcopy(model)
        marks = []
        for steps in (5, 35):
            began = time.process_time()
            few = replace(options, steps=steps, validate_every=steps)
            fit(trial, data, held_out, few, getattr(trial, loss), seed=seed, progress=False)
            marks.append(time.process_time() - began)
        ahead = share / left * (seconds - spent)
        updates = max(20, round(ahead * 30 / (marks[1] - marks[0])))
        whole = replace(options, steps=updates, validate_every=max(10, updates // 2))
        began = time.process_time()
        fit(model, data, held_out, whole, getattr(model, loss), seed=seed, progress=False)
        total, spent, left = total + updates, spent + time.process_time() - began, left - share
    return total, spent


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--words", nargs="+", default=WORDS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("data/results/11_pusht_models.csv"))
    given = parser.parse_args(words)
    table = pusht.Table(given.out)
    data = random_play(EPISODES, seed=1000 * given.seed)
    held_out = random_play(pusht.HELD_OUT, seed=1000 * given.seed + 999, symmetries=False)
    for word in given.words:
        if table.has(word, "C", given.seed):
            continue
        model, parts = stages(word, data, given.seed)
        updates, spent = train(model, parts, data, held_out, given.seconds, given.seed)
        weights = sum(weight.numel() for weight in model.parameters())
        about: pusht.Row = {"trained": round(spent, 1), "updates": updates, "weights": weights}
        for protocol in "BC":
            task = load_pusht("test", protocol).take(given.pairs)
            trial = pusht.trial(model, task, protocol, seed=given.seed, **SEARCH)
            table.add(pusht.row(task, trial, word, protocol, given.seed) | about)


if __name__ == "__main__":
    main()
