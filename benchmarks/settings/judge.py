"""What a candidate of the planner is judged by, with one trained model: its mode, or samples of it, and how many.

    mode              one rollout with z = 0
    mean of S         mean return over S samples, the same noise for every candidate and iteration
    fresh mean of S   the same, with other noise in every iteration; the plan with the best return by its own noise wins
    median of S       median return over S samples, the same noise for every candidate and iteration
    mode and mean of S    half the mode's return, half the mean's

All with the cross-entropy method over the codes of the action prior, on validation targets, executed open loop; and
with ``closed`` 1 planning again every 10 steps (4 iterations, from what is left of the plan before). gap is the
return that the planner's judge (gap_judge) or 32 fresh samples (gap_fresh) predict for the plan, minus the executed
one. ``costs`` are those of the single targets, for paired differences.

    python benchmarks/settings/judge.py runs/settings/base-x1-seed0.safetensors base
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from push_task import CHOSEN, ENV, HERE, action_prior, physics
from safetensors.torch import load_file
from successor import TRIES, data, executed, posed, read, write
from torch import Tensor

from tsmlib import rewards
from tsmlib.models.base import rollout
from tsmlib.planning.base import Predictor
from tsmlib.planning.execution import mpc
from tsmlib.planning.planners import cem, expected_return
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.sampling import SharedNoise
from tsmlib.trajectory import Segment, initial_past

JUDGES = (
    "mode", "mean of 2", "fresh mean of 2", "mode and mean of 2", "mean of 6", "fresh mean of 6", "median of 6",
    "mean of 16", "median of 16",
)  # fmt: skip


def predictor(net: Any, past: Segment, judge: str, seed: int, candidates: int) -> Predictor:
    """From actions (C, B, T, 2) to the states (S, C, B, T, dx) by which a candidate is judged."""
    words = judge.split()
    if judge == "mode":
        return model_predictor(net, past, samples=0)
    n = int(words[-1])
    if words[0] == "fresh":
        return Fresh(net, past, n, seed, candidates)
    common = model_predictor(net, past, samples=n, seed=seed)
    if words[:2] == ["mode", "and"]:
        mode = model_predictor(net, past, samples=0)
        return lambda actions: torch.cat([mode(actions).expand(n, -1, -1, -1, -1), common(actions)])
    return common


class Fresh:
    """Samples with other noise for every population, which is asked for in parts: ``candidates`` and their mean."""

    def __init__(self, net: Any, past: Segment, samples: int, seed: int, candidates: int) -> None:
        self.net, self.past, self.samples, self.seed = net, past, samples, seed
        self.population, self.asked = candidates + 1, -1  # the first call asks for the start

    def __call__(self, actions: Tensor) -> Tensor:
        n, n_targets = actions.shape[:2]
        index = self.asked // self.population
        self.asked += n
        rows = actions[:, None].expand(-1, self.samples, -1, -1, -1).flatten(0, 2)
        past = Segment(*(part.repeat(n * self.samples, 1, 1) for part in self.past))
        generator = torch.Generator().manual_seed(1_000_003 * (self.seed + 1) + index)
        states = rollout(self.net, past, rows, generator=SharedNoise(generator, self.samples * n_targets))
        return states.unflatten(0, (n, self.samples, n_targets)).transpose(0, 1)


def by_median(reward: Any) -> Any:
    """A reward whose sum, averaged over the samples, is the median return; for planners that take means."""

    def judged(states: Tensor, actions: Tensor) -> Tensor:
        per_step = reward(states, actions)
        middle = per_step.sum(-1).median(0).values  # (C, B)
        return (middle / per_step.shape[-1])[None, ..., None].expand_as(per_step)

    return judged


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, help="as successor.py leaves them")
    parser.add_argument("what", choices=list(TRIES), help="the try they are from")
    parser.add_argument("--judges", nargs="+", choices=JUDGES, default=JUDGES, metavar="JUDGE")
    parser.add_argument("--targets", type=int, default=25)
    parser.add_argument("--candidates", type=int, default=96)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the planner")
    parser.add_argument("--closed", action="store_true", help="plan again every 10 steps too")
    parser.add_argument("--out", type=Path, default=HERE / "judge.csv")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    net = TRIES[arguments.what].build(data("train", 0), 0)
    net.load_state_dict(load_file(arguments.weights))
    net.eval()
    n, (starts, targets) = arguments.targets, posed(arguments.targets)
    past, reward = initial_past(torch.from_numpy(starts), net.past_len, 2), rewards.push(targets)
    space = LatentActions(action_prior(), CHOSEN.horizon)
    fresh = model_predictor(net, past, samples=32 if getattr(net, "stochastic", True) else 1, seed=77)
    elites = max(2, arguments.candidates // 10)
    for seed in arguments.seeds:
        for judge in arguments.judges:
            search = partial(cem, candidates=arguments.candidates, elites=elites, seed=seed)
            began = time.process_time()
            predict = predictor(net, past, judge, seed, arguments.candidates)
            judged = by_median(reward) if "median" in judge else reward
            plan = search(predict, judged, space, n, iterations=arguments.iterations)
            seconds = time.process_time() - began
            with torch.no_grad():
                foreseen = expected_return(fresh(plan.actions[None]), plan.actions[None], reward)[0]
            found = [(0, seconds, *executed(plan.actions, targets, starts))]
            if arguments.closed and judge == "mode":
                with physics(CHOSEN):
                    task = replace(Task.standard(ENV, starts, targets), horizon=CHOSEN.horizon)
                    trial = mpc(
                        task, net, space, partial(search, iterations=4),
                        every=10, plan=plan, samples=0, seed=seed,
                    )  # fmt: skip
                found.append((1, time.process_time() - began, trial.executed_return, trial.final_distance))
            for closed, spent, returns, final in found:
                row = {
                    "model": arguments.weights.stem, "judge": judge, "closed": closed, "planner_seed": seed,
                    "targets": n, "candidates": arguments.candidates, "iterations": arguments.iterations,
                    "cpu_seconds": spent, "cost": -float(returns.mean()), "cost_sem": float(returns.std() / n**0.5),
                    "within_5cm": float((final < 0.05).float().mean()), "final_mean": float(final.mean()),
                    "gap_judge": float((plan.predicted_return - returns).mean()),
                    "gap_fresh": float((foreseen - returns).mean()),
                    "gap_fresh_abs": float((foreseen - returns).abs().mean()),
                    "costs": " ".join(f"{-value:.2f}" for value in returns.tolist()),
                }  # fmt: skip
                row = {word: f"{value:.4g}" if isinstance(value, float) else str(value) for word, value in row.items()}
                write(arguments.out, [*read(arguments.out), row])
                print(row, flush=True)


if __name__ == "__main__":
    main()
