"""Gain of ``torch.compile`` on the free-running loss, and the updates that its cold start costs.

A segment of the decoder is compiled whole, ten steps unrolled, without a cache from earlier runs. Needs a C++ compiler.

    python benchmarks/settings/compiled.py
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tsmlib import study
from tsmlib.study import runs, zoo
from tsmlib.training.fit import fixed_windows

ENV = "tsm/ReacherPush-v1"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tsm = zoo.words("dynamics", cls=("TSM",))
    parser.add_argument("--model", choices=tsm, default="tsm")
    parser.add_argument("--rounds", type=int, default=10)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    run = runs.resolve("bench", scale="paper")
    stage = study.schedule(run, ENV, arguments.model)[-1]
    data = study.random_data(ENV, 100, seed=0)
    window = fixed_windows(data, 10, stage.future_len, stage.batch)
    nets = [study.initialise(run, arguments.model, data) for _ in range(2)]
    with tempfile.TemporaryDirectory() as cold:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cold
        nets[1].decode = torch.compile(nets[1].decode, dynamic=False)
        updates = [update(net, stage.loss, window) for net in nets]
        first = [update() for update in updates][1]
        seconds = np.array([[update() for update in updates] for _ in range(arguments.rounds)])
    plain, compiled = seconds.T
    gain, saved = plain / compiled, np.median(plain - compiled)
    print(f"{arguments.model}, {stage.loss}, batch {stage.batch}, {arguments.rounds} rounds")
    print(f"compiled is {np.median(gain):.2f}x as fast ({gain.min():.2f} to {gain.max():.2f})")
    print(
        f"its first update takes {first:.0f} s, as much as {first / saved:,.0f} updates save; there are {stage.steps:,}"
    )


def update(net: Any, loss: str, window: Any) -> Callable[[], float]:
    """Loss and gradient on ``window``, always with the same noise; seconds."""

    def call() -> float:
        began = time.perf_counter()
        net.zero_grad(set_to_none=True)
        getattr(net, loss)(window, torch.Generator().manual_seed(0)).backward()
        return time.perf_counter() - began

    return call


if __name__ == "__main__":
    main()
