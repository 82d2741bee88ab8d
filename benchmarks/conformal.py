"""How often the executed return of a chosen plan lies in its 90 % interval: conformal.csv.

    python benchmarks/conformal.py

Fresh starts and targets calibrate, the frozen test ones judge; both are planned for in the same
way, once, and executed open loop. The interval is around the return that the search maximised.
Shipped models, CEM with 64 candidates and 4 iterations.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import tsmlib
from tsmlib.evaluation.conformal import Conformal
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import draw_task, load_pusht

TABLE = Path(__file__).resolve().parents[1] / "data" / "results" / "conformal.csv"
ARMS = ("tsm/Reacher-v0", "tsm/ReacherPush-v1")
FRESH, SEED, LEVEL, STEPS = 200, 1_000_068, 0.9, 25
SEARCH = {"candidates": 64, "elites": 8, "iterations": 4}


def returns(model: tsmlib.DynamicsModel, task: Task, space: object) -> tuple[np.ndarray, ...]:
    """Predicted and executed return of one plan for each start."""
    predict = tsmlib.model_predictor(model, task.past(model.past_len))
    plan = tsmlib.cem(predict, task.reward, space, len(task), seed=0, **SEARCH)
    return plan.predicted_return.numpy(), tsmlib.execute(task, plan).executed_return.numpy()


def cases() -> Iterator[tuple[str, str, tsmlib.DynamicsModel, Task, Task, object]]:
    """What plans, for which starts, in which space."""
    for env in ARMS:
        fresh, frozen = draw_task(env, seed=SEED, n=FRESH), tsmlib.load_task(env)
        prior = tsmlib.load_pretrained("prior", env=env)
        spaces = {
            "codes": tsmlib.LatentActions(prior, frozen.horizon),
            "torques": tsmlib.DirectActions(frozen.horizon, 2, rms=0.1),
        }
        model = tsmlib.load_pretrained("rtsm", env=env)
        for name, space in spaces.items():
            yield env, f"rtsm, {name}", model, fresh, frozen, space
    env, space = "tsm/PushT-v0", tsmlib.DirectActions(STEPS, rms=0.6, smoothness=0.0)
    fresh, frozen = (replace(load_pusht(split), horizon=STEPS) for split in ("validation", "test"))
    model = tsmlib.load_pretrained("egocentric", env=env)
    yield env, "egocentric, actions", model, fresh, frozen, space


def main() -> None:
    rows = list(csv.DictReader(TABLE.open())) if TABLE.exists() else []  # goes on from these
    for env, method, model, fresh, frozen, space in cases():
        if any((row["env"], row["method"]) == (env, method) for row in rows):
            continue
        known, new = returns(model, fresh, space), returns(model, frozen, space)
        fitted = Conformal.fit(*known, LEVEL)
        low, high = fitted.interval(new[0])
        rows.append(
            {
                "env": env,
                "method": method,
                "calibrated on": len(known[0]),
                "n": len(new[0]),
                "coverage": round(float(fitted.coverage(*new)), 4),
                "below": round(float((new[1] < low).mean()), 4),
                "width": round(float((high - low).mean()), 4),
                "promised too much": round(float((new[0] - new[1]).mean()), 4),
                "executed": round(float(new[1].mean()), 4),
            }
        )
        print(rows[-1], flush=True)
        with TABLE.open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            table.writeheader()
            table.writerows(rows)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
