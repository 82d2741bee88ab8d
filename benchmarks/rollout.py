"""Rollouts without a gradient, model by model, against MuJoCo on the same core.

A model imagines ``--horizon`` steps from so many rows at once, in float32 and with matrix products in bfloat16; the
simulator is raw ``mujoco.rollout`` on one thread, which executes a few episodes of the same torques. The limit is the
time that the model's matrix products take alone, in float32.

    python benchmarks/rollout.py        or        python -m tsmlib bench rollout
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from _rounds import SGEMM, Products, Row, interleaved, parsed, parser, peak_bytes, save
from _simulator import ENV, raw

from tsmlib import study, zoo
from tsmlib.models.base import rollout
from tsmlib.trajectory import initial_past


def main() -> None:
    options = parser(__doc__, rounds=4)
    options.add_argument("--models", default=f"{zoo.PAPERS},{zoo.OURS},lstm,onestep")
    options.add_argument("--rows", default="100,400,1600", help="imagined at once")
    options.add_argument("--horizon", type=int, default=50)
    options.add_argument(
        "--episodes", type=int, default=100, help="that the simulator executes in each round"
    )
    arguments = parsed(options)
    sizes = [int(word) for word in arguments.rows.split(",")]
    data = study.random_data(ENV, max(sizes), seed=0, horizon=arguments.horizon)
    run = runs.resolve("bench", scale="laptop")
    few = min(arguments.episodes, max(sizes))
    simulator = raw(data.states[:few, 0], data.actions[:few], threads=1)
    rows = []
    for model in arguments.models.split(","):
        net = study.initialise(run, model, data)
        ways: dict[str, Callable[[], object]] = {"simulator": simulator}
        for size in sizes:
            ways |= {
                f"{word} {size}": imagine(net, data, size, word == "bfloat16")
                for word in ("float32", "bfloat16")
            }
            ways[f"sgemm {size}"] = Products.of(ways[f"float32 {size}"]).alone()
        peaks = {way: peak_bytes(call) for way, call in ways.items()}
        seconds = interleaved(ways, arguments.rounds, warm=False, progress=model)
        simulated = few * arguments.horizon / seconds["simulator"]
        for size in sizes:
            steps = size * arguments.horizon
            for word in ("float32", "bfloat16"):
                rows.append(
                    Row.of(
                        f"imagine with {model}, {word}, {size} rows: steps",
                        steps / seconds[f"{word} {size}"],
                        "mujoco.rollout, one thread",
                        simulated,
                        limit=SGEMM,
                        bound=steps / seconds[f"sgemm {size}"],
                        peak=peaks[f"{word} {size}"],
                        env=ENV,
                        sim="mujoco",
                        model=model,
                        configuration=word,
                        metric="steps_per_second",
                        horizon=arguments.horizon,
                    )
                )
    print(
        f"{ENV}, {arguments.horizon} steps, {arguments.rounds} rounds, {arguments.threads} threads"
    )
    save("rollout", rows)


def imagine(net: Any, data: Any, n: int, bf16: bool) -> Callable[[], object]:
    """A way that samples ``n`` rows from ``net`` under the data's torques."""
    past = initial_past(torch.from_numpy(data.states[:n, 0]), net.past_len, data.actions.shape[2])
    actions = torch.from_numpy(data.actions[:n])

    @torch.no_grad()
    def call() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            rollout(net, past, actions, generator=torch.Generator().manual_seed(0))

    return call


if __name__ == "__main__":
    main()
