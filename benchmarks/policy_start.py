"""What a search gains from the policy that ships: ``python benchmarks/policy_start.py``.

Pushing, planned again every ten steps through ``rtsm``: return, half of its 95 % interval over
targets, share within 5 cm and CPU seconds; of 50 validation targets, then of the 100 frozen ones.
"""

from __future__ import annotations

import time
from functools import partial

import torch
from torch import Tensor

import tsmlib
from tsmlib.policies.imagination import imagine
from tsmlib.trajectory import Segment

ENV = "tsm/ReacherPush-v1"
BUDGETS = ((19, 4, 4), (19, 4, 10), (96, 12, 10))  # candidates, elites, iterations


@torch.no_grad()
def main() -> None:
    model, policy = tsmlib.load_pretrained("rtsm", env=ENV), tsmlib.load_policy(env=ENV)

    def proposal(task: tsmlib.Task, past: Segment, steps: int) -> Tensor:
        return imagine(policy, model, past, task.target, horizon=steps).actions

    for subset, n, budgets in (("validation", 50, BUDGETS), ("test", 100, BUDGETS[:1])):
        task = tsmlib.load_task(ENV, subset).take(n)
        space = tsmlib.DirectActions(task.horizon, rms=0.1)
        for candidates, elites, iterations in budgets:
            planner = partial(
                tsmlib.cem, candidates=candidates, elites=elites, iterations=iterations, seed=0
            )
            for how, start in (("from zero", None), ("from the policy", proposal)):
                began = time.process_time()
                trial = tsmlib.mpc(task, model, space, planner, every=10, proposal=start)
                seconds, returns = time.process_time() - began, trial.executed_return
                half = float(1.96 * returns.std() / n**0.5)
                near = float((trial.final_distance < 0.05).float().mean())
                print(
                    f"{subset}, {candidates} x {iterations} {how}: {float(returns.mean()):.2f} "
                    f"± {half:.2f}, {near:.0%}, {seconds:.0f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
