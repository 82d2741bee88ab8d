"""Planning pushes over latent codes through the model, against simulating as many steps in MuJoCo.

The paper's planner: Adam over the codes of the action prior, 100 iterations for all targets at once. Each iteration
predicts one rollout per target and sample; the reference executes as many steps in the simulator, in bulk and without
a gradient. Every round times both, in turn.

    python benchmarks/plan.py        or        python -m tsmlib bench plan
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable

import gymnasium
import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib import runs, store, study
from tsmlib.collect import collect, once
from tsmlib.prior import ActionPrior
from tsmlib.trajopt import LatentActions, adam, through_model
from tsmlib.tsm import TSM

ENV = "tsm/ReacherPush-v0"


def models(run: runs.Run, env: str) -> tuple[TSM, ActionPrior, str]:
    """The shipped models; where there are none, untrained ones, which are as fast."""
    folder = run.shipped / study.short(env)
    if all((folder / f"{name}.safetensors").exists() for name in ("tsm", "prior")):
        tsm = store.load_model(folder / "tsm.safetensors", TSM)
        return tsm, store.load_model(folder / "prior.safetensors", ActionPrior), "shipped"
    data = study.random_data(env, 50, seed=0)
    return study.fresh(run, "tsm", data), study.fresh(run, "prior", data), "untrained"


def timed(call: Callable[[Tensor], Tensor], name: str, seconds: dict[str, float]) -> Callable[[Tensor], Tensor]:
    """``call``, adding what it takes to ``seconds[name]``."""

    def run(argument: Tensor) -> Tensor:
        began = time.perf_counter()
        result = call(argument)
        seconds[name] += time.perf_counter() - began
        return result

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=100)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--samples", type=int, default=2, help="model samples per target (default 2, as scale laptop)")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    run = runs.resolve("bench", scale="laptop")
    task = study.task(ENV).take(arguments.targets)
    model, prior, origin = models(run, ENV)
    n_rollouts = (arguments.iterations + 2) * arguments.samples * len(task)  # before, between and after the iterations

    totals: dict[str, list[float]] = defaultdict(list)
    for _ in tqdm(range(arguments.rounds), desc="rounds"):
        seconds: dict[str, float] = defaultdict(float)
        space = LatentActions(prior, task.horizon)
        start = torch.zeros(1, len(task), *space.shape)
        space.decode = timed(space.decode, "codes to torques", seconds)  # type: ignore[method-assign]
        predict = through_model(model, task.past(model.past_len), samples=arguments.samples)
        predict = timed(predict, "torques to states", seconds)
        plan = adam(predict, task.reward, space, start, iterations=arguments.iterations)
        seconds["gradients and the rest"] = plan.seconds - sum(seconds.values())
        began = time.perf_counter()
        simulate(task.start, plan.actions, n_rollouts)
        for name, value in {"plan": plan.seconds, "simulate": time.perf_counter() - began, **seconds}.items():
            totals[name].append(value)

    rows = []
    print(
        f"{ENV}, {len(task)} targets, {task.horizon} steps, {arguments.iterations} iterations, {arguments.samples} "
        f"samples, {origin} models, {torch.get_num_threads()} threads, {arguments.rounds} rounds: median (lowest to "
        "highest)"
    )
    common = dict(env=ENV, sim="mujoco", task="push", model="tsm", planner="adam", prior="codes")
    for name, values in totals.items():
        share = f"{np.median(np.array(values) / totals['plan']):5.0%} of the plan" if name != "simulate" else ""
        print(f"{name:24} {np.median(values):7.2f} s ({min(values):.2f} to {max(values):.2f})  {share}")
        metric = "plan_seconds" if name == "plan" else "seconds"
        rows.append(dict(common, condition=name, metric=metric, value=np.median(values), unit="s"))
    ratio = np.array(totals["plan"]) / np.array(totals["simulate"])
    spread = f"({ratio.min():.2f} to {ratio.max():.2f})"
    print(f"a plan takes {np.median(ratio):.2f}x {spread} as long as simulating its steps")
    for word, of in (("median", np.median), ("lowest", np.min), ("highest", np.max)):
        rows.append(dict(common, condition="plan", metric=f"ratio_{word}", value=of(ratio)))
    path = runs.resolve("bench").dir.parents[1] / "bench" / "plan.csv"
    store.save_table(path, [dict(row, horizon=task.horizon, n=arguments.rounds) for row in rows])
    print(path)


def simulate(start: np.ndarray, actions: Tensor, n_rollouts: int) -> None:
    """Execute ``n_rollouts`` episodes in bulk, the actions over and over."""
    copies = -(-n_rollouts // len(start))
    env = gymnasium.make_vec(ENV, num_envs=copies * len(start))
    collect(env, once(actions.repeat(copies, 1, 1)), horizon=actions.shape[1], states=np.tile(start, (copies, 1)))
    env.close()


if __name__ == "__main__":
    main()
