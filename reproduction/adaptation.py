"""Few-shot adaptation: shipped models of the standard arm on a changed one, beside models of its episodes alone.

A way is what is done with ``n`` episodes of the changed arm: ``zero-shot`` nothing, ``all``, ``head`` and ``codes``
fine-tuning of that part, ``scratch`` a new model trained on them. A fifth of the episodes, at least one, is held out to
choose among validations; of the pushing arm the others are trained on with their symmetric copies, as the shipped
models were on theirs. The numbers of updates of a model are the same whatever the arm and the episodes.

What they are held against is the ``reference``: a model trained on the changed arm as the shipped one was on its own,
by as many episodes and updates.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Literal, NamedTuple, cast

from tsmlib.envs import variant
from tsmlib.envs.physics import Changes
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.symmetry import symmetric
from tsmlib.evaluation.prediction import Scores, score
from tsmlib.fine_tuning import Part, fine_tune
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel, as_dynamics
from tsmlib.models.features import Features
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.planners import cem, reevaluate
from tsmlib.planning.predictors import JUDGING, expected_predictor, fresh_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib import zoo
from reproduction.data import HELD_OUT_SEED, random_data, sizes
from reproduction.models import TrainedModel, load_or_train, load_pretrained
from reproduction.results import adaptation as results
from reproduction.results.table import Row
from reproduction.runs import Run
from reproduction.tasks import load_task
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Trajectories

Way = Literal["zero-shot", "all", "head", "codes", "scratch"]
WAYS: tuple[Way, ...] = ("zero-shot", "all", "head", "codes", "scratch")
Reference = Literal["reference"]
REFERENCE: Reference = results.REFERENCE
PLAN_ITERATIONS = 5  # of the cross-entropy method
SEEN, AHEAD, SAMPLES = (
    10,
    (10, 80),
    32,
)  # steps observed before a prediction; predicted; samples of each
FEATURES_OF = "lstm"  # the shipped model in whose units all models of an arm are scored
EPISODES = (5, 20, 80)  # of the changed arm
VARIANTS: Mapping[
    str, Changes
] = {  # of an arm; those of the mass only where there is something to push
    "standard": {},
    "mass0.5": {"mass": 0.5},
    "mass2": {"mass": 2.0},
    "damping0.5": {"damping": 0.5},
    "damping2": {"damping": 2.0},
    "links0.12x0.11": {"link_lengths": (0.12, 0.11)},
    "gain0.7": {"torque_gain": 0.7},
}
FEW_SEED = 2_000_000  # of the few episodes, which no shipped model has seen


class TuningBudget(NamedTuple):
    """Updates of a fine-tuning and of a training from scratch, and peak learning rates of each way.

    The rates are the best by held-out episodes of the pushing arm with 70 % of its torque (`benchmarks/settings`,
    section 12).
    """

    tuning: int
    scratch: int
    lr: Mapping[Part, float]


BUDGETS: Mapping[str, TuningBudget] = {
    "rtsm": TuningBudget(120, 300, {"all": 1e-3, "head": 1e-3, "codes": 0.1}),
    "lstm": TuningBudget(300, 800, {"all": 1e-3, "head": 1e-2}),
    "ensemble+mse": TuningBudget(300, 800, {"all": 3e-4, "head": 1e-3}),
}


class Adapted(NamedTuple):
    """A model of a changed arm, the episodes of that arm that it knows, and the CPU seconds of its training.

    seconds: None where they are of several models together.
    """

    model: TrainedModel
    episodes: int
    seconds: float | None


def ways(word: str) -> tuple[Way, ...]:
    """The ways of a model: without codes there are none to fit."""
    return tuple(way for way in WAYS if way in ("zero-shot", "scratch") or way in BUDGETS[word].lr)


def changed(arm: str, word: str) -> str:
    """An arm as one of VARIANTS; ValueError naming those that there are, and where it has nothing to change."""
    if word not in VARIANTS:
        raise ValueError(f"no variant is called {word!r:.80}; there are {', '.join(VARIANTS)}")
    return variant(arm, **VARIANTS[word])


def require(env: str, word: str) -> None:
    """ValueError where a model is not adapted, or none of the standard arm ships; naming those that there are."""
    if word not in BUDGETS:
        raise ValueError(f"{word!r:.80} is not adapted; there are {', '.join(BUDGETS)}")
    load_pretrained(word, env=EnvSpec.parse(env).standard.id)


def few(env: str, n: int, *, seed: int = 0) -> tuple[Trajectories, Trajectories]:
    """Training and validation data among ``n`` episodes of an arm."""
    data, held = random_data(env, n, seed=FEW_SEED + seed), max(1, n // 5)
    return data.take(slice(held, None)), data.take(slice(held))


def adapted(
    word: str,
    env: str,
    way: Way,
    data: tuple[Trajectories, Trajectories] | None,
    *,
    seed: int = 0,
    share: float = 1.0,
) -> tuple[TrainedModel, float]:
    """A model of ``env`` by one of WAYS, and the CPU seconds of its training. share: of the updates."""
    if way == "zero-shot":
        return load_pretrained(word, env=EnvSpec.parse(env).standard.id), 0.0
    if data is None:
        raise ValueError(
            f"a model of {env} by the way {way!r} needs episodes; only zero-shot takes none"
        )
    (train, validation), began, title = data, time.process_time(), f"{env} {word}: {way}"
    train = symmetric(train)  # as study.models.training_data
    if way == "scratch":
        spec = zoo.find(word)
        arguments = spec.arguments(EnvSpec.parse(env))
        net = cast(type[RecurrentTSM], spec.load()).for_data(train, seed=seed, **arguments)
        fit(
            net,
            net.loss,
            train,
            validation,
            options(net, word, way, share),
            seed=seed,
            progress=title,
        )
    else:
        net = cast(RecurrentTSM, load_pretrained(word, env=EnvSpec.parse(env).standard.id))
        how = options(net, word, way, share)
        fine_tune(net, net.loss, train, validation, how, part=way, seed=seed, progress=title)
    return net, time.process_time() - began


def options(net: DynamicsModel, word: str, way: Way, share: float = 1.0) -> TrainingOptions:
    """How a model is trained by a way. share: of the updates."""
    budget = BUDGETS[word]
    steps = max(2, round(share * (budget.scratch if way == "scratch" else budget.tuning)))
    lr, muon = (
        (2e-3, 0.02) if way in ("scratch", "zero-shot") else (budget.lr[cast(Part, way)], 0.0)
    )
    every = max(1, steps // 10)
    return TrainingOptions(
        net.past_len, 20, steps, batch_size=64, lr=lr, muon=muon, warmup=10, validate_every=every
    )


def held_out(env: str, n_test: int) -> tuple[Trajectories, Trajectories]:
    """Test episodes, and half as many validation episodes, to which the noise of the scores is fitted."""
    return (
        random_data(env, n_test, seed=HELD_OUT_SEED["test"]),
        random_data(env, max(2, n_test // 2), seed=HELD_OUT_SEED["validation"]),
    )


def scored(
    model: TrainedModel, env: str, data: tuple[Trajectories, Trajectories], *, seed: int = 0
) -> Scores:
    """Scores on ``held_out`` data, in units of the standard arm's data."""
    units = units_of(env)
    return score(
        model, units, *data, samples=SAMPLES, horizon=max(AHEAD), starts=(SEEN,), seed=seed
    )


