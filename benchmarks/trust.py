"""Cost of reliability: checkpoints within a training, and the checks when a shipped model is loaded.

A checkpoint is held against the 250 updates between two of them, in one training; a load with all its checks against
reading the bytes and copying them into a model that exists. In CPU seconds, which other work disturbs less; a
checkpoint's flush to the disk comes on top.

    python benchmarks/trust.py        or        python -m tsmlib bench trust
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import safetensors.torch
import torch
from _rounds import Row, parsed, parser, peak_bytes, save
from tqdm.auto import tqdm

from tsmlib import study
from tsmlib.envs import fingerprint
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.tsm import TSM
from tsmlib.storage import artifacts
from tsmlib.study import runs
from tsmlib.training.checkpoint import TrainingState
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Trajectories, Window

ENV = "tsm/ReacherPush-v1"
EVERY = 250  # updates to a checkpoint, at scales laptop and paper


def main() -> None:
    options = parser(__doc__, rounds=5)
    options.add_argument("--steps", type=int, default=20, help="of a training (default 20, with two checkpoints)")
    options.add_argument("--loads", type=int, default=20)
    arguments = parsed(options)

    data, held_out = (study.random_data(ENV, n, seed=seed) for n, seed in ((200, 0), (2, 1)))
    run = runs.resolve("bench", scale="laptop")
    shipped = run.shipped / EnvSpec.parse(ENV).name / "tsm.safetensors"
    expect = fingerprint(ENV)
    existing = artifacts.load_model(shipped, TSM, expect=expect)
    seconds: dict[str, list[float]] = {"update": [], "save": [], "load": [], "read": []}
    ratio = np.array([round_of(arguments, run, data, held_out, seconds) for _ in tqdm(range(arguments.rounds))])
    load_checked = partial(artifacts.load_model, shipped, TSM, expect=expect)
    peak = peak_bytes(load_checked)
    for _ in range(arguments.loads):
        with timed(seconds["load"]):
            load_checked()
        with timed(seconds["read"]):
            existing.load_state_dict(safetensors.torch.load(shipped.read_bytes()))
    update, save_ms, load, read = (1000 * np.median(seconds[what]) for what in seconds)
    print(f"{ENV}, {arguments.steps} steps, {arguments.rounds} rounds, {torch.get_num_threads()} threads")
    print(f"an update takes {update:.1f} ms, a checkpoint {save_ms:.1f} ms; with one every {EVERY} updates training")
    print(f"takes {np.median(ratio):.4f} times as long ({ratio.min():.4f} to {ratio.max():.4f}); at most 1.05")
    print(f"loading a shipped model takes {load:.1f} ms, {load - read:.1f} ms more than its bytes; at most 50 ms more")
    common: dict[str, Any] = dict(env=ENV, sim="mujoco", model="tsm", metric="seconds", unit="s")
    between = EVERY * update / 1000
    rows = [
        Row.of(
            "write a checkpoint: CPU seconds", between * (ratio - 1), f"the {EVERY} updates before it", between,
            configuration="checkpoints", **common,
        ),
        Row.of(
            "load a shipped model, checked: CPU seconds", np.array(seconds["load"]), "reading its bytes",
            np.maximum(seconds["read"], 1e-6), peak=peak, configuration="load", **common,
        ),
    ]  # fmt: skip
    save("trust", rows)


def round_of(
    arguments: argparse.Namespace, run: runs.Run, data: Trajectories, held_out: Trajectories,
    seconds: dict[str, list[float]],
) -> float:  # fmt: skip
    """One training with checkpoints: how many times as long it would take as one without."""
    net, asked, saves = study.initialise(run, "tsm", data), [], []

    def loss(window: Window, generator: torch.Generator) -> torch.Tensor:
        if torch.is_grad_enabled():
            asked.append(time.process_time())
        return net.loss(window, generator)

    whole = TrainingState.save

    def save(state: TrainingState[Any]) -> None:
        with timed(saves):
            whole(state)

    every = max(1, arguments.steps // 2)
    with (
        tempfile.TemporaryDirectory() as name,
        mock.patch.object(TrainingState, "save", save),
    ):
        options = TrainingOptions(10, 20, arguments.steps, validate_every=every, bf16=True)
        fit(net, loss, data, held_out, options, checkpoint=Path(name) / "run")
    updates = [after - before for i, (before, after) in enumerate(pairwise(asked), start=1) if i % every]
    updates = updates or list(np.diff(asked))
    seconds["update"] += updates
    seconds["save"] += saves
    return float(1 + np.median(saves) / (EVERY * np.median(updates)))


@contextlib.contextmanager
def timed(into: list[float]) -> Iterator[None]:
    """Add the CPU seconds that the block took."""
    began = time.process_time()
    yield
    into.append(time.process_time() - began)


if __name__ == "__main__":
    main()
