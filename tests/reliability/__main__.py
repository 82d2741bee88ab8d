"""The reliability checks at full length: ``make reliability``, or ``PARTS="files training"``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.setdefault("TQDM_DISABLE", "1")

import torch

from reliability import files, simulators, training
from reliability.world import Outcome

Check = Callable[[int], Outcome]
LONG_ONLY = -1
CHECKS: dict[str, dict[Check, tuple[int, int]]] = {  # trials in the tests, and at full length
    "training": {
        training.killed_at_random_moments: (20, 300),
        training.at_every_call: (3, 1),
        training.newest_generation_spoilt: (60, 200),
        training.values_that_are_not_finite: (60, 200),
        training.losses_that_are_not_finite: (8, 20),
        training.full_disk: (0, 0),
        training.two_writers: (5, 50),
        training.interrupted_in_a_cell: (3, 50),
        training.memory: (2000, 20000),
    },
    "files": {
        files.damage: (300, 2000),
        files.malice: (0, 0),
        files.hostile_minari: (0, 500),
        files.mismatched: (0, 0),
        files.sizes: (LONG_ONLY, 0),
    },
    "simulators": {
        simulators.faults_in_mujoco: (100, 100),
        simulators.large_sets: (20, 5000),
        simulators.faults_in_pymunk: (50, 50),
        simulators.restores: (36, 36),
    },
}


def main() -> int:
    """Run the parts that are named, or all; 1 where a trial went wrong."""
    torch.set_num_threads(1)  # as in the children that a check forks
    failed = 0
    for part in sys.argv[1:] or list(CHECKS):
        for check, (_, many) in CHECKS[part].items():
            outcome = check(many)
            failed += outcome.right < outcome.of
            print(f"{check.__name__:28} {outcome.right} of {outcome.of}   {outcome.note}")
            print(*outcome.wrong[:10], sep="\n        ", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
