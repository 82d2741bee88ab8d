"""PushT's shipped model on other fields, as it is and fine-tuned: 11_pusht_fields.csv.

    python benchmarks/pusht_fields.py

20 episodes of 100 steps of random play on each field, of which 4 say when to stop; 50 pairs, 25
steps apart in other play. ``--try`` takes the pairs on which the schedule was chosen. Rows that are
there already are not made again. States, not pixels; random play, no demonstrations.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from pusht_rounds import pairs

import tsmlib
from reproduction import pusht
from tsmlib.envs.pusht_field import pusht_variant
from tsmlib.planning.pusht import random_play
from tsmlib.training.options import TrainingOptions

TABLE = Path(__file__).resolve().parents[1] / "data" / "results" / "11_pusht_fields.csv"
FIELDS: dict[str, dict[str, float | str]] = {
    "L": {"shape": "L"},
    "standard": {},
    "radius 25": {"radius": 25.0},
    "scale 40": {"scale": 40.0},
    "scale 22": {"scale": 22.0},
    "small T": {"shape": "small_T"},
}
EPISODES, STOPPING, PAIRS = 20, 4, 50


def tuned(model: tsmlib.DynamicsModel, env: str, updates: int, lr: float) -> None:
    """Fine-tune a model on a few episodes of a field."""
    few = random_play(EPISODES - STOPPING, seed=2_000_000, env=env)
    stopping = random_play(STOPPING, seed=2_000_001, env=env)
    options = TrainingOptions(
        future_len=10,
        steps=updates,
        batch_size=192,
        lr=lr,
        muon=5 * lr,
        validate_every=max(10, updates // 10),
    )
    tsmlib.fine_tune(model, few, stopping, options, progress=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fields", nargs="+", default=list(FIELDS))
    parser.add_argument("--updates", type=int, nargs="+", default=[0, 1600])
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--try", action="store_true", dest="tried")
    parser.add_argument("--out", type=Path, default=TABLE)
    given = parser.parse_args()
    torch.set_num_threads(1)
    table = pusht.Table(given.out)
    for field in given.fields:
        env = pusht_variant(**FIELDS[field])
        for updates in given.updates:
            method = f"{field}, {updates} updates" + (f" at {given.lr:g}" if given.tried else "")
            if table.has(method, "C", 0):
                continue
            model, began = tsmlib.load_pretrained("egocentric", env="tsm/PushT-v0"), _now()
            if updates:
                tuned(model, env, updates, given.lr)
            seconds = round(_now() - began, 1)
            for protocol in "BC":
                task = pairs(given.pairs, 700 if given.tried else 800, protocol, env)
                trial = pusht.trial(model, task, protocol, seed=0)
                line = pusht.row(task, trial, method, protocol, 0)
                table.add(line | {"trained": seconds})


def _now() -> float:
    return time.process_time()


if __name__ == "__main__":
    main()
