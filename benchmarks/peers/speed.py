"""Speed of mbrl-lib's PETS beside this package's models and planners: training, planning, and returns of plans.

Training: mbrl-lib's ``ModelTrainer`` and ``GaussianMLP`` (see pets.py) beside ``fit`` and an ``Ensemble``
of the same size, in transitions per second. Planning: the same targets of the frozen push task, open loop over its
steps, by mbrl-lib's ``CEMOptimizer`` through its ensemble, one target at a time, as its examples plan; by the planners
of ``tsmlib.planning`` through the shipped models, all targets at once; and both ways. All plans are executed in the
true simulator. Everything is timed in turns within one process, in CPU seconds of one thread.

    OMP_NUM_THREADS=1 build/peers/bin/python benchmarks/peers/speed.py

README.md tells how to install it. The trained network is kept in the run's folder, for the next time.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pets
import torch
from torch import Tensor
from tqdm.auto import tqdm
from tsmlib.training.precision import native_bf16

from tsmlib import study, zoo
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.features import Features
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.planners import adam, cem, expected_return
from tsmlib.planning.predictors import fresh_predictor, model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.statistics import interval
from tsmlib.storage import artifacts
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Trajectories

ENV = "tsm/ReacherPush-v1"
OURS = {"gaussian": "ensemble", "mse": "ensemble+mse"}  # as pets.MODELS
EPISODES = 500  # whose transitions the turns of training draw from
FUTURE = 20  # steps of a training window here, each of them one transition to an ensemble
ELITES, MOMENTUM = 0.1, 0.1  # of mbrl-lib's CEM: examples/conf/overrides/pets_pusher.yaml
JUDGED = 32  # samples behind a predicted return, which the planner did not see, as reproduction
SPREAD: dict[str, Callable[[np.ndarray], float]] = {
    "median": np.median,
    "lowest": np.min,
    "highest": np.max,
}

Clock = Callable[[], float]


# Training ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trainer:
    """Something that trains an ensemble. ``run(updates)`` takes as many steps of its optimiser.

    per_update: transitions that each member sees in one update. Members see different ones, and every speed here counts
    what a member sees: 1,000 transitions per second are 1,000 for each of the five.
    """

    name: str
    theirs: bool
    run: Callable[[int], None]
    per_update: int
    parameters: int


def theirs(form: str, features: Features, data: Trajectories, *, batch: int) -> Trainer:
    """mbrl-lib's trainer: a batch holds ``batch`` transitions for each member, from that member's bootstrap."""
    from mbrl.models import ModelTrainer

    model, batches = pets.initialise(form, features, data, seed=0, batch=batch)
    trainer = ModelTrainer(model, optim_lr=pets.LEARNING_RATE, weight_decay=pets.WEIGHT_DECAY)

    def run(updates: int) -> None:
        trainer.train(pets.Parts(batches, updates), num_epochs=1, evaluate=False, silent=True)

    return Trainer(f"mbrl-lib, float32, {batch} a member", True, run, batch, size(model))


def ours(form: str, features: Features, data: Trajectories, *, batch: int, bf16: bool) -> Trainer:
    """``fit`` and an ``Ensemble`` with as many layers: a batch of windows is dealt out, ``batch`` for each member."""
    windows = batch * pets.MEMBERS // FUTURE
    net = Ensemble(
        data.states.shape[2],
        data.actions.shape[2],
        angles=data.angles,
        gaussian=form == "gaussian",
        members=pets.MEMBERS,
        hidden=200,
        layers=4,
    )
    net.features.load_state_dict(features.state_dict())
    dealt_out, held_out = windows * FUTURE / pets.MEMBERS, data.take(slice(1))
    if dealt_out != batch:
        raise ValueError(
            f"{windows} windows of {FUTURE} steps are {dealt_out:g} for each member, not {batch}"
        )

    def run(updates: int) -> None:
        options = TrainingOptions(
            1, FUTURE, updates, batch_size=windows, validate_every=updates, bf16=bf16
        )
        fit(net, net.loss, data, held_out, options)

    return Trainer(
        f"tsmlib, {'bfloat16' if bf16 and native_bf16() else 'float32'}, {batch} a member",
        False,
        run,
        batch,
        size(net),
    )


def size(model: torch.nn.Module) -> int:
    return sum(weight.numel() for weight in model.parameters())


def same_size(trainers: Sequence[Trainer], *, within: float = 0.01) -> None:
    """End with an error where the networks differ in their number of parameters by more than ``within``."""
    counts = {trainer.name: trainer.parameters for trainer in trainers}
    if max(counts.values()) > (1 + within) * min(counts.values()):
        raise SystemExit(f"the networks are not equal in size: {counts}")


def speeds(
    trainers: Sequence[Trainer], clock: Clock, *, transitions: int, rounds: int
) -> dict[str, np.ndarray]:
    """Transitions per second (rounds,) of each trainer, each having taken a turn before, which is not counted.

    transitions: that every member sees in each turn.
    """
    found: dict[str, list[float]] = defaultdict(list)
    for trainer in trainers:
        trainer.run(2)
    for _ in tqdm(range(rounds), desc="training, rounds"):
        for trainer in trainers:
            updates = max(1, transitions // trainer.per_update)
            began = clock()
            trainer.run(updates)
            found[trainer.name].append(updates * trainer.per_update / (clock() - began))
    return {name: np.array(values) for name, values in found.items()}


# Planning ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Way:
    """A way to plan: who searches what, through which model.

    planner: mbrl-cem (mbrl-lib's), or cem or adam of ``tsmlib.planning``. search_space: direct or latent.
    model: pets (mbrl-lib's ensemble), or a word of ``reproduction``. samples: of the model for every candidate.
    bound: of what mbrl-cem searches, half of which is the standard deviation that it starts with.
    """

    planner: str
    search_space: str
    model: str
    iterations: int
    candidates: int = 1
    samples: int = 2
    bound: float = 0.0

    @property
    def settings(self) -> str:
        """As the table has it in the column ``configuration``."""
        return (
            f"{self.candidates} x {self.iterations} x {self.samples}"
            + f" in +-{self.bound:g}" * bool(self.bound)
        )

    @property
    def name(self) -> str:
        return f"{self.planner} {self.search_space} {self.model}, {self.settings}"

    @property
    def origin(self) -> str:
        """Whose it is: theirs, ours, or mixed."""
        return {(True, True): "theirs", (False, False): "ours"}.get(
            (self.planner == "mbrl-cem", self.model == "pets"), "mixed"
        )


PETS = partial(Way, "mbrl-cem", "direct", "pets")
USUAL = dict(
    iterations=5, candidates=350, samples=20
)  # theirs: pets_pusher.yaml, and algorithm/pets.yaml
SHIPPED = PAPERS, OURS = zoo.PAPERS, zoo.OURS
WAYS = (
    PETS(**USUAL, bound=1.0),  # the limits of the torques
    PETS(**USUAL, bound=0.2),  # a deviation of 0.1 to start with, that of the training torques
    PETS(iterations=5, candidates=350, samples=5, bound=0.2),
    PETS(iterations=5, candidates=100, samples=5, bound=0.2),
    PETS(iterations=2, candidates=100, samples=5, bound=0.2),
    *(
        Way("cem", "latent", model, iterations=8, candidates=96) for model in SHIPPED
    ),  # scale laptop; paper has 10
    *(Way("cem", "latent", model, iterations=4, candidates=48) for model in SHIPPED),
    *(Way("cem", "latent", model, iterations=2, candidates=24) for model in SHIPPED),
    Way("adam", "latent", OURS, iterations=100),
    Way("mbrl-cem", "direct", OURS, iterations=5, candidates=350, bound=0.2),
    Way("mbrl-cem", "latent", OURS, iterations=5, candidates=350, bound=2.0),
    Way("cem", "latent", "pets", iterations=8, candidates=96),
)


def search(
    objective: Callable[[Tensor], Tensor], shape: tuple[int, ...], way: Way, *, seed: int
) -> Tensor:
    """mbrl-lib's ``TrajectoryOptimizer`` for one target: the parameters ``shape`` with the best ``objective``.

    objective: parameters (C, *shape) -> returns (C,). With the settings of its examples it gives the elites' mean.
    """
    from mbrl.planning import TrajectoryOptimizer
    from omegaconf import OmegaConf

    horizon, dim = shape
    settings = OmegaConf.create(
        {
            "_target_": "mbrl.planning.CEMOptimizer",
            "num_iterations": way.iterations,
            "elite_ratio": ELITES,
            "population_size": way.candidates,
            "alpha": MOMENTUM,
            "device": "cpu",
            "lower_bound": None,
            "upper_bound": None,
            "return_mean_elites": True,
            "clipped_normal": False,
        }
    )
    limits = np.full(dim, way.bound)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # mbrl-lib draws from the global generator
        optimizer = TrajectoryOptimizer(
            settings, -limits, limits, horizon, keep_last_solution=False
        )
        return torch.from_numpy(optimizer.optimize(objective))


def stepwise(task: Task, unit: Tensor, actions: Tensor, scaled: Tensor) -> Tensor:
    """Reward (C, 1) of one step for the only target of ``task``; scaled (C, dx): the states after it, over ``unit``."""
    return task.reward((scaled * unit)[:, None, None], actions[:, None, None])[:, 0]


def through_pets(model: Any, unit: Tensor, task: Task, samples: int) -> Callable[[Tensor], Tensor]:
    """mbrl-lib's own rollouts for the only target of ``task``: actions (C, T, du) -> returns (C,)."""
    from mbrl.models import ModelEnv

    def never(actions: Tensor, scaled: Tensor) -> Tensor:
        return torch.zeros(len(scaled), 1, dtype=torch.bool)

    class Spaces:  # of an environment, which nothing here asks for
        observation_space = action_space = None

    env = ModelEnv(
        Spaces(),
        model,
        never,
        partial(stepwise, task, unit),
        generator=torch.Generator().manual_seed(0),
    )
    start = task.start[0] / unit.numpy()
    return lambda actions: env.evaluate_action_sequences(actions, start, samples)


@dataclass(frozen=True)
class Models:
    """What plans are made with. theirs: mbrl-lib's own model. known: word -> the same and ours as ``DynamicsModel``."""

    theirs: Any
    known: Mapping[str, Any]
    prior: Any

    def space(self, way: Way, horizon: int) -> SearchSpace:
        return (
            LatentActions(self.prior, horizon)
            if way.search_space == "latent"
            else DirectActions(horizon, rms=0.1)
        )


def at(task: Task, chosen: Sequence[int] | np.ndarray) -> Task:
    """The task with some of its targets."""
    return replace(task, start=task.start[chosen], target=task.target[chosen])


def planned(way: Way, task: Task, models: Models, *, seed: int = 0) -> Tensor:
    """Actions (B, T, du): by mbrl-lib one target after the other, by this package all at once."""
    space, model = models.space(way, task.horizon), models.known[way.model]
    if way.planner != "mbrl-cem":
        predict = model_predictor(model, task.past(model.past_len), samples=way.samples, seed=seed)
        if way.planner == "adam":
            return adam(predict, task.reward, space, len(task), iterations=way.iterations).actions
        options: dict[str, Any] = dict(
            candidates=way.candidates, elites=max(2, way.candidates // 10), seed=seed
        )
        return cem(
            predict, task.reward, space, len(task), iterations=way.iterations, **options
        ).actions
    found = []

    def decode(parameters: Tensor) -> Tensor:
        """(C, *shape) -> (C, T, du). What mbrl-cem searches is within its bounds, so that no torque is squashed."""
        return (
            parameters if way.search_space == "direct" else space.decode(parameters[:, None])[:, 0]
        )

    for i in range(len(task)):
        single = at(task, [i])
        if way.model == "pets":
            value = through_pets(models.theirs, model.unit, single, way.samples)
        else:
            predict = model_predictor(
                model, single.past(model.past_len), samples=way.samples, seed=seed
            )
            value = partial(_value, predict, single)
        with torch.no_grad():
            best = search(
                lambda parameters, v=value: v(decode(parameters)), space.shape, way, seed=seed + i
            )
            found.append(decode(best[None])[0])
    return torch.stack(found)


def _value(predict: Any, task: Task, actions: Tensor) -> Tensor:
    """Expected return (C,) of actions (C, T, du) for the only target of ``task``."""
    return expected_return(predict(actions[:, None]), actions[:, None], task.reward)[:, 0]


@dataclass(frozen=True)
class Outcome:
    """What came of one way to plan. seconds (rounds,): for one target; trial: the actions in the true simulator;
    predicted_return (B,): expected by the model."""

    way: Way
    seconds: np.ndarray
    trial: Trial
    predicted_return: Tensor

    @property
    def executed_return(self) -> np.ndarray:
        return self.trial.executed_return.numpy()


def outcomes(
    ways: Sequence[Way], task: Task, models: Models, clock: Clock, *, rounds: int
) -> list[Outcome]:
    """Plan and execute in every way. In each round mbrl-lib plans for its share of the targets, and ours for all."""
    shares = np.array_split(np.arange(len(task)), rounds)
    actions: dict[Way, Tensor] = {way: torch.zeros(len(task), task.horizon, 2) for way in ways}
    seconds: dict[Way, list[float]] = defaultdict(list)
    bar = tqdm(total=rounds * len(ways), desc="planning")
    for share in shares:
        for way in ways:
            bar.set_postfix_str(way.name)
            chosen = share if way.planner == "mbrl-cem" else np.arange(len(task))
            part = at(task, chosen)
            began = clock()
            found = planned(way, part, models, seed=int(chosen[0]))
            seconds[way].append((clock() - began) / len(chosen))
            actions[way][chosen] = found.detach()
            bar.update()
    bar.close()
    results = []
    for way in ways:
        model = models.known[way.model]
        predict = fresh_predictor(model, task.past(model.past_len), samples=JUDGED, seed=1)
        with torch.no_grad():
            predicted = expected_return(
                predict(actions[way][None]), actions[way][None], task.reward
            )[0]
        results.append(Outcome(way, np.array(seconds[way]), execute(task, actions[way]), predicted))
    return results


def as_good(subject: Outcome, others: Sequence[Outcome]) -> Outcome | None:
    """The fastest of ``others`` whose true return is, in the mean, at least that of ``subject``; None without any."""
    good = [
        other for other in others if other.executed_return.mean() >= subject.executed_return.mean()
    ]
    return min(good, key=lambda other: np.median(other.seconds), default=None)


def times_faster(fast: Outcome, slow: Outcome) -> np.ndarray:
    """(rounds,) how many times the seconds of ``fast`` fit into those of ``slow``, round by round."""
    return slow.seconds / fast.seconds


def compared(subject: Outcome, other: Outcome) -> tuple[float, float]:
    """True return of ``subject`` minus that of ``other``: the mean over targets, and half its 95 % t interval."""
    return interval(subject.executed_return - other.executed_return)


# Tables --------------------------------------------------------------------------------------------------------------


def spread(values: np.ndarray, digits: int = 2) -> str:
    median, lowest, highest = (of(values) for of in SPREAD.values())
    return f"{median:.{digits}f} ({lowest:.{digits}f} to {highest:.{digits}f})"


def training(
    form: str,
    features: Features,
    data: Trajectories,
    clock: Clock,
    *,
    transitions: int,
    rounds: int,
) -> list[dict[str, Any]]:
    """Print and return transitions per second, and what they are over mbrl-lib's in the same round."""
    small, large = (
        pets.BATCH,
        4 * pets.BATCH,
    )  # a quarter of the windows of reproduction, and all of them
    trainers = [
        theirs(form, features, data, batch=small),
        ours(form, features, data, batch=small, bf16=False),
        theirs(form, features, data, batch=large),
        ours(form, features, data, batch=large, bf16=False),
    ]
    if native_bf16():
        trainers.append(ours(form, features, data, batch=large, bf16=True))
    same_size(trainers)
    found = speeds(trainers, clock, transitions=transitions, rounds=rounds)
    first, *_ = trainers
    print(
        f"\ntraining, {form}: transitions per second that each of the {pets.MEMBERS} members sees; over the first"
    )
    rows = []
    for trainer in trainers:
        values = found[trainer.name]
        ratio = values / found[first.name]
        print(
            f"{trainer.name:34} {trainer.parameters:8,} parameters {spread(values, 0):>24} {spread(ratio):>22}"
        )
        about = dict(
            env=ENV,
            sim="mujoco",
            model=pets.MODELS[form] if trainer.theirs else OURS[form],
            configuration=trainer.name,
            n=rounds,
        )
        rows.append(dict(about, metric="parameters", value=trainer.parameters))
        for word, of in SPREAD.items():
            rows.append(
                dict(about, metric=f"transitions_per_second_{word}", value=of(values), unit="1/s")
            )
            rows.append(dict(about, metric=f"ratio_{word}", value=of(ratio)))
    return rows


def planning(found: Sequence[Outcome], task: Task) -> list[dict[str, Any]]:
    """Print and return seconds and returns of every way, compared with those of mbrl-lib with its own settings."""
    first, n, rows = found[0], len(task), []
    idle = execute(task, task.idle_actions()).executed_return.numpy()
    print(
        f"\nplanning, {n} targets, {task.horizon} steps: candidates x iterations x samples; idle (no torques) returns "
        f"{idle.mean():.2f}"
    )
    print(
        f"{'planner, what it searches, model':64} {'s a target':>22} {'predicted':>9} {'executed':>8} {'m at end':>8} "
        f"{'over the first':>14} {'over idle':>14} {'times faster':>22} {'ms a rollout':>12}"
    )
    for outcome in found:
        way, (gain, half), ratio = (
            outcome.way,
            compared(outcome, first),
            times_faster(outcome, first),
        )
        over_idle, idle_half = interval(outcome.executed_return - idle)
        rollout = np.median(outcome.seconds) / (way.candidates * way.iterations * way.samples)
        values = {
            "return_predicted": outcome.predicted_return.mean().item(),
            "return_true": outcome.executed_return.mean(),
            "final_distance": outcome.trial.final_distance.mean().item(),
        }
        predicted, true, distance = values.values()
        print(
            f"{way.name:64} {spread(outcome.seconds):>22} {predicted:9.2f} {true:8.2f} {distance:8.3f} "
            f"{f'{gain:+.2f} +- {half:.2f}':>14} {f'{over_idle:+.2f} +- {idle_half:.2f}':>14} {spread(ratio, 1):>22} "
            f"{1000 * rollout:12.2f}"
        )
        about = dict(
            env=ENV,
            sim="mujoco",
            task=task.name,
            model=way.model,
            planner=way.planner,
            search_space=way.search_space,
            horizon=task.horizon,
            configuration=way.settings,
        )
        gains = {
            "gain": gain,
            "gain_half": half,
            "gain_idle": over_idle,
            "gain_idle_half": idle_half,
        }
        for metric, value in {
            **values,
            **{f"return_{word}": value for word, value in gains.items()},
        }.items():
            rows.append(
                dict(
                    about, metric=metric, value=value, unit="m" * (metric == "final_distance"), n=n
                )
            )
        for word, of in SPREAD.items():
            rows.append(
                dict(about, metric=f"plan_seconds_{word}", value=of(outcome.seconds), unit="s", n=n)
            )
            rows.append(dict(about, metric=f"ratio_{word}", value=of(ratio), n=n))
    return rows


def verdicts(found: Sequence[Outcome]) -> None:
    """Print, for each of mbrl-lib's settings, the fastest of ours that returns as much, and the other way round."""
    by_origin = {
        origin: [o for o in found if o.way.origin == origin] for origin in ("theirs", "ours")
    }
    for subjects, others in (("theirs", "ours"), ("ours", "theirs")):
        print(f"\nthe fastest of {others} that returns at least as much as each of {subjects}")
        for subject in by_origin[subjects]:
            best = as_good(subject, by_origin[others])
            if best is None:
                print(f"{subject.way.name:64} none")
                continue
            gain, half = compared(best, subject)
            faster = spread(times_faster(best, subject))
            print(
                f"{subject.way.name:64} {best.way.name}: {faster} times faster, returns {gain:+.2f} +- {half:.2f} more"
            )


# The benchmark -------------------------------------------------------------------------------------------------------


def trained(
    run: runs.Run,
    form: str,
    features: Features,
    data: Trajectories,
    validation: Trajectories,
    *,
    seconds: float,
) -> Any:
    """mbrl-lib's model after ``seconds`` of CPU time: from the run's folder, else trained now and kept there."""
    path = run.folder("peers") / f"{pets.MODELS[form]}.safetensors"
    inputs = {"states": torch.from_numpy(data.states), "direct": torch.from_numpy(data.actions)}
    made_from = {"form": form, "seconds": seconds, "data": artifacts.digest(inputs)}
    if path.exists():
        weights, header = artifacts.load(path, kind="peer")
        if header["made_from"] == made_from:
            model, _ = pets.initialise(
                form, features, data, seed=0
            )  # the statistics of its inputs are not weights
            model.load_state_dict(weights)
            return model.eval()
    model, took = pets.train(form, features, data, validation, seconds=seconds, seed=0)
    artifacts.save(
        path, model.state_dict(), kind="peer", header={"made_from": made_from, "took": took}
    )
    return model


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--form", choices=pets.MODELS, default="gaussian", help="what plans (default gaussian)"
    )
    parser.add_argument(
        "--seconds", type=float, default=300, help="CPU seconds of its training (default 300)"
    )
    parser.add_argument(
        "--targets", type=int, default=10, help="of the frozen test task (default 10)"
    )
    parser.add_argument(
        "--rounds", type=int, default=2, help="each with a share of the targets (default 2)"
    )
    parser.add_argument(
        "--transitions", type=int, default=10240, help="of a turn of training (default 10240)"
    )
    parser.add_argument("--training-rounds", type=int, default=5, help="default 5")
    parser.add_argument(
        "--threads", type=int, default=1, help="default 1; with more, seconds are those of a clock"
    )
    arguments = parser.parse_args()
    if not 1 <= arguments.rounds <= arguments.targets:
        parser.error(f"{arguments.rounds} rounds share {arguments.targets} targets; each needs one")
    torch.set_num_threads(arguments.threads)
    clock = time.process_time if arguments.threads == 1 else time.perf_counter
    run = runs.resolve("peers", scale="laptop")
    data, validation = (study.dataset(run, ENV, split) for split in ("train", "validation"))
    features = Features(data.states.shape[2], data.angles).fit(torch.from_numpy(data.states))
    model = trained(run, arguments.form, features, data, validation, seconds=arguments.seconds)
    peer = pets.Peer(pets.network_of(model), features)
    pets.check(model, peer, validation)
    known = {word: study.load_or_train(run, ENV, word)[0] for word in SHIPPED}
    models = Models(model, {"pets": peer, **known}, study.load_or_train(run, ENV, "prior")[0])

    print(f"{ENV}, {arguments.threads} threads; median (lowest to highest) of the rounds")
    few, rows = data.take(slice(EPISODES)), []
    options = dict(transitions=arguments.transitions, rounds=arguments.training_rounds)
    for form in pets.MODELS:
        rows += training(form, features, few, clock, **options)
    task = study.load_task(ENV).take(arguments.targets)
    found = outcomes(WAYS, task, models, clock, rounds=arguments.rounds)
    rows += planning(found, task)
    verdicts(found)
    path = run.dir.parents[1] / "bench" / "peers.csv"
    pd.DataFrame([dict(row, seed=0) for row in rows]).to_csv(path, index=False)
    print(path)


if __name__ == "__main__":
    main()
