"""Rounds of exploration on Gymnasium's pendulum, from a few random episodes on: what 10_explore measures.

A learner is a model, with an action prior if it plans over codes. Beside the loop (``explore``) stands the same learner
on as many random episodes, trained as often.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.collection import collect, collect_random, open_loop
from tsmlib.envs.stepping import make_simulation
from tsmlib.exploration import ExplorationOptions, Measure, Trainable, explore
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.base import Planner, SearchSpace
from tsmlib.planning.execution import mpc
from tsmlib.planning.planners import cem
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.storage.files import Json
from tsmlib.study import zoo
from tsmlib.study.results import exploration as results
from tsmlib.study.results.exploration import HORIZON, PENDULUM
from tsmlib.study.results.table import Row
from tsmlib.study.runs import Run
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Trajectories

LEARNERS: Mapping[str, Mapping[str, Json]] = {  # arguments of the model, beyond the defaults
    "rtsm": {"hidden": 48}, "lstm": {"hidden": 48}, "ensemble+mse": {"gaussian": False, "hidden": 64},
}  # fmt: skip
WITHOUT_PRIOR = ("ensemble+mse",)  # as PETS plans
TESTED = 1000  # seed of the starts that measure, of no round


@dataclass(frozen=True)
class Sizes:
    """Of a loop: random episodes before it, rounds, episodes of each, updates of each training, starts that measure.

    candidates, elites, iterations: of every plan; one is made every ten steps.
    """

    first: int
    rounds: int
    episodes: int
    updates: int
    starts: int
    candidates: int
    elites: int
    iterations: int

    def training(self, past_len: int, future_len: int) -> TrainingOptions:
        """Of a model or a prior, in every round."""
        return TrainingOptions(
            past_len, future_len, self.updates, batch_size=64, lr=2e-3, warmup=min(20, self.updates),
            validate_every=max(1, self.updates // 4),
        )  # fmt: skip

    def options(self, past_len: int) -> ExplorationOptions:
        """Of ``explore``, for a model that reads as many steps of past."""
        return ExplorationOptions(
            model=self.training(past_len, 20), prior=self.training(10, 10), rounds=self.rounds,
            candidates=self.candidates, elites=self.elites, iterations=self.iterations,
        )  # fmt: skip


SIZES = {  # by scale
    "smoke": Sizes(4, 1, 2, 2, 2, 4, 2, 1),
    "laptop": Sizes(6, 3, 4, 100, 4, 24, 5, 2),
    "paper": Sizes(6, 4, 4, 120, 8, 24, 5, 2),
}


def upright(states: Tensor, actions: Tensor) -> Tensor:
    """Height of the pendulum, from -1 to 1, less what its speed costs."""
    return states[..., 0] - 0.01 * states[..., 2].square()


def swing_up(n: int, seed: int) -> Task:
    """Swinging the pendulum up, from starts of the environment; success is to end within 18 degrees of upright."""
    return Task.from_env(
        PENDULUM, n=n, horizon=HORIZON, seed=seed, reward=upright, success=lambda x: x[:, -1, 0] > 0.95
    )


def tasks(episodes: int, seed: int) -> Callable[[int], Task]:
    """Round -> its starts."""
    return lambda k: swing_up(episodes, seed=100_000 * (seed + 1) + 1000 * k)


def random_episodes(n: int, seed: int) -> Trajectories:
    """Smooth random torques, which hardly ever swing the pendulum up."""
    return collect_random(PENDULUM, n, horizon=HORIZON, seed=seed, rms=0.6, time_constant=0.3)


def divided(data: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training and held-out episodes, one in five."""
    n = max(1, len(data) // 5)
    return data.take(slice(n, None)), data.take(slice(n))


def walks(prior: ActionPrior, n: int, *, seed: int = 0) -> Trajectories:
    """What random codes of a prior do, an episode of each, from the environment's own starts."""
    segments = HORIZON // prior.segment_len
    codes = torch.randn(n, segments, prior.latent_dim, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        actions = LatentActions(prior, HORIZON).decode(codes[None])[0]
    with closing(make_simulation(PENDULUM, n)) as simulation:
        return collect(simulation, open_loop(actions), horizon=HORIZON, seed=seed)


def plane(data: Trajectories) -> np.ndarray:
    """Angle from upright (rad) and angular velocity (rad/s) of every state (n, 2)."""
    cos, sin, speed = np.concatenate([x[: n + 1] for x, n in zip(data.states, data.steps, strict=True)]).T
    return np.stack([np.arctan2(sin, cos), speed], axis=1)


def planner(sizes: Sizes, seed: int) -> Planner:
    """The cross-entropy method with the budget of a loop."""
    return partial(
        cem, candidates=sizes.candidates, elites=sizes.elites, iterations=sizes.iterations, seed=seed
    )  # fmt: skip


def measure(sizes: Sizes, seed: int) -> Measure:
    """Plans from the same starts after every round, and how high random codes of the prior swing the pendulum."""
    task = swing_up(sizes.starts, seed=TESTED)

    def measured(model: DynamicsModel, prior: ActionPrior | None) -> dict[str, float]:
        trial = mpc(task, model, space_of(prior), planner(sizes, seed))
        assert trial.success is not None
        found = {
            "return_true": float(trial.executed_return.mean()), "gap_absolute": float(trial.gap.abs().mean()),
            "success": float(trial.success.float().mean()),
        }  # fmt: skip
        if prior is not None:
            found["highest"] = highest(walks(prior, max(8, sizes.starts)))
        return found

    return measured


def highest(data: Trajectories) -> float:
    """Mean over episodes of the greatest height, from -1 (hanging) to 1 (upright)."""
    return float(data.states[..., 0].max(1).mean())


def space_of(prior: ActionPrior | None) -> SearchSpace:
    """Codes of the prior, or torques where there is none."""
    return DirectActions(HORIZON, 1, rms=0.6) if prior is None else LatentActions(prior, HORIZON)


class Learner(NamedTuple):
    """A model and its prior, trained on random episodes."""

    model: Trainable
    prior: ActionPrior | None
    train: Trajectories
    held_out: Trajectories


def learner(word: str, sizes: Sizes, seed: int) -> Learner:
    """One of LEARNERS as a loop begins."""
    train, held_out = divided(random_episodes(sizes.first, 1000 * seed))  # episode i is of seed + i
    made_for = cast(type[RecurrentTSM], zoo.find(word).load())
    model = made_for.for_data(train, seed=seed, **LEARNERS[word])
    prior = None if word in WITHOUT_PRIOR else ActionPrior.for_data(train, seed=seed, channels=16)
    _train(model, prior, train, held_out, sizes, seed)
    return Learner(model, prior, train, held_out)


def _train(
    model: nn.Module, prior: ActionPrior | None, train: Trajectories, held_out: Trajectories, sizes: Sizes, seed: int
) -> None:
    options = sizes.options(cast(RecurrentTSM, model).past_len)
    if prior is not None and options.prior is not None:
        fit(prior, prior.loss, train, held_out, options.prior, seed=seed)
    fit(model, cast(RecurrentTSM, model).loss, train, held_out, options.model, seed=seed)


def loop(run: Run, word: str, sizes: Sizes, *, random: bool = False) -> list[Row]:
    """Rows of a learner's rounds, round 0 before them; random: on as many random episodes, in place of its plans."""
    model, prior, train, held_out = learner(word, sizes, run.seed)
    measured, began = measure(sizes, run.seed), len(train) + len(held_out)
    records: list[Mapping[str, float]] = [{"round": 0, "env_steps": 0, **measured(model, prior)}]
    if random:
        for k in range(1, sizes.rounds + 1):
            new = random_episodes(sizes.episodes, seed=100_000 * (run.seed + 1) + 1000 * k)
            train, held_out = train.joined(new.take(slice(1, None))), held_out.joined(new.take(slice(1)))
            _train(cast(nn.Module, model), prior, train, held_out, sizes, 1000 * run.seed + k)
            steps = k * sizes.episodes * HORIZON
            records.append({"round": k, "env_steps": steps, **measured(model, prior)})
    else:
        options = sizes.options(model.past_len)
        options = options if prior else replace(options, prior=None)
        found = explore(
            model, prior, train, held_out, tasks(sizes.episodes, run.seed), options,
            seed=run.seed, progress=f"{PENDULUM} {word}", measure=measured,
        )  # fmt: skip
        records += found.records
    return results.round_rows(run, word, records, sizes.starts, first=began * HORIZON, random=random)
