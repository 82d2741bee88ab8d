"""Planning pushes through the model: in the latent and the direct search space by Adam, in the latent one by CEM.

The paper's planner is Adam with 100 iterations for all targets at once. A call here has a few iterations, in turn with
the same call through the plain model and prior of ``_plain``, and with simulating some of the same steps in MuJoCo, in
bulk and without a gradient. A planner also predicts once after its last iteration and once for the plan that it gives
back, here as there; the time of the whole plan counts these as often as there are rounds in it, so it is a little high.
``--whole`` also runs the whole latent plan by Adam once, as a check of what the rounds extrapolate.

    python benchmarks/plan.py        or        python -m tsmlib bench plan
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from _plain import PlainPrior, PlainTSM
from _rounds import SGEMM, Products, Row, interleaved, parsed, parser, peak_bytes, save
from reproduction.models import load_pretrained
from torch import Tensor

from reproduction import runs
from tsmlib import study
from tsmlib.collection import collect, open_loop
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.tsm import TSM
from tsmlib.planning.planners import adam, cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions

ENV = "tsm/ReacherPush-v1"


def models(run: runs.Run, env: str) -> tuple[TSM, ActionPrior, str]:
    """The shipped models; where there are none, untrained ones, which are as fast."""
    if (run.shipped / EnvSpec.parse(env).name / "tsm.safetensors").exists():
        return load_pretrained("tsm", env=env), load_pretrained("prior", env=env), "shipped"
    data = study.random_data(env, 50, seed=0)
    return study.initialise(run, "tsm", data), study.initialise(run, "prior", data), "untrained"


def timed(
    call: Callable[[Tensor], Tensor], name: str, seconds: dict[str, float]
) -> Callable[[Tensor], Tensor]:
    """``call``, adding what it takes to ``seconds[name]``."""

    def run(argument: Tensor) -> Tensor:
        began = time.perf_counter()
        result = call(argument)
        seconds[name] += time.perf_counter() - began
        return result

    return run


def main() -> None:
    options = parser(__doc__, rounds=3)
    options.add_argument("--targets", type=int, default=100)
    options.add_argument(
        "--iterations",
        type=int,
        default=100,
        help="of the whole plan (default 100, as in the paper)",
    )
    options.add_argument(
        "--horizon", type=int, default=50, help="steps (default 50, as in the paper)"
    )
    options.add_argument("--few", type=int, default=4, help="iterations in a round (default 4)")
    options.add_argument(
        "--candidates", type=int, default=16, help="of the cross-entropy method (default 16)"
    )
    options.add_argument(
        "--samples", type=int, default=0, help="that judge a candidate (default 0, the mode)"
    )
    options.add_argument("--whole", action="store_true", help="run the whole plan too, minutes")
    arguments = parsed(options)
    few, samples = arguments.few, arguments.samples
    run = runs.resolve("bench", scale="laptop")
    task = study.load_task(ENV).take(arguments.targets)
    n_targets, horizon = len(task), arguments.horizon
    model, prior, origin = models(run, ENV)
    plain_prior: Any = PlainPrior(prior)
    seconds: dict[str, float] = defaultdict(float)

    def latent(prior: Any) -> LatentActions:
        return LatentActions(prior, horizon)

    def through(model: Any) -> Callable[[Tensor], Tensor]:
        return model_predictor(model, task.past(model.past_len), samples=samples)

    def in_parts() -> None:
        """The latent plan by Adam, with the seconds of its parts."""
        space = latent(prior)
        space.decode = timed(space.decode, "codes to torques", seconds)  # type: ignore[method-assign]
        predict = timed(through(model), "torques to states", seconds)
        seconds["plan"] += adam(predict, task.reward, space, n_targets, iterations=few).seconds

    fast, plain = through(model), through(PlainTSM(model))
    few_adam = partial(adam, reward=task.reward, start=n_targets, iterations=few)
    few_cem = partial(
        cem,
        reward=task.reward,
        start=n_targets,
        iterations=1,
        candidates=arguments.candidates,
        elites=max(2, arguments.candidates // 4),
    )
    simulated = max(
        1, max(1, samples) * n_targets // 4
    )  # rollouts, a part of those of one iteration
    start, torques = (
        task.start,
        0.1 * torch.randn(n_targets, horizon, 2, generator=torch.Generator().manual_seed(0)),
    )
    ways: dict[str, Callable[[], object]] = {
        "latent, Adam": lambda: few_adam(fast, space=latent(prior)),
        "latent, Adam plain": lambda: few_adam(plain, space=latent(plain_prior)),
        "direct, Adam": lambda: few_adam(fast, space=DirectActions(horizon, rms=0.1)),
        "direct, Adam plain": lambda: few_adam(plain, space=DirectActions(horizon, rms=0.1)),
        "latent, CEM": lambda: few_cem(fast, space=latent(prior)),
        "latent, CEM plain": lambda: few_cem(plain, space=latent(plain_prior)),
        "simulate": lambda: simulate(start, torques, simulated),
    }
    words = {
        "latent, Adam": ("latent", "adam"),
        "direct, Adam": ("direct", "adam"),
        "latent, CEM": ("latent", "cem"),
    }
    products = {f"{word} sgemm": Products.of(ways[word]).alone() for word in words}
    peaks = {way: peak_bytes(call) for way, call in ways.items()}
    taken = interleaved(ways | products, arguments.rounds, warm=False)
    in_parts()

    common = dict(env=ENV, sim="mujoco", task="push", model="tsm", horizon=horizon)
    rows, threads = [], min(os.cpu_count() or 1, 8)  # as the environment takes them
    for word, (search_space, planner) in words.items():
        done = few if planner == "adam" else 1
        way = dict(common, planner=planner, search_space=search_space)
        rows.append(
            Row.of(
                f"plan, {word}, {n_targets} targets: iterations",
                done / taken[word],
                "plain eager float32",
                done / taken[f"{word} plain"],
                limit=SGEMM,
                bound=done / taken[f"{word} sgemm"],
                peak=peaks[word],
                configuration="plain",
                metric="iterations_per_second",
                **way,
            )
        )
        if planner == "cem":
            continue
        scale, n_rollouts = arguments.iterations / few, few * max(1, samples) * n_targets
        rows.append(
            Row.of(
                f"plan, {word}, {n_targets} targets, {arguments.iterations} iterations, extrapolated: seconds",
                scale * taken[word],
                f"executing its steps in MuJoCo, {threads} threads",
                scale * taken["simulate"] * n_rollouts / simulated,
                unit="s",
                peak=peaks[word],
                configuration="simulate",
                metric="plan_seconds",
                **way,
            )
        )
    if arguments.whole:
        whole = partial(
            adam, fast, task.reward, latent(prior), n_targets, iterations=arguments.iterations
        )
        began = time.perf_counter()
        peak = peak_bytes(whole)
        extrapolated = np.median(taken["latent, Adam"]) * arguments.iterations / few
        rows.append(
            Row.of(
                "plan, latent, Adam, all of it once: seconds",
                np.array([time.perf_counter() - began]),
                "its extrapolation from the rounds",
                extrapolated,
                unit="s",
                peak=peak,
                planner="adam",
                search_space="latent",
                configuration="whole",
                metric="plan_seconds",
                **common,
            )
        )
    seconds["gradients and the rest"] = 2 * seconds["plan"] - sum(seconds.values())
    for part in ("codes to torques", "torques to states", "gradients and the rest"):
        print(f"{part:24} {seconds[part] / seconds['plan']:5.0%} of the latent plan")
    print(
        f"{ENV}, {n_targets} targets, {horizon} steps, {few} iterations, {samples} samples, {origin} models, "
        f"{arguments.threads} threads, {arguments.rounds} rounds"
    )
    save("plan", rows)


def simulate(start: np.ndarray, actions: Tensor, n_rollouts: int) -> None:
    """Execute ``n_rollouts`` episodes in bulk, the actions over and over."""
    copies = -(-n_rollouts // len(start))
    env = gymnasium.make_vec(ENV, num_envs=copies * len(start))
    collect(
        env,
        open_loop(actions.repeat(copies, 1, 1)),
        horizon=actions.shape[1],
        states=np.tile(start, (copies, 1)),
    )
    env.close()


if __name__ == "__main__":
    main()
