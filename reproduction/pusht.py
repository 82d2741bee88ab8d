"""The table of PushT, from random play to the frozen pairs: ``python -m reproduction.pusht``.

States, not pixels; random play, no demonstrations. One row for each protocol, method and seed; rows
that are there already are not made again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd
import torch
from scipy.stats import binomtest

import tsmlib
from tsmlib.envs.pusht import weak_policy
from tsmlib.models.egocentric import Egocentric
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.pusht import random_play
from tsmlib.pretrained import load_pusht
from tsmlib.training.fit import fit
from tsmlib.training.options import TrainingOptions
from tsmlib.trajectory import Trajectories

EPISODES, HELD_OUT = 5800, 60  # of 100 steps
Row = dict[str, str | int | float]
Executed = Callable[[tsmlib.Task], tsmlib.Trial]
Stage = tuple[int, int, int, tuple[float, float]]  # steps ahead, batch, updates, part of a schedule
STAGES: tuple[Stage, ...] = (
    (1, 1024, 15_555, (0.0, 0.35)),
    (4, 384, 10_000, (0.35, 0.65)),
    (10, 192, 7_777, (0.65, 1.0)),
)
SEARCH = {"candidates": 128, "elites": 12, "iterations": 4}
EVERY, RMS = 5, 0.6  # steps; of full action, of which uniform actions have 0.58
AHEAD = {"A": (40, 1.0), "B": (25, 0.0), "C": (25, 0.0)}  # steps of a plan, smoothness of the noise


def train(
    data: Trajectories, held_out: Trajectories, *, seed: int, share: float = 1.0
) -> Egocentric:
    """The model of random play: one step ahead, then four, then ten on its own predictions."""
    model = Egocentric.for_data(data, seed=seed, hidden=128)
    for stage in STAGES:
        fit(model, data, held_out, options(stage, share), seed=seed)
    return model


def options(stage: Stage, share: float = 1.0) -> TrainingOptions:
    """What ``fit`` takes for a share of a stage."""
    future_len, batch, steps, span = stage
    updates = max(20, round(share * steps))
    return TrainingOptions(
        future_len=future_len,
        steps=updates,
        batch_size=batch,
        lr=2e-3,
        muon=0.01,
        span=span,
        validate_every=max(10, updates // 4),
    )


def trial(
    model: tsmlib.DynamicsModel | None,
    task: tsmlib.Task,
    protocol: str,
    *,
    seed: int,
    space: SearchSpace | None = None,
    once: bool = False,
    **search: int,
) -> tsmlib.Trial:
    """Planning again for what is not solved, or once; without a model in the simulator."""
    ahead, smoothness = AHEAD[protocol]
    space = space or tsmlib.DirectActions(ahead, rms=RMS, smoothness=smoothness)
    planner = partial(tsmlib.cem, **(SEARCH | search), seed=seed)
    if once:
        return tsmlib.mpc(replace(task, horizon=ahead), model, space, planner, every=ahead)
    return tsmlib.mpc(
        task, model, space, planner, every=EVERY, lookahead=ahead, until_success=True, seed=seed
    )


def row(task: tsmlib.Task, trial: tsmlib.Trial, method: str, protocol: str, seed: int) -> Row:
    """One line of the table: success with Wilson's 95 % interval.

    ``predicted`` is the share of pairs that are solved in what the plans said would happen.
    """
    assert trial.success is not None
    solved = int(trial.success.sum())
    line: Row = {"method": method, "protocol": protocol, "seed": seed, "pairs": len(task)}
    line["success"] = round(solved / len(task), 4)
    interval = binomtest(solved, len(task)).proportion_ci(method="wilson")
    line |= {"low": round(float(interval.low), 4), "high": round(float(interval.high), 4)}
    if trial.plan is not None:
        said = torch.cat([trial.states[:, :1], trial.plan.states[0]], dim=1)
        line["predicted"] = round(float(task.judged(said)[1].float().mean()), 4)
    return line


class Table:
    """Rows in a file, which is written after every one.

    Args:
        path: of the CSV; rows that it holds already are kept.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[Row] = pd.read_csv(path).to_dict("records") if path.exists() else []

    def has(self, method: str, protocol: str, seed: int) -> bool:
        """Whether a row is there."""
        key = (method, protocol, seed)
        return any((row["method"], row["protocol"], row["seed"]) == key for row in self.rows)

    def add(self, row: Row) -> None:
        """Append a row."""
        self.rows.append(row)
        print(row, flush=True)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(self.rows).to_csv(self.path, index=False)


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--simulator", type=int, default=50, help="pairs planned in the simulator")
    parser.add_argument("--protocols", default="BCA")
    parser.add_argument("--share", type=float, default=1.0, help="of play and updates; a test: 0")
    parser.add_argument("--models", type=Path, default=Path("runs/pusht"))
    parser.add_argument("--out", type=Path, default=Path("data/results/11_pusht.csv"))
    given = parser.parse_args(words)
    table = Table(given.out)

    def add(method: str, protocol: str, seed: int, pairs: int, make: Executed) -> None:
        if pairs and not table.has(method, protocol, seed):
            task, began = load_pusht("test", protocol), time.process_time()
            task = task.take(min(pairs, len(task)))
            line = row(task, make(task), method, protocol, seed)
            table.add(line | {"seconds": round(time.process_time() - began, 1)})

    for seed in given.seeds:
        path = given.models / f"egocentric-{seed}.safetensors"
        if not path.exists():
            data = random_play(max(2, round(given.share * EPISODES)), seed=1000 * seed)
            held_out = random_play(HELD_OUT, seed=1000 * seed + 999, symmetries=False)
            path.parent.mkdir(parents=True, exist_ok=True)
            model = train(data, held_out, seed=seed, share=given.share)
            about = {"trained": f"{given.share:g} of {STAGES}, seed {seed}"}
            tsmlib.save_model(path, model, about)
        model = tsmlib.load_model(path, Egocentric)
        for word in given.protocols:
            play = weak_policy(torch.Generator().manual_seed(seed))
            add("random play", word, seed, given.pairs, partial(tsmlib.execute, plan=play))
            plans = partial(trial, model, protocol=word, seed=seed)
            add("egocentric", word, seed, given.pairs, plans)
            add("one plan", word, seed, given.pairs, partial(plans, once=True))
    for word in given.protocols.replace("A", ""):  # 300 steps would take it ten minutes a pair
        plans = partial(trial, None, protocol=word, seed=0)
        add("simulator", word, 0, given.simulator, plans)
        more = partial(plans, candidates=4 * SEARCH["candidates"], elites=4 * SEARCH["elites"])
        add("simulator, four times", word, 0, given.simulator // 8, more)


if __name__ == "__main__":
    main()
