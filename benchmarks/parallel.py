"""Trainings side by side, in processes of one thread each, against one after another with as many threads.

The same few updates of the paper's model on pushing, once for each of ``--trainings``: by ``study.precompute``, with
the start of its processes, and in this process with as many threads as the other way has processes.

    python benchmarks/parallel.py        or        python -m tsmlib bench parallel
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from _rounds import Row, interleaved, parsed, parser, save
from train import training

from tsmlib import study
from tsmlib.storage.files import Json
from tsmlib.study import runs
from tsmlib.study.jobs import Job
from tsmlib.study.parallel import cores
from tsmlib.study.runs import Run

ENV = "tsm/ReacherPush-v1"


@dataclass(frozen=True)
class Little:
    """``updates`` of the free-running stage, which nobody keeps."""

    seed: int
    updates: int
    kind = "model"

    @property
    def name(self) -> str:
        return f"{self.seed}"

    def needs(self, run: Run) -> list[Job]:
        return []

    def settings(self, run: Run) -> Json:
        return self.updates

    def seconds(self, run: Run) -> float:
        return self.updates / 10

    def make(self, run: Run) -> None:
        data, held_out = (study.random_data(ENV, n, seed=self.seed) for n in (100, 1))
        stage = study.schedule(run, ENV, "tsm")[-1]
        net = study.initialise(run, "tsm", data)
        training(net, stage, (data, held_out), updates=self.updates)()


def main() -> None:
    options = parser(__doc__, rounds=5)
    options.add_argument("--trainings", type=int, default=4)
    options.add_argument("--updates", type=int, default=40, help="of each (default 40)")
    arguments = parsed(options)
    run, at_once = runs.resolve("bench", scale="paper"), min(cores(), arguments.trainings)
    jobs = [Little(seed, arguments.updates) for seed in range(arguments.trainings)]

    def in_turn() -> None:
        torch.set_num_threads(at_once)
        for job in jobs:
            job.make(run)
        torch.set_num_threads(arguments.threads)

    def side_by_side() -> None:
        study.precompute(run, jobs)

    seconds = interleaved({"ahead": side_by_side, "in turn": in_turn}, arguments.rounds, warm=False)
    n = arguments.trainings
    row = Row.of(
        f"{n} trainings side by side in {at_once} processes: trainings", n / seconds["ahead"],
        f"in turn, {at_once} threads", n / seconds["in turn"], threads=1, env=ENV, sim="mujoco", model="tsm",
        configuration="processes", metric="trainings_per_second",
    )  # fmt: skip
    print(f"{ENV}, {arguments.updates} updates each, {arguments.rounds} rounds")
    save("parallel", [row])


if __name__ == "__main__":
    main()
