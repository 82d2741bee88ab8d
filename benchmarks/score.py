"""Scoring predictions with ``evaluation.prediction.score``, against bare rollouts of as many steps.

Test and validation samples are drawn, scores fitted and taken; the reference draws the same number of samples in blocks
of the same size and does nothing with them. The limit is reading every sample once from memory and writing it once.

    python benchmarks/score.py        or        python -m tsmlib bench score
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from _rounds import Row, bandwidth, interleaved, parsed, parser, peak_bytes, save

from reproduction import runs
from tsmlib import study
from tsmlib.evaluation import prediction
from tsmlib.models.base import rollout
from tsmlib.trajectory import Segment, Trajectories

ENV, BYTES = "tsm/ReacherPush-v1", 2**28


def main() -> None:
    options = parser(__doc__, rounds=3)
    options.add_argument("--models", default="tsm,onestep")
    options.add_argument("--episodes", type=int, default=20, help="of each split (default 20)")
    options.add_argument("--samples", type=int, default=32)
    options.add_argument(
        "--many", type=int, default=500, help="samples of two episodes (default 500)"
    )
    options.add_argument("--horizon", type=int, default=90)
    arguments = parsed(options)
    horizon = arguments.horizon
    run = runs.resolve("bench", scale="laptop")
    splits = [study.random_data(ENV, arguments.episodes, seed=seed) for seed in (0, 1)]
    pairs = [data.take(slice(2)) for data in splits]
    ways: dict[str, Callable[[], object]] = {"memory": bandwidth(BYTES)}
    for model in arguments.models.split(","):
        net = study.initialise(run, model, splits[0])
        for samples, data in ((arguments.samples, splits), (arguments.many, pairs)):
            options_of = dict(samples=samples, horizon=horizon)
            ways[f"{model} {samples}"] = partial(
                prediction.score, net, net.features, *data, **options_of
            )
            ways[f"{model} {samples} bare"] = partial(imagine, net, data, **options_of)
    peaks = {way: peak_bytes(call) for way, call in ways.items()}
    seconds = interleaved(ways, arguments.rounds, warm=False)
    rows = []
    for model in arguments.models.split(","):
        for samples, data in ((arguments.samples, splits), (arguments.many, pairs)):
            n_values = (
                samples * sum(len(split) for split in data) * horizon * data[0].states.shape[2]
            )
            way = f"{model} {samples}"
            rows.append(
                Row.of(
                    f"score {model}, {samples} samples of {len(data[0])} + {len(data[1])} episodes: seconds",
                    seconds[way],
                    "bare rollouts of its samples",
                    seconds[f"{way} bare"],
                    unit="s",
                    limit="memory bandwidth",
                    bound=seconds["memory"] * 4 * n_values / BYTES,
                    peak=peaks[way],
                    env=ENV,
                    sim="mujoco",
                    model=model,
                    configuration=f"{samples} samples",
                    metric="seconds",
                    horizon=horizon,
                )
            )
    print(f"{ENV}, {horizon} steps, {arguments.rounds} rounds, {arguments.threads} threads")
    save("score", rows)


@torch.no_grad()
def imagine(
    net: Any, data: list[Trajectories], *, samples: int, horizon: int, observed: int = 10
) -> None:
    """Roll out what ``evaluate.score`` does: one sample where the model is deterministic."""
    samples = samples if net.stochastic else 1
    generator = torch.Generator().manual_seed(0)
    for split in data:
        states, actions = torch.from_numpy(split.states), torch.from_numpy(split.actions)
        past = Segment(
            states[:, observed - net.past_len + 1 : observed + 1],
            actions[:, observed - net.past_len : observed],
        )
        future = actions[:, observed : observed + horizon]
        for block in torch.arange(len(states)).repeat(samples).split(prediction.ROWS):
            rollout(
                net, Segment(*(part[block] for part in past)), future[block], generator=generator
            )


if __name__ == "__main__":
    main()
