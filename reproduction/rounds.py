"""Rounds of exploration on Gymnasium's pendulum and on the pushing arm: what 10_explore measures.

A learner is a model, with an action prior if it plans over codes. Beside the loop (``explore``) stand the same learner
on as many random episodes, and on no new ones, trained as often. What differs between the two robots is a ``World``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import numpy as np
import torch

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.data import contact_counts, shares
from tsmlib.exploration import BY_MODE, SECONDS, Exploration, Measure, Trainable, explore
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel, as_dynamics, members
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.base import Judge, Planner, SearchSpace
from tsmlib.planning.execution import Stable, Trial, execute, mpc, without_unstable
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import expected_predictor, model_predictor, simulator_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.rewards import BLOCK, TIP
from tsmlib.storage import files
from tsmlib.storage.files import Json, decode_nonfinite, encode_nonfinite
from tsmlib import zoo
from reproduction.results import exploration as results
from reproduction.results.exploration import (
    FIRST_PRIOR,
    HORIZON,
    LAST_PRIOR,
    PENDULUM,
    PLANNED,
    PUSH,
    RANDOM,
)
from reproduction.results.table import Row
from reproduction.runs import Run
from reproduction.worlds import Sizes, require, world
from tsmlib.training.fit import fit
from tsmlib.trajectory import Trajectories

WITHOUT_PRIOR = ("ensemble+mse",)  # as PETS plans
TESTED = "tested_"  # before the names of what is measured after a round, in its record
SEARCHED = 25  # starts of the searches in which two priors are compared, at most
T = TypeVar("T")


def tasks(episodes: int, seed: int) -> Callable[[int], Task]:
    """Round -> its starts."""
    return lambda k: pendulum.swing_up(episodes, seed=round_seed(seed, k))


def divided(data: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training and held-out episodes, one in five."""
    n = max(1, len(data) // 5)
    return data.take(slice(n, None)), data.take(slice(n))


def of_pushes(data: Trajectories) -> dict[str, float]:
    """Of pushes, ``results.EPISODES``: share of the episodes in which arm and object meet, mean number of contacts, and
    root mean square of the torques."""
    return {
        "contact_share": shares(data.states, data.env)["contact_share"],
        "contacts_per_episode": float(contact_counts(data.states, data.env).mean()),
        "torque_rms": float(np.sqrt(np.square(data.actions, dtype=np.float64).mean())),
    }


def torques_of(prior: ActionPrior, n: int = 256) -> float:
    """Root mean square of the torques that ``n`` random codes give."""
    space = LatentActions(prior, HORIZON)
    with torch.no_grad():
        actions = space.decode(space.noise(1, n, torch.Generator().manual_seed(0)))
    return float(actions.square().mean().sqrt())


def places(seen: Mapping[str, Trajectories]) -> dict[str, np.ndarray]:
    """Where fingertip and object are (m) in as many episodes of each as all have: title -> (states, 2)."""
    n = min(map(len, seen.values()))
    return {
        f"{body}: {title}": data.states[:n, :, where].reshape(-1, 2)
        for body, where in (("fingertip", TIP), ("object", BLOCK))
        for title, data in seen.items()
    }


def search(prior: ActionPrior, sizes: Sizes, seed: int, env: str) -> list[float]:
    """Return of the best plan so far after each iteration of a search in codes of the prior; mean over starts.

    The true simulator judges, the one model that favours no prior: a learned one is right where the episodes of one of
    them were, and a search also finds its errors. So predicted return is executed return.
    """
    task = world(env).tested(min(sizes.starts, SEARCHED))
    plan = planner(replace(sizes, iterations=sizes.searches), seed)(
        simulator_predictor(task, task.start), task.reward, space_of(prior, env), len(task)
    )
    return [float(value) for value in plan.curve.mean(1)]


def planner(sizes: Sizes, seed: int) -> Planner:
    """The cross-entropy method with the budget of a loop."""
    return partial(
        cem,
        candidates=sizes.candidates,
        elites=sizes.elites,
        iterations=sizes.iterations,
        screened=sizes.screened,
        seed=seed,
    )


class Trials(NamedTuple):
    """Episodes of one task: planned for again every few steps, and the first of these plans executed open loop.

    first: of those episodes of ``closed`` whose simulation stays stable open loop, too.
    """

    closed: Trial
    first: Stable[Trial]


def planned(
    task: Task,
    model: DynamicsModel,
    prior: ActionPrior | None,
    sizes: Sizes,
    seed: int,
    env: str = PENDULUM,
) -> Stable[Trials]:
    """Plans with the budget of a loop and their execution, of those episodes whose closed loop stays stable.

    Where one is dropped, the others are planned for anew, with other random numbers. The planner draws with ``seed``,
    samples behind predicted returns with 1000 (seed + 1) and the 200 after it, judges with those times their number;
    none of these coincide (``fresh_predictor``).
    """
    sizes, space = sizes.judged_for(model), space_of(prior, env)
    judge: Judge = (
        partial(expected_predictor, samples=sizes.judging) if sizes.judging else model_predictor
    )
    drawn = 1000 * (seed + 1)

    def run(left: Task, _: list[int]) -> Trials:
        predict = judge(model, left.past(as_dynamics(model).past_len), seed=drawn)
        plan = planner(sizes, seed)(predict, left.reward, space, len(left))
        closed = mpc(
            left,
            model,
            space,
            planner(sizes, seed),
            every=sizes.every,
            plan=plan,
            judge=judge,
            seed=drawn,
        )
        return Trials(
            closed, without_unstable(left, lambda some, kept: execute(some, plan.actions[kept]))
        )

    return without_unstable(task, run)


def measure(sizes: Sizes, seed: int, env: str = PENDULUM) -> Measure:
    """Plans from the same starts after every round; of the pendulum, how high random codes of the prior swing it.

    Both gaps are of the first plan of an episode: its predicted return minus what planning again returns, and minus
    what it returns itself, open loop. An episode whose simulation becomes unstable as it is planned for again has
    failed and is counted (``lost``); it has no return. Means of return, gap and distance are over the episodes that
    ended; dropping a start changes the draws of the others (``planned``). The open-loop gap is a mean over those of
    them whose first plan stays stable.
    """
    task = world(env).tested(sizes.starts)

    def measured(model: DynamicsModel, prior: ActionPrior | None) -> dict[str, float]:
        stable = planned(task, model, prior, sizes, seed, env)
        found = {"lost": float(stable.lost), "success": 0.0}
        if stable.found is not None:
            trial, first = stable.found
            assert trial.success is not None
            assert trial.plan is not None
            found |= {
                "return_true": float(trial.executed_return.mean()),
                "gap_absolute": float(trial.gap.abs().mean()),
                "success": float(trial.success.float().mean()) * len(stable.kept) / len(task),
            }
            if first.found is not None:
                predicted = trial.plan.predicted_return[first.kept]
                found["gap_open_loop"] = float(
                    (predicted - first.found.executed_return).abs().mean()
                )
            if task.position is not None:
                found["final_distance"] = float(trial.final_distance.mean())
        if prior is not None and env == PENDULUM:
            found["highest"] = pendulum.highest(pendulum.walks(prior, max(8, sizes.starts)))
        return found

    return measured


def tested(measured: Measure) -> Measure:
    """The same by names that no record of ``explore`` has of a round's own episodes."""
    return lambda model, prior: {
        f"{TESTED}{name}": value for name, value in measured(model, prior).items()
    }


def tested_records(found: Exploration) -> list[dict[str, float]]:
    """Of each round its number, its steps, its seconds and what was ``tested``, for ``results.round_rows``. ValueError
    for rounds that were measured by other names."""
    records = []
    for record, seconds in zip(found.records, found.seconds, strict=True):
        own = {
            name.removeprefix(TESTED): value
            for name, value in record.items()
            if name.startswith(TESTED)
        }
        if not own:
            raise ValueError(
                f"the record of round {record['round']:.0f} has {', '.join(record)}, and nothing named {TESTED}...; "
                "pass measure=tested(...) to explore, or delete the folder of a loop of an earlier version"
            )
        records.append(
            {"round": record["round"], "env_steps": record["env_steps"], **own, **seconds}
        )
    return records


def space_of(prior: ActionPrior | None, env: str = PENDULUM) -> SearchSpace:
    """Codes of the prior, or torques where there is none."""
    here = world(env)
    return (
        DirectActions(HORIZON, here.action_dim, rms=here.rms)
        if prior is None
        else LatentActions(prior, HORIZON)
    )


class Loop(NamedTuple):
    """What a loop leaves: rows, and the episodes of each round, the random ones first; None: it had no new ones.

    seconds: rows of what each round took, the only ones that another run of the same loop has not again. priors: before
    round 1 and after the last; None of a learner without one.
    """

    rows: list[Row]
    episodes: list[Trajectories | None]
    seconds: Sequence[Row] = ()
    priors: tuple[ActionPrior, ActionPrior] | None = None


class Learner(NamedTuple):
    """A model and its prior, trained on random episodes."""

    model: Trainable
    prior: ActionPrior | None
    train: Trajectories
    held_out: Trajectories


def learner(
    word: str,
    sizes: Sizes,
    seed: int,
    env: str = PENDULUM,
    folder: Path | None = None,
    *,
    muon: float,
) -> Learner:
    """One of a world's learners as a loop begins; a training that was stopped goes on from ``folder``.

    muon: rate of Muon; 0: Adam for all.
    """
    here = require(env, word)
    train, held_out = divided(here.first(sizes.first, seed))
    made_for = cast(type[RecurrentTSM], zoo.find(word).load())  # what is used here of one, all have
    model = made_for.for_data(train, seed=seed, **here.learners[word])
    prior = None if word in WITHOUT_PRIOR else ActionPrior.for_data(train, seed=seed, channels=16)
    kept = {
        name: None if folder is None else folder / f"{name}.checkpoint"
        for name in ("prior", "model")
    }
    if prior is not None:
        how = sizes.training(10, 10, updates=sizes.prior)
        fit(prior, prior.loss, train, held_out, how, seed=seed, checkpoint=kept["prior"])
    how = sizes.training(model.past_len, 20, updates=sizes.before, muon=muon)
    data = train if here.augmented is None else here.augmented(train)
    fit(model, model.loss, data, held_out, how, seed=seed, checkpoint=kept["model"])
    return Learner(model, prior, train, held_out)


def loop(
    run: Run,
    word: str,
    *,
    env: str = PENDULUM,
    data: str = PLANNED,
    sizes: Sizes | None = None,
    folder: Path | None = None,
) -> Loop:
    """A learner's rounds, round 0 before them.

    data: its own plans, or one of the other ``results.DATA`` in their place. sizes: by default the world's at the run's
    scale. Given a ``folder``, a loop that was killed goes on from there with the same bits, and loops of the same
    learner on other data begin with what was trained and measured before round 1.
    """
    if data not in results.DATA:
        raise ValueError(f"data is {data!r:.80}; expected one of {', '.join(results.DATA)}")
    here, seed = world(env), run.seed
    sizes = sizes or here.sizes[run.scale]
    own = (
        None
        if folder is None
        else folder / (env if env == PENDULUM else EnvSpec.parse(env).name) / word
    )
    muon = here.muon.get(word, 0.0)
    model, prior, train, held_out = learner(word, sizes, seed, env, own, muon=muon)
    sizes = sizes.judged_for(model)
    measured, began = measure(sizes, seed, env), len(train) + len(held_out)
    options = sizes.options(model.past_len, muon=muon, rms=here.rms)

    def new(k: int) -> Trajectories | None:
        return here.random(sizes.episodes, round_seed(seed, k)) if data == RANDOM else None

    made_from: dict[str, Json] = {"sizes": asdict(sizes), "seed": seed, "muon": muon}
    slug, curves = data.replace(" ", "-"), dict[str, list[float]]()
    zero = _once(own and own / "round-0.json", made_from, lambda: dict(measured(model, prior)))
    if prior and sizes.searches:
        curves[FIRST_PRIOR] = _once(
            own and own / "prior-0.json", made_from, lambda: search(prior, sizes, seed, env)
        )
    torques, first = {FIRST_PRIOR: torques_of(prior)} if prior else {}, copy.deepcopy(prior)
    found = explore(
        model,
        prior,
        train,
        held_out,
        lambda k: here.drawn(sizes.episodes, round_seed(seed, k)),
        options if prior else replace(options, prior=None),
        seed=seed
        if data == PLANNED
        else 1000 * seed,  # of the planner and of updates; of seed 0 the same for all data
        progress=f"{env} {word}: {data}",
        measure=tested(measured),
        augmented=here.augmented,
        episodes=None if data == PLANNED else new,
        folder=own and own / slug,
    )
    records = [{"round": 0, "env_steps": 0, **zero}, *tested_records(found)]
    rows_of = partial(
        results.round_rows,
        run,
        word,
        n=sizes.starts,
        first=began * HORIZON,
        env=env,
        data=data,
        space="direct" if prior is None else "latent",
        samples=sizes.judging if members(model) == 1 else 0,
    )
    measured_rows = rows_of(records)
    rows = [row for row in measured_rows if row["metric"] not in SECONDS]
    seconds = [row for row in measured_rows if row["metric"] in SECONDS]
    episodes = [train.joined(held_out), *found.episodes]
    if env == PUSH:
        counted = [
            (k, len(each), of_pushes(each)) for k, each in enumerate(episodes) if each is not None
        ]
        rows += results.episode_rows(run, word, counted, env=env, data=data)
    if prior and sizes.searches:
        last = own and own / f"{slug}.prior.json"
        curves[LAST_PRIOR] = _once(last, made_from, lambda: search(prior, sizes, seed, env))
        n, steps = min(sizes.starts, SEARCHED), began * HORIZON + int(records[-1]["env_steps"])
        torques[LAST_PRIOR] = torques_of(prior)
        rows += results.prior_rows(
            run, word, curves, n, torques=torques, env_steps=steps, env=env, data=data
        )
    return Loop(rows, episodes, seconds, (first, prior) if first and prior else None)


def round_seed(seed: int, k: int) -> int:
    """The seed of the tasks, or of the random episodes, of round k."""
    return 100_000 * (seed + 1) + 1000 * k


def _once(path: Path | None, made_from: dict[str, Json], make: Callable[[], T]) -> T:
    """What ``make`` gives, kept in a file: the same the next time, if it was made from the same."""
    if path is None:
        return make()
    if path.exists():
        kept = cast(dict[str, Json], files.loads(path.read_bytes()))
        was = cast(dict[str, Json], kept["made from"])
        if was | {"sizes": {**BY_MODE, **cast(dict[str, Json], was["sizes"])}} == made_from:
            return cast(T, decode_nonfinite(kept["found"]))
    found = make()
    kept = {"made from": made_from, "found": encode_nonfinite(cast(Json, found))}
    files.write_bytes(path, files.dumps(path, kept).encode())
    return found
