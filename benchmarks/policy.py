"""Learning a policy inside the model: one at the paper's schedule, and ten copies against one.

A few updates are timed, in turn for one copy and for many, and the time of the paper's 2,200 is extrapolated from
them: every update does the same work. The reference of the ratio is one copy in the same round.

    python benchmarks/policy.py        or        python -m tsmlib bench policy
"""

from __future__ import annotations

import argparse
import resource
import sys
from collections import defaultdict
from typing import Any

import numpy as np
import torch
from plan import models
from tqdm.auto import tqdm

from tsmlib import rewards, runs, store, study
from tsmlib.policy import OneStepPolicy, SegmentPolicy, episodes_from, improve

SCHEDULE = 2200  # updates until the rate has decayed to its end, A25


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="tsm/Reacher-v0")
    parser.add_argument("--copies", type=int, default=10)
    parser.add_argument("--iterations", type=int, default=5, help="updates per round (default 5)")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    model, prior, origin = models(runs.resolve("bench", scale="laptop"), arguments.env)
    task = study.task(arguments.env, "validation")
    draw, reward = episodes_from(torch.from_numpy(task.start)), getattr(rewards, task.name)
    state_dim = task.start.shape[1]

    def seconds(kind: str, copies: int) -> float:
        """Of one update."""
        learner: Any = (
            SegmentPolicy(state_dim, prior, copies=copies)
            if kind == "codes"
            else OneStepPolicy(state_dim, 2, copies=copies)
        )
        learner.features.load_state_dict(model.features.state_dict())
        n = arguments.iterations
        return improve(learner, model, reward, draw, iterations=n, record_every=n).seconds[-1] / n

    totals: dict[tuple[str, int], list[float]] = defaultdict(list)
    for _ in tqdm(range(arguments.rounds), desc="rounds"):
        for kind in ("codes", "actions"):
            for copies in (1, arguments.copies):
                totals[kind, copies].append(seconds(kind, copies))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)

    print(
        f"{arguments.env}, {origin} models, {task.horizon} steps, 20 episodes and {torch.get_num_threads()} threads, "
        f"{arguments.iterations} updates in each of {arguments.rounds} rounds: median (lowest to highest)"
    )
    rows = []
    common = dict(env=arguments.env, sim="mujoco", task=task.name, model="tsm", planner="policy", horizon=task.horizon)
    for kind in ("codes", "actions"):
        one, many = (np.array(totals[kind, copies]) for copies in (1, arguments.copies))
        ratio = many / one
        whole = SCHEDULE * np.median(one)
        print(
            f"through {kind:8} {np.median(one):6.3f} s an update ({one.min():.3f} to {one.max():.3f}); extrapolated to "
            f"{SCHEDULE} updates: {whole / 60:.1f} min"
        )
        print(
            f"  {arguments.copies} copies take {np.median(ratio):.2f}x ({ratio.min():.2f} to {ratio.max():.2f}) as long"
        )
        rows.append(dict(common, prior=kind, condition="extrapolated", metric="seconds", value=whole, unit="s"))
        for word, of in (("median", np.median), ("lowest", np.min), ("highest", np.max)):
            rows.append(dict(common, prior=kind, condition="copies", metric=f"ratio_{word}", value=of(ratio)))
    print(f"peak memory of it all: {peak / 2**30:.2f} GiB")
    rows.append(dict(common, condition="copies", metric="peak_bytes", value=peak, unit="B"))
    path = runs.resolve("bench").dir.parents[1] / "bench" / "policy.csv"
    store.save_table(path, [dict(row, n=arguments.rounds) for row in rows])
    print(path)


if __name__ == "__main__":
    main()
