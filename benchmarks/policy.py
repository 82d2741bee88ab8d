"""Learning a policy inside the model: one at the paper's schedule, and ten copies against one.

A few updates are timed, in turn for one copy, for many, and for predicting as many steps without a gradient; the time
of the paper's 2,200 is extrapolated from them: every update does the same work.

    python benchmarks/policy.py        or        python -m tsmlib bench policy
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from _rounds import SGEMM, Products, Row, interleaved, parsed, parser, peak_bytes, save
from plan import models

from reproduction import runs
from tsmlib import study
from tsmlib.models.base import rollout
from tsmlib.policies.learning import LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy
from tsmlib.trajectory import initial_past

SCHEDULE = 2200  # updates until the rate has decayed to its end, A25
EPISODES = 20  # of each update and copy, ``learn_policy``'s default


def main() -> None:
    options = parser(__doc__, rounds=9)
    options.add_argument("--env", default="tsm/Reacher-v0")
    options.add_argument(
        "--horizon", type=int, default=50, help="steps (default 50, as in the paper)"
    )
    options.add_argument("--copies", type=int, default=10)
    options.add_argument("--iterations", type=int, default=3, help="updates per round (default 3)")
    arguments = parsed(options)
    n, copies, horizon = arguments.iterations, arguments.copies, arguments.horizon
    model, prior, origin = models(runs.resolve("bench", scale="laptop"), arguments.env)
    task = study.load_task(arguments.env, "validation")
    draw, reward = episodes_from(torch.from_numpy(task.start)), task.reward_for
    state_dim = task.start.shape[1]
    starts = torch.from_numpy(task.start[:EPISODES])
    torques = 0.1 * torch.randn(len(starts), horizon, 2, generator=torch.Generator().manual_seed(0))

    def learn(space: str, copies: int, n: int = n) -> float:
        """Seconds of the updates alone, without the records before and after them."""
        learner: Any = (
            SegmentPolicy(state_dim, prior, angles=model.features.angles, copies=copies)
            if space == "latent"
            else OneStepPolicy(state_dim, 2, angles=model.features.angles, copies=copies)
        )
        options = LearningOptions(iterations=n, record_every=n, horizon=horizon)
        return learn_policy(learner, model, reward, draw, options).seconds[-1]

    @torch.no_grad()
    def imagine() -> None:
        for i in range(n):
            past = initial_past(starts, model.past_len, 2)
            rollout(model, past, torques, generator=torch.Generator().manual_seed(i))

    ways: dict[str, Callable[[], object]] = {"imagine": imagine}
    ways |= {
        f"{space} {m}": partial(learn, space, m)
        for space in ("latent", "direct")
        for m in (1, copies)
    }
    products = {  # of the updates alone
        f"sgemm {way}": (Products.of(partial(call, n=2 * n)) - Products.of(call)).alone()
        for way, call in ways.items()
        if way != "imagine"
    }
    peaks = {way: peak_bytes(call) for way, call in ways.items()}
    seconds = interleaved(ways | products, arguments.rounds, warm=False)

    print(
        f"{arguments.env}, {origin} models, {horizon} steps, {EPISODES} episodes and {arguments.threads} threads, "
        f"{n} updates in each of {arguments.rounds} rounds"
    )
    rows = []
    common = dict(
        env=arguments.env,
        sim="mujoco",
        task=task.name,
        model="tsm",
        planner="policy",
        horizon=horizon,
    )
    for space in ("latent", "direct"):
        one, many = (f"{space} {m}" for m in (1, copies))
        whole = SCHEDULE * np.median(seconds[one]) / n
        print(f"one policy, {space}, extrapolated to {SCHEDULE} updates: {whole / 60:.1f} min")
        for what, way, reference, other in (
            (
                f"one policy, {space}, an update: seconds",
                one,
                "predicting its steps, no gradient",
                "imagine",
            ),
            (f"{copies} policies, {space}, an update: seconds", many, "one policy", one),
        ):
            rows.append(
                Row.of(
                    what,
                    seconds[way] / n,
                    reference,
                    seconds[other] / n,
                    unit="s",
                    limit=SGEMM,
                    bound=seconds[f"sgemm {way}"] / n,
                    peak=peaks[way],
                    search_space=space,
                    configuration="copies" if way == many else "one",
                    metric="seconds",
                    **common,
                )
            )
    save("policy", rows)


if __name__ == "__main__":
    main()
