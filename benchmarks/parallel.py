"""Trainings side by side, in processes of one thread each, against one after another with as many threads.

The same few updates of the paper's model on pushing, once for each of ``--trainings``: by ``study.precompute``, with
the start of its processes, and in this process with as many threads as the other way has processes.

    python benchmarks/parallel.py        or        python -m tsmlib bench parallel
"""

from __future__ import annotations

import torch
from _rounds import Row, interleaved, parsed, parser, save
from train import training

from tsmlib import study
from tsmlib.study import runs
from tsmlib.study.parallel import cores
from tsmlib.study.runs import Run

ENV = "tsm/ReacherPush-v1"


def little(run: Run, seed: int, updates: int) -> None:
    """``updates`` of the free-running stage."""
    data, held_out = (study.random_data(ENV, n, seed=seed) for n in (100, 1))
    stage = study.schedule(run, ENV, "tsm")[-1]
    net = study.initialise(run, "tsm", data)
    training(net, stage, (data, held_out), updates=updates)()


def main() -> None:
    options = parser(__doc__, rounds=5)
    options.add_argument("--trainings", type=int, default=4)
    options.add_argument("--updates", type=int, default=40, help="of each (default 40)")
    arguments = parsed(options)
    run, at_once = runs.resolve("bench", scale="paper"), min(cores(), arguments.trainings)
    calls = [(little, seed, arguments.updates) for seed in range(arguments.trainings)]

    def in_turn() -> None:
        torch.set_num_threads(at_once)
        for make, *given in calls:
            make(run, *given)
        torch.set_num_threads(arguments.threads)

    def side_by_side() -> None:
        study.precompute(run, calls)

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