def units_of(env: str) -> Features:
    """Features of the standard arm's shipped model."""
    return load_pretrained(FEATURES_OF, env=EnvSpec.parse(env).standard.id).features


def made(
    run: Run, word: str, env: str, *, way: Way | Reference, episodes: int, share: float = 1.0
) -> Adapted:
    """A model of ``env`` by a way. A reference has the scale's episodes and updates."""
    if way == REFERENCE:
        found = load_or_train(run, env, word)
        seconds = None if "copies" in found.header else found.header["seconds"]
        return Adapted(found.model, sizes(run, env)["train"], seconds)
    net, spent = adapted(
        word, env, way, few(env, episodes, seed=run.seed), seed=run.seed, share=share
    )
    return Adapted(net, 0 if way == "zero-shot" else episodes, spent)


def score_rows(
    run: Run, word: str, env: str, way: Way | Reference, found: Adapted, *, n_test: int
) -> list[Row]:
    """Rows of what a model of ``env`` predicts, on so many test episodes."""
    scores = scored(found.model, env, held_out(env, n_test), seed=run.seed)
    return results.adapted_rows(
        run, env, word, way, scores, episodes=found.episodes, ahead=AHEAD, seconds=found.seconds
    )


def planned(run: Run, model: TrainedModel, env: str, n_targets: int) -> Trial:
    """Plans to the first test targets of an arm, over codes of the standard arm's prior, executed open loop.

    Candidates are judged by the mode and ``JUDGING`` samples, of an ensemble by its members, of a model without samples
    by its one rollout; the return is predicted from samples that neither planner nor judges drew.
    """
    task, candidates = load_task(env).take(n_targets), plans.CANDIDATES[run.scale]
    space = LatentActions(cast(ActionPrior, load_pretrained("prior", env=env)), task.horizon)
    past, drawn = (
        task.past(model.past_len),
        1000 + run.seed,
    )  # not the planner's; of the judges JUDGING times that
    predict = expected_predictor(model, past, seed=drawn)
    plan = cem(
        predict,
        task.reward,
        space,
        len(task),
        candidates=candidates,
        elites=max(2, candidates // 10),
        iterations=PLAN_ITERATIONS,
        screened=plans.SCREENED,
        seed=run.seed,
    )
    return execute(task, reevaluate(plan, fresh_predictor(model, past, seed=drawn), task.reward))


def plan_rows(
    run: Run, word: str, env: str, way: Way | Reference, found: Adapted, *, n_targets: int
) -> list[Row]:
    """Rows of what a model of ``env`` plans, to so many targets."""
    trial, samples = (
        planned(run, found.model, env, n_targets),
        JUDGING * as_dynamics(found.model).stochastic,
    )
    return results.planned_rows(
        run, env, word, way, trial, episodes=found.episodes, samples=samples
    )
