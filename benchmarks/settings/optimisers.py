"""Adam or Muon, and weight decay, for each dynamics model of pushing: short trainings, judged by validation loss.

A few thousand updates of one stage of the model's training, on the training data with their symmetric copies, each with
a whole cosine schedule of its own; everything else as in ``zoo``. Losses of different models do not compare.

    python benchmarks/settings/optimisers.py --models lstm --ways adam "muon 0.006" --updates 2000

A line that the table has already is not measured again.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.symmetry import symmetric
from tsmlib.study import models, runs, zoo
from tsmlib.study.data import dataset
from tsmlib.training.fit import fit

HERE, ENV = Path(__file__).resolve().parent, "tsm/ReacherPush-v1"
KEY = ("model", "stage", "way", "symmetries", "updates", "seed")
COLUMNS = (*KEY, "cpu_seconds", "training", "validation", "best_at")


@dataclass(frozen=True)
class Way:
    """An optimiser. lr: Adam's; 0: the model's own."""

    lr: float = 0.0
    muon: float = 0.0
    weight_decay: float = 0.0


WAYS = {
    "adam": Way(), "adam, decay 0.01": Way(weight_decay=0.01), "adam, decay 0.1": Way(weight_decay=0.1),
    "muon 0.006": Way(lr=2e-3, muon=0.006), "muon 0.02": Way(lr=2e-3, muon=0.02), "muon 0.05": Way(lr=2e-3, muon=0.05),
}  # fmt: skip


def measured(run: runs.Run, word: str, at: int, way: str, updates: int, *, symmetries: bool) -> dict[str, str]:
    """One training, by the stage ``at`` of the model's."""
    data, held_out = dataset(run, ENV, "train"), dataset(run, ENV, "validation")
    data, chosen = symmetric(data) if symmetries else data, WAYS[way]
    net, stage = models.initialise(run, word, data), zoo.find(word).schedule(EnvSpec.parse(ENV))[at]
    assert isinstance(net, nn.Module)
    began = time.process_time()
    curve = fit(
        net, getattr(net, stage.loss), data, held_out,
        stage.options(
            net.past_len, steps=updates, lr=chosen.lr or stage.lr, muon=chosen.muon, weight_decay=chosen.weight_decay,
            patience=0, span=(0.0, 1.0), bf16=False,
        ),
        seed=run.seed, progress=f"{word}, {way}",
    )  # fmt: skip
    best = min(range(len(curve.step)), key=lambda i: curve.validation[i])
    return {
        "model": word, "stage": str(at), "way": way, "symmetries": str(len(data) // len(dataset(run, ENV, "train"))),
        "updates": str(updates), "seed": str(run.seed), "cpu_seconds": f"{time.process_time() - began:.0f}",
        "training": f"{curve.train[best]:.4g}", "validation": f"{curve.validation[best]:.4g}",
        "best_at": str(curve.step[best]),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["lstm", "onestep"], help="words of the zoo")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), metavar="WAY", help="default all")
    parser.add_argument("--stage", type=int, default=0, help="of the model's training (default 0, the first)")
    parser.add_argument("--updates", type=int, default=2000)
    parser.add_argument("--plain", action="store_true", help="without the symmetric copies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=HERE / "optimisers.csv")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    run = runs.resolve("02_train", scale="paper", seed=arguments.seed)
    for word in arguments.models:
        for way in arguments.ways:
            known = list(csv.DictReader(arguments.out.open(newline=""))) if arguments.out.exists() else []
            numbers = arguments.updates, arguments.seed
            key = (word, str(arguments.stage), way, "1" if arguments.plain else "8", *map(str, numbers))
            if key in [tuple(row[name] for name in KEY) for row in known]:
                continue
            row = measured(run, word, arguments.stage, way, arguments.updates, symmetries=not arguments.plain)
            print(row, flush=True)
            with arguments.out.open("a", newline="") as file:  # other processes may write beside this one
                writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                if not file.tell():
                    writer.writeheader()
                writer.writerow(row)


if __name__ == "__main__":
    main()
