"""Speed of the parts that take the time, beside something that everybody knows: ``make bench``.

Each part is timed in turn with its reference in one process, in rounds; medians of the ratios are
printed. On one thread: OMP_NUM_THREADS=1 python benchmarks/speed.py [--rounds 5]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial

import gymnasium
import numpy as np
import torch

import tsmlib
from reproduction.episodes import random_data
from reproduction.symmetry import symmetric
from tsmlib.models.tsm import TSM
from tsmlib.training.fit import keep_freed_memory

ENV = "tsm/ReacherPush-v1"
Work = Callable[[], object]


def seconds(work: Work) -> float:
    """CPU seconds of one call, which other work on the machine disturbs less than the clock."""
    began = time.process_time()
    work()
    return time.process_time() - began


def stepped(n: int) -> None:
    """Episodes of one arm, step by step, as Gymnasium does it."""
    rng = np.random.default_rng(0)
    with closing(gymnasium.make(ENV)) as arm:
        for episode in range(n):
            arm.reset(seed=episode)
            for action in rng.uniform(-0.1, 0.1, (100, 2)).astype(np.float32):
                arm.step(action)


def products(seconds_long: float = 0.2, size: int = 512) -> float:
    """Products of matrices, in floating point operations a CPU second: what the processor can."""
    left, right, done = torch.randn(size, size), torch.randn(size, size), 0
    began = time.process_time()
    while (took := time.process_time() - began) < seconds_long:
        left @ right
        done += 1
    return 2 * size**3 * done / took


def segment_shapes(net: TSM, n: int) -> list[tuple[int, int, int]]:
    """Products of a free-running segment of n rows and its gradient, rows x inner x columns."""
    decoder, steps = net.decoder, net.segment_len
    channels, last, known = decoder.inlet.out_features, len(decoder.dilations) - 1, net.past_len - 1
    found, owed = [], 0
    for layer in reversed(range(last + 1)):
        past, owed = owed, min(known, owed + decoder.dilations[layer])
        for rows, times in ((past * n, 1), (n, steps)):  # the past at once, then each step
            found += times * [
                (rows, 2 * channels, 2 * channels),
                (rows, 2 * channels, 2 * channels),
            ]
            found += times * 2 * [(rows, channels, channels)] * (layer < last)
        found += 2 * [(2 * channels, (past + steps) * n, channels)]
        found += [(channels, (past + steps) * n, channels)] * (layer < last)
    mixed = (last + 1) * channels
    found += steps * [(n, mixed, channels), (n, channels, mixed)] + [(channels, steps * n, mixed)]
    for linear in decoder.head:
        if isinstance(linear, torch.nn.Linear):
            a, b = linear.in_features, linear.out_features
            found += steps * [(n, a, b), (n, b, a)] + [(b, steps * n, a)]
    return [shape for shape in found if shape[0]]


def parts(n: int) -> dict[str, tuple[Work, Work, float]]:
    """Name -> work, reference, and how much more the first does than the second."""
    train = symmetric(random_data(ENV, 50, seed=0))
    held_out = random_data(ENV, 10, seed=1)
    task = tsmlib.load_task(ENV).take(10)
    models = {word: tsmlib.load_pretrained(word, env=ENV) for word in ("tsm", "rtsm", "onestep")}
    prior = tsmlib.load_pretrained("prior", env=ENV)
    codes = tsmlib.LatentActions(prior, task.horizon)
    noise = torch.Generator().manual_seed(0)
    torques = tsmlib.smooth_torques(10 * n, 100, generator=noise).unflatten(0, (n, 10))
    options = tsmlib.TrainingOptions(steps=5, batch_size=128, warmup=1, validate_every=5)
    simulate = tsmlib.simulator_predictor(task)

    def rolled(word: str) -> None:
        net = models[word]
        with torch.no_grad():
            tsmlib.model_predictor(net, task.past(net.past_len))(torques)

    def planned(word: str) -> None:
        net = models[word]
        predict = tsmlib.model_predictor(net, task.past(net.past_len))
        tsmlib.cem(predict, task.reward, codes, len(task), candidates=n, elites=4, iterations=2)

    def trained(word: str) -> None:
        copy = type(models[word]).for_data(train, seed=0)
        tsmlib.fit(copy, train, held_out, options, progress=False)

    net = models["tsm"]
    rows = 128
    past = tsmlib.Segment(*(part.repeat(rows // 10 + 1, 1, 1)[:rows] for part in task.past(10)))
    moves = tsmlib.smooth_torques(rows, net.segment_len, generator=noise)
    shapes = segment_shapes(net, rows)
    pairs = [(torch.randn(a, b), torch.randn(b, c)) for a, b, c in shapes]

    def segment(at_once: bool) -> None:
        if at_once:
            states = net.predict_segment(past, moves)
        else:
            step = net.begin(past)
            states = torch.stack([step(u) for u in moves.unbind(1)], dim=1)
        states.square().sum().backward()

    def multiplied() -> None:
        for left, right in pairs:
            torch.mm(left, right)

    found: dict[str, tuple[Work, Work, float]] = {
        "collect 100 episodes / Gymnasium's steps": (
            partial(random_data, ENV, 100, seed=0),
            partial(stepped, 2),
            50.0,
        )
    }
    whole = partial(segment, True)
    found["segment of tsm, gradient / its products"] = (whole, multiplied, 1.0)
    found["segment of tsm, gradient / step by step"] = (whole, partial(segment, False), 1.0)
    for word in models:
        about = f"imagine {10 * n} futures by {word} / MuJoCo"
        found[about] = (partial(rolled, word), partial(simulate, torques), 1.0)
    for word in ("tsm", "rtsm"):
        found[f"plan with {word} / with onestep"] = (
            partial(planned, word),
            partial(planned, "onestep"),
            1.0,
        )
        found[f"train {word} / onestep"] = (
            partial(trained, word),
            partial(trained, "onestep"),
            1.0,
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--candidates", type=int, default=16)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as in every training
    print(f"matrix products: {products() / 1e9:.1f} Gflop a second")
    print("| what | times as fast, median (lowest to highest) |\n|---|---|")
    for name, (work, reference, more) in parts(arguments.candidates).items():
        work()  # what torch makes ready once
        ratios = [more * seconds(reference) / seconds(work) for _ in range(arguments.rounds)]
        print(f"| {name} | {np.median(ratios):.2g} ({min(ratios):.2g} to {max(ratios):.2g}) |")


if __name__ == "__main__":
    main()
