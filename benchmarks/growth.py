"""Growth of cost with segment length, horizon, batch, channels, samples, targets, seeds and threads.

Every round runs all sizes of all curves in turn, one call each. The exponent of a curve is the slope of log seconds
over log size by least squares, in each round by itself: 1 is linear growth; overhead makes it smaller at small sizes.

    python benchmarks/growth.py        or        python -m tsmlib bench growth
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import _figure
import numpy as np
import torch
from _rounds import Row, folder, interleaved, parsed, parser, peak_bytes, save
from _simulator import ENV, raw
from plan import models

from tsmlib import rewards, study
from tsmlib.evaluation import prediction
from tsmlib.figures.style import save as save_figure
from tsmlib.models.base import rollout
from tsmlib.models.tsm import TSM
from tsmlib.planning.planners import adam
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import DirectActions
from tsmlib.policies.learning import LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy
from tsmlib.storage import tables
from tsmlib.study import runs
from tsmlib.trajectory import Segment, Window

DX, DU = 10, 2
Call = Callable[[], object]
COLUMNS = ("axis", "curve", "size", "round")


def main() -> None:
    options = parser(__doc__, rounds=3)
    options.add_argument("--largest", type=int, default=0, help="leave larger sizes than this out; 0: none")
    options.add_argument("--only", default="", help="some of the sizes by name, commas between")
    arguments = parsed(options)
    curves: dict[tuple[str, str], dict[int, Call]] = {
        (axis, word): {size: make(size) for size in sizes if not arguments.largest or size <= arguments.largest}
        for axis, (sizes, makers) in axes_of(arguments.threads).items()
        for word, make in makers.items()
        if not arguments.only or axis in arguments.only.split(",")
    }
    ways = {(*curve, size): call for curve, calls in curves.items() for size, call in calls.items()}
    peaks = {way: peak_bytes(call) for way, call in ways.items()}
    named = interleaved({str(way): call for way, call in ways.items()}, arguments.rounds, warm=False)
    rows, points = [], []
    for (axis, word), calls in curves.items():
        sizes = np.array(list(calls))
        seconds = np.stack([named[str((axis, word, size))] for size in calls], axis=1)  # (R, K)
        if len(sizes) > 1:
            found = _figure.exponents(sizes, seconds)
            peak = max(peaks[axis, word, size] for size in calls)
            many = f"{sizes[0]} to {sizes[-1]}"
            linear = "in proportion (-1)" if axis == "threads" else "linear growth (1)"
            rows.append(
                Row.of(
                    f"{_figure.WORDS[word]} against {axis}, {many}", found, linear, 1.0,
                    unit="exponent", peak=peak, env=ENV, sim="mujoco", model="tsm", metric="exponent",
                    configuration=axis,
                )
            )  # fmt: skip
        points += [
            dict(env=ENV, metric="seconds", value=value, unit="s", axis=axis, curve=word, size=int(size), round=i)
            for size, column in zip(sizes, seconds.T, strict=True)
            for i, value in enumerate(column)
        ]
    print(f"{ENV}, {arguments.rounds} rounds, {arguments.threads} threads")
    save("growth", rows)
    tables.save(folder() / "growth_rows.csv", points, extra=COLUMNS)
    print(*save_figure(draw(folder()), folder() / "growth"), sep="\n")


def draw(place: Path) -> Any:
    """The figure of what stands in ``growth_rows.csv`` of a folder; a size measured alone has no curve."""
    found: dict[str, dict[str, dict[int, dict[int, float]]]] = {}
    for row in tables.records(tables.load(place / "growth_rows.csv")):
        by_round = found.setdefault(row["axis"], {}).setdefault(row["curve"], {})
        by_round.setdefault(row["round"], {})[row["size"]] = row["value"]
    panels: dict[str, dict[str, _figure.Curve]] = {}
    for axis, lines in found.items():
        for word, by_round in lines.items():
            sizes = sorted(by_round[0])
            if len(sizes) > 1:
                seconds = np.array([[times[size] for size in sizes] for times in by_round.values()])
                panels.setdefault(axis, {})[word] = (np.array(sizes), seconds)
    return _figure.growth(panels)


def axes_of(threads: int) -> dict[str, tuple[tuple[int, ...], dict[str, Callable[[int], Call]]]]:
    """What is varied -> its sizes, and what is done -> size -> a call of it."""
    run = runs.resolve("bench", scale="laptop")
    data = study.random_data(ENV, 100, seed=0)
    model, _, _ = models(run, ENV)
    task = study.load_task(ENV)
    reach = study.load_task("tsm/Reacher-v0", "validation")
    small, _, _ = models(run, "tsm/Reacher-v0")

    def tsm(**options: Any) -> TSM:
        net = TSM(DX, DU, angles=data.angles, **options)
        net.features.fit(torch.from_numpy(data.states))
        return net

    def plan(n_targets: int, horizon: int) -> Call:
        some = task.take(n_targets)
        predict = model_predictor(model, some.past(model.past_len))
        return partial(adam, predict, some.reward, DirectActions(horizon), n_targets, iterations=1)

    def learn(copies: int) -> float:
        policy: Any = OneStepPolicy(reach.start.shape[1], DU, angles=small.features.angles, copies=copies)
        draw = episodes_from(torch.from_numpy(reach.start))
        options = LearningOptions(iterations=2, record_every=2)
        return learn_policy(policy, small, getattr(rewards, reach.name), draw, options).seconds[-1]

    few = data.take(slice(2))
    cores = os.cpu_count() or 1
    on = partial(with_threads, after=threads)
    return {
        "segment length": ((5, 10, 20, 40), {
            "train": lambda n: update(tsm(segment_len=n), 64), "imagine": lambda n: imagine(tsm(segment_len=n), 100, n),
        }),
        "horizon": ((10, 20, 50, 100), {"imagine": lambda n: imagine(model, 100, n), "plan": lambda n: plan(25, n)}),
        "batch": ((32, 128, 512), {"train": lambda n: update(tsm(channels=64, head_channels=128), n)}),
        "channels": ((16, 32, 64, 128), {
            "train": lambda n: update(tsm(channels=n), 64), "imagine": lambda n: imagine(tsm(channels=n), 200, 10),
        }),
        "samples": ((8, 32, 128), {
            "score": lambda n: partial(prediction.score, model, model.features, few, few, samples=n, horizon=30),
        }),
        "targets": ((12, 25, 50, 100), {"plan": lambda n: plan(n, task.horizon)}),
        "seeds": ((1, 2, 5, 10), {"learn": lambda n: partial(learn, n)}),
        "threads": (tuple(sorted({2**i for i in range(cores.bit_length()) if 2**i <= cores} | {cores})), {
            "train": lambda n: on(n, update(tsm(channels=64, head_channels=128), 128)),
            "imagine": lambda n: on(n, imagine(model, 400, 20)),
            "simulate": lambda n: raw(data.states[:, 0], data.actions[:, :20], threads=n),
        }),
    }  # fmt: skip


def update(net: TSM, batch: int) -> Call:
    """Loss and gradient, free-running over two segments of made-up windows."""
    n = net.segment_len
    drawn = [torch.randn(batch, 3 * n, size, generator=torch.Generator().manual_seed(0)) for size in (DX, DU)]
    window = Window(Segment(*(part[:, :n] for part in drawn)), Segment(*(part[:, n:] for part in drawn)))

    def call() -> None:
        net.zero_grad()
        net.loss(window, torch.Generator().manual_seed(0)).backward()

    return call


def imagine(net: TSM, rows: int, horizon: int) -> Call:
    """Sampled rollouts without a gradient."""
    drawn = [torch.randn(rows, net.past_len, size, generator=torch.Generator().manual_seed(0)) for size in (DX, DU)]
    actions = 0.1 * torch.randn(rows, horizon, DU, generator=torch.Generator().manual_seed(1))

    @torch.no_grad()
    def call() -> None:
        rollout(net, Segment(*drawn), actions, generator=torch.Generator().manual_seed(0))

    return call


def with_threads(n: int, call: Call, *, after: int) -> Call:
    """``call`` on so many threads of torch; ``after`` it there are as many as before."""

    def run() -> None:
        torch.set_num_threads(n)
        try:
            call()
        finally:
            torch.set_num_threads(after)

    return run


if __name__ == "__main__":
    main()
