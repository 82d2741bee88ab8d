"""What trust costs: checkpoints within a training, and the checks when a shipped model is loaded.

A checkpoint is held against the 250 updates between two of them, in one training; a load with all its checks against
reading the bytes and copying them into a model that exists. In processor seconds, which other work disturbs less; a
checkpoint's flush to the disk comes on top.

    python benchmarks/trust.py        or        python -m tsmlib bench trust
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import safetensors.torch
import torch
from tqdm.auto import tqdm

from tsmlib import runs, store, study
from tsmlib.checkpoint import Progress
from tsmlib.train import fit
from tsmlib.trajectory import Trajectories, Window
from tsmlib.tsm import TSM

ENV = "tsm/ReacherPush-v0"
EVERY = 250  # updates to a checkpoint, at scales laptop and paper
SPREAD = {"median": np.median, "lowest": np.min, "highest": np.max}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20, help="of a training (default 20, with two checkpoints)")
    parser.add_argument("--loads", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()

    data, held_out = (study.random_data(ENV, n, seed=seed) for n, seed in ((200, 0), (2, 1)))
    run = runs.resolve("bench", scale="laptop")
    shipped = run.shipped / study.short(ENV) / "tsm.safetensors"
    expect = study.fingerprint(ENV)
    existing = store.load_model(shipped, TSM, expect=expect)
    seconds: dict[str, list[float]] = {"update": [], "save": [], "load": [], "read": []}
    ratio = np.array([round_of(arguments, run, data, held_out, seconds) for _ in tqdm(range(arguments.rounds))])
    for _ in range(arguments.loads):
        with timed(seconds["load"]):
            store.load_model(shipped, TSM, expect=expect)
        with timed(seconds["read"]):
            existing.load_state_dict(safetensors.torch.load(shipped.read_bytes()))
    update, save, load, read = (1000 * np.median(seconds[what]) for what in seconds)
    print(f"{ENV}, {arguments.steps} steps, {arguments.rounds} rounds, {torch.get_num_threads()} threads")
    print(f"an update takes {update:.1f} ms, a checkpoint {save:.1f} ms; with one every {EVERY} updates training takes")
    print(f"{np.median(ratio):.4f} times as long ({ratio.min():.4f} to {ratio.max():.4f}); at most 1.05")
    print(f"loading a shipped model takes {load:.1f} ms, {load - read:.1f} ms more than its bytes; at most 50 ms more")
    common = dict(env=ENV, sim="mujoco", model="tsm", n=arguments.rounds)
    rows = [
        dict(common, condition="checkpoints", metric=f"ratio_{word}", value=of(ratio)) for word, of in SPREAD.items()
    ]
    rows.append(dict(common, condition="load", metric="seconds", value=load / 1000, unit="s"))
    rows.append(dict(common, condition="checks", metric="seconds", value=(load - read) / 1000, unit="s"))
    path = run.dir.parents[1] / "bench" / "trust.csv"
    store.save_table(path, rows)
    print(path)


def round_of(
    arguments: argparse.Namespace, run: runs.Run, data: Trajectories, held_out: Trajectories,
    seconds: dict[str, list[float]],
) -> float:  # fmt: skip
    """One training with checkpoints: how many times as long it would take as one without."""
    net, asked, saves = study.fresh(run, "tsm", data), [], []

    def loss(window: Window, generator: torch.Generator) -> torch.Tensor:
        if torch.is_grad_enabled():
            asked.append(time.process_time())
        return net.loss(window, generator)

    def save(state: Progress, folder: Path, identity: dict[str, Any]) -> None:
        with timed(saves):
            Progress.save(state, folder, identity)

    every = max(1, arguments.steps // 2)
    with (
        tempfile.TemporaryDirectory() as name,
        mock.patch("tsmlib.train.Progress", type("Timed", (Progress,), {"save": save})),
    ):
        fit(net, loss, data, held_out, past_len=10, future_len=20, steps=arguments.steps, validate_every=every,
            checkpoint=Path(name) / "run", bf16=True)  # fmt: skip
    updates = [after - before for i, (before, after) in enumerate(pairwise(asked), start=1) if i % every]
    updates = updates or list(np.diff(asked))
    seconds["update"] += updates
    seconds["save"] += saves
    return float(1 + np.median(saves) / (EVERY * np.median(updates)))


@contextlib.contextmanager
def timed(into: list[float]) -> Iterator[None]:
    """Add the processor seconds that the block took."""
    began = time.process_time()
    yield
    into.append(time.process_time() - began)


if __name__ == "__main__":
    main()
