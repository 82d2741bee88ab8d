"""Exploration on the plain arm: what data of a model's own plans are worth beside as many random ones.

    python benchmarks/exploration/run.py --ways planned noise bonus random --seeds 0 1 2

From 40 random episodes of 50 steps on, five rounds of 20 episodes each, all of equal training: ``planned`` by
``tsmlib.explore``, ``noise`` and ``bonus`` with its two ways to look further, ``random`` by smooth random torques.
After every round, the models plan for 50 validation targets, again every ten steps (``mpc``). Candidates, but those of
rounds with a bonus, are judged by the mode and eight samples. A line in table.csv for each round: cost, share within
3 cm, mean absolute gap, CPU seconds. Lines that are there are not measured again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pandas as pd
import torch

import tsmlib as tsm
from tsmlib import study
from tsmlib.study.results import table

HERE, ENV = Path(__file__).resolve().parent, "tsm/Reacher-v0"
FIRST, ROUNDS, EPISODES, HORIZON, TARGETS = 40, 5, 20, 50, 50
KEY = ["way", "seed", "round"]
WAYS: Mapping[str, Mapping[str, float]] = {
    "planned": {}, "noise": {"noise": 0.5}, "bonus": {"bonus": 1.0}, "random": {},
}  # fmt: skip
SEARCH = dict(candidates=64, elites=8, iterations=4, screened=0.25)
PREDICTED = 1000  # seed of what measures, of its judges eight times that, so that no sample judges what it predicts


def training(past_len: int, future_len: int, steps: int) -> tsm.TrainingOptions:
    return tsm.TrainingOptions(past_len, future_len, steps, batch_size=64, lr=2e-3, validate_every=50, warmup=20)


def task_of(round_: int, seed: int) -> tsm.Task:
    """Targets anywhere that the arm reaches, from its own starts."""
    draw = torch.Generator().manual_seed(1000 * seed + round_)
    radius, angle = 0.2 * torch.rand(EPISODES, generator=draw).sqrt(), 6.2832 * torch.rand(EPISODES, generator=draw)
    target = torch.stack([radius * angle.cos(), radius * angle.sin()], -1)
    start = tsm.collect_random(ENV, EPISODES, horizon=1, seed=50_000 + 1000 * seed + 100 * round_).states[:, 0]
    return tsm.Task.standard(ENV, start, target)


def random_episodes(round_: int, seed: int) -> tsm.Trajectories:
    """As many episodes of smooth random torques as a round plans."""
    return tsm.collect_random(ENV, EPISODES, horizon=HORIZON, seed=50_000 + 1000 * seed + 100 * round_, rms=0.1)


def measured(model: tsm.DynamicsModel, prior: tsm.ActionPrior | None) -> dict[str, float]:
    """Cost of plans on validation targets."""
    assert prior is not None
    task = study.load_task(ENV, "validation").take(TARGETS)
    space, planner = tsm.LatentActions(prior, task.horizon), partial(tsm.cem, **SEARCH)
    trial = tsm.mpc(task, model, space, planner, judge=tsm.expected_predictor, seed=PREDICTED)
    assert trial.success is not None
    return {
        "cost": -float(trial.executed_return.mean()), "within_3cm": float(trial.success.float().mean()),
        "absolute_gap": float(trial.gap.abs().mean()),
    }  # fmt: skip


def rounds(way: str, seed: int) -> list[dict[str, object]]:
    """The lines of one loop, round 0 before it first."""
    began = time.process_time()
    first = tsm.collect_random(ENV, FIRST, horizon=HORIZON, seed=1000 * seed, rms=0.1)
    held_out, train = first.take(slice(8)), first.take(slice(8, None))
    model = tsm.RecurrentTSM.for_data(train, seed=seed, hidden=64)
    prior = tsm.ActionPrior.for_data(train, seed=seed, channels=16, dilations=(1, 2, 4, 2))
    fits = {"model": training(model.past_len, 20, 200), "prior": training(prior.past_len, 10, 200)}
    tsm.fit(model, model.loss, train, held_out, fits["model"], seed=seed)
    tsm.fit(prior, prior.loss, train, held_out, fits["prior"], seed=seed)
    lines: list[dict[str, object]] = []

    def line(round_: int, steps: int, found: Mapping[str, float]) -> None:
        lines.append({
            "way": way, "seed": seed, "round": round_, "env_steps": steps,
            **{name: f"{found[name]:.4g}" for name in ("cost", "within_3cm", "absolute_gap")},
            "cpu_seconds": f"{time.process_time() - began:.0f}",
        })  # fmt: skip
        print(lines[-1], flush=True)

    line(0, FIRST * HORIZON, measured(model, prior))
    options = tsm.ExplorationOptions(**fits, rounds=ROUNDS, **SEARCH, **WAYS[way])
    tsm.explore(
        model, prior, train, held_out, partial(task_of, seed=seed), options, seed=seed, measure=measured,
        episodes=partial(random_episodes, seed=seed) if way == "random" else None,
        callback=lambda at: line(at.step, FIRST * HORIZON + int(at.values["env_steps"]), at.values),
    )  # fmt: skip
    return lines


def summary(lines: pd.DataFrame) -> str:
    """Mean cost, share within 3 cm and gap by way and round, with half the 95 % t interval over seeds."""
    rows = []
    for (round_, way), part in lines.groupby(["round", "way"], sort=True):
        spelled = {"cost": table.spell(part["cost"], "{:.2f} ± {:.2f}")}
        spelled["within 3 cm"] = table.spell(100 * part["within_3cm"], "{:.0f} ± {:.0f} %")
        spelled["gap"] = table.spell(part["absolute_gap"], "{:.2f} ± {:.2f}")
        rows.append({"round": round_, "data": way, **spelled, "seeds": len(part)})
    return table.markdown(pd.DataFrame(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--out", type=Path, default=HERE / "table.csv")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for seed in given.seeds:
        for way in given.ways:
            known = pd.read_csv(given.out) if given.out.exists() else pd.DataFrame(columns=KEY)
            if not (known[KEY] == [way, seed, ROUNDS]).all(axis=1).any():
                pd.concat([known, pd.DataFrame(rounds(way, seed))]).to_csv(given.out, index=False)
    print(summary(pd.read_csv(given.out)))


if __name__ == "__main__":
    main()
