"""The table of PushT, from random play to the frozen pairs: ``python -m reproduction.pusht``.

States, not pixels; random play, no demonstrations. One row for each protocol, method and seed; rows
that are there already are not made again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import pandas as pd
import torch

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
    protocol: str,
    pairs: int,
    *,
    seed: int,
    split: Literal["validation", "test"] = "test",
    space: SearchSpace | None = None,
    every: int = EVERY,
    **search: int,
) -> tsmlib.Trial:
    """Planning again every few steps on the first frozen pairs; None plans in the simulator."""
    task = load_pusht(split, protocol)
    task = task.take(min(pairs, len(task)))
    ahead, smoothness = AHEAD[protocol]
    space = space or tsmlib.DirectActions(ahead, rms=RMS, smoothness=smoothness)
    planner = partial(tsmlib.cem, **(SEARCH | search), seed=seed)
    return tsmlib.mpc(
        task, model, space, planner, every=every, lookahead=ahead, until_success=True, seed=seed
    )


def row(
    trial: tsmlib.Trial, seconds: float, method: str, protocol: str, seed: int
) -> dict[str, object]:
    """One line of the table."""
    success = trial.success
    assert success is not None
    n, share = len(success), float(success.float().mean())
    half = 1.96 * (share * (1 - share) / n) ** 0.5
    return {
        "method": method,
        "protocol": protocol,
        "seed": seed,
        "pairs": n,
        "success": round(share, 4),
        "low": round(max(0.0, share - half), 4),
        "high": round(min(1.0, share + half), 4),
        "seconds": round(seconds, 1),
    }


class Table:
    """Rows in a file, which is written after every one.

    Args:
        path: of the CSV; rows that it holds already are kept.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, object]] = []
        if path.exists():
            self.rows = [dict(line) for _, line in pd.read_csv(path).iterrows()]

    def has(self, method: str, protocol: str, seed: int) -> bool:
        """Whether a row is there."""
        key = (method, protocol, seed)
        return any((row["method"], row["protocol"], row["seed"]) == key for row in self.rows)

    def add(self, row: dict[str, object]) -> None:
        """Append a row."""
        self.rows.append(row)
        print(row, flush=True)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(self.rows).to_csv(self.path, index=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--simulator", type=int, default=100, help="pairs planned in the simulator")
    parser.add_argument("--protocols", default="BCA")
    parser.add_argument("--models", type=Path, default=Path("runs/pusht"))
    parser.add_argument("--out", type=Path, default=Path("data/results/11_pusht.csv"))
    given = parser.parse_args()
    table = Table(given.out)

    def add(method: str, protocol: str, seed: int, make: Callable[[], tsmlib.Trial]) -> None:
        if not table.has(method, protocol, seed):
            began = time.process_time()
            result = make()
            table.add(row(result, time.process_time() - began, method, protocol, seed))

    for seed in given.seeds:
        path = given.models / f"egocentric-{seed}.safetensors"
        if not path.exists():
            data = random_play(EPISODES, seed=1000 * seed)
            held_out = random_play(HELD_OUT, seed=1000 * seed + 999, symmetries=False)
            model = train(data, held_out, seed=seed)
            path.parent.mkdir(parents=True, exist_ok=True)
            tsmlib.save_model(path, model)
        model = tsmlib.load_model(path, Egocentric)
        for protocol in given.protocols:
            task = load_pusht("test", protocol)
            task = task.take(min(given.pairs, len(task)))
            play = weak_policy(torch.Generator().manual_seed(seed))
            add("random play", protocol, seed, partial(tsmlib.execute, task, play))
            plans = partial(trial, model, protocol, given.pairs, seed=seed)
            add("egocentric", protocol, seed, plans)
    for protocol in given.protocols if given.simulator else "":
        plans = partial(trial, None, protocol, given.simulator, seed=0)
        add("simulator", protocol, 0, plans)


if __name__ == "__main__":
    main()
