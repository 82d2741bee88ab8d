"""The pendulum and the pushing arm, on which rounds of exploration are measured, and the sizes of their loops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from tsmlib.envs.symmetry import symmetric
from tsmlib.exploration import ExplorationOptions
from tsmlib.models.base import DynamicsModel, as_dynamics
from tsmlib.planning.predictors import JUDGING
from tsmlib.planning.tasks import Task
from tsmlib.storage.files import Json
from reproduction import pendulum
from reproduction.data import random_data
from reproduction.results.exploration import PENDULUM, PUSH
from reproduction.tasks import draw_task, load_task
from tsmlib.training.fit import TrainingOptions
from tsmlib.trajectory import Trajectories


@dataclass(frozen=True)
class Sizes:
    """Of a loop: random episodes before it, rounds, episodes of each, updates of each training, starts that measure.

    candidates, elites, iterations, screened: of every plan; every: steps between plans. judging: samples by which
    candidates are judged beside the mode; 0: by the mode alone. before: updates of the model before the
    first round; prior: updates of each training of the prior; 0: as many as the model has in a round. searches:
    iterations of the search in which the first prior and the last are compared (``search``); 0: they are not.
    """

    first: int
    rounds: int
    episodes: int
    updates: int
    starts: int
    candidates: int
    elites: int
    iterations: int
    before: int = 0
    prior: int = 0
    searches: int = 0
    every: int = 10
    judging: int = JUDGING
    screened: float = 0.25

    def training(
        self, past_len: int, future_len: int, *, updates: int = 0, muon: float = 0.0
    ) -> TrainingOptions:
        """Of a model or a prior, by default in a round."""
        steps = updates or self.updates
        return TrainingOptions(
            past_len,
            future_len,
            steps,
            batch_size=64,
            lr=2e-3,
            warmup=min(20, steps),
            muon=muon,
            validate_every=max(1, steps // 4),
        )

    def options(self, past_len: int, *, muon: float = 0.0, rms: float = 0.1) -> ExplorationOptions:
        """Of ``explore``, for a model that reads as many steps of past; rms: of torques where no prior is searched."""
        return ExplorationOptions(
            model=self.training(past_len, 20, muon=muon),
            prior=self.training(10, 10, updates=self.prior),
            rounds=self.rounds,
            every=self.every,
            candidates=self.candidates,
            elites=self.elites,
            iterations=self.iterations,
            rms=rms,
            judging=self.judging,
            screened=self.screened,
        )

    def judged_for(self, model: DynamicsModel) -> Sizes:
        """The same for a model that may have no samples, whose one rollout judges."""
        return self if as_dynamics(model).stochastic else replace(self, judging=0, screened=1.0)


@dataclass(frozen=True)
class World:
    """What differs between the robots that explore.

    learners: arguments of each model, beyond the defaults; muon: its rate, if any. tested: starts that measure;
    drawn: (episodes, seed) -> the tasks of a round; random: (episodes, seed) -> what random torques of ``rms`` do;
    first: (episodes, training seed) -> those before round 1.
    augmented: what a model is trained on, made of its training data.
    """

    sizes: Mapping[str, Sizes]
    learners: Mapping[str, Mapping[str, Json]]
    tested: Callable[[int], Task]
    drawn: Callable[[int, int], Task]
    random: Callable[[int, int], Trajectories]
    first: Callable[[int, int], Trajectories]
    action_dim: int
    rms: float
    muon: Mapping[str, float]
    augmented: Callable[[Trajectories], Trajectories] | None = None


WORLDS = {
    PENDULUM: World(
        {
            "smoke": Sizes(4, 1, 2, 2, 2, 4, 2, 1),
            "laptop": Sizes(6, 3, 4, 100, 4, 24, 5, 2),
            "paper": Sizes(6, 4, 4, 1000, 8, 64, 8, 5, 1500, 300, every=5),
        },
        {
            "rtsm": {"hidden": 48},
            "lstm": {"hidden": 48},
            "ensemble+mse": {"gaussian": False, "hidden": 128},
        },
        tested=lambda n: pendulum.swing_up(n, seed=pendulum.TESTED),
        drawn=pendulum.swing_up,
        random=pendulum.random_episodes,
        first=pendulum.first_episodes,
        action_dim=1,
        rms=0.6,
        muon={},
    ),
    # All episodes of a loop, 950, are less than a tenth of the steps that the model-free learners take. It begins with
    # few, so that a round brings enough that is new (benchmarks/exploration). Hidden sizes make updates of both models
    # take as long.
    PUSH: World(
        {
            "smoke": Sizes(6, 1, 3, 2, 2, 4, 2, 1, searches=2),
            "laptop": Sizes(100, 2, 10, 300, 10, 48, 6, 3, 600, 200, searches=10),
            "paper": Sizes(200, 5, 150, 2500, 100, 64, 8, 3, 4000, 500, searches=10),
        },
        {"rtsm": {"hidden": 96}, "lstm": {}, "ensemble+mse": {"gaussian": False}},
        tested=lambda n: load_task(PUSH).take(n),
        drawn=lambda n, seed: draw_task(PUSH, seed=seed, n=n),
        random=lambda n, seed: random_data(PUSH, n, seed=seed),
        first=lambda n, seed: random_data(PUSH, n, seed=1000 * seed),
        action_dim=2,
        rms=0.1,
        muon={"rtsm": 0.01, "lstm": 0.01, "ensemble+mse": 0.01},
        augmented=symmetric,  # benchmarks/exploration/rates.py
    ),
}


def world(env: str) -> World:
    """The world of an environment; ValueError naming those that there are."""
    if env not in WORLDS:
        raise ValueError(f"no rounds are measured on {env!r:.80}; there are {', '.join(WORLDS)}")
    return WORLDS[env]


def require(env: str, word: str) -> World:
    """The world of an environment; ValueError where there is none, or a model does not explore it."""
    here = world(env)
    if word not in here.learners:
        raise ValueError(
            f"{word!r:.80} does not explore {env}; there are {', '.join(here.learners)}"
        )
    return here
