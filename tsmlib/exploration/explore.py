"""Exploration: a model and an action prior collect the data they learn from (section 6).

    repeat: draw tasks; plan again and again through the model and its prior (``mpc``); execute;
            append the episodes to the data; train the model and the prior further (``fine_tune``)

What the first data hold is where a model is right; plans lead elsewhere, so that data of plans are
worth more than as many random ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import cast

import torch
from torch import nn
from tqdm.auto import tqdm

from tsmlib.checks import require_callable, require_seed, require_type
from tsmlib.exploration.options import Exploration, ExplorationOptions
from tsmlib.exploration.rounds import RoundFiles
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel, as_dynamics, require_robot
from tsmlib.models.config import Configured
from tsmlib.planning.base import Judge, Plan, SearchSpace
from tsmlib.planning.closed_loop import mpc
from tsmlib.planning.execution import Trial, without_unstable
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import expected_predictor, model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.rewards import fingerprint
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json, PathLike, encode_nonfinite, writer_lock
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.fine_tune import fine_tune
from tsmlib.training.fit import Loss, TrainingOptions, fixed_windows, validate
from tsmlib.trajectory import Trajectories

Tasks = Callable[[int], Task]  # round -> the tasks of its episodes
Measure = Callable[[DynamicsModel, ActionPrior | None], Mapping[str, float]]  # named numbers
Episodes = Callable[[int], Trajectories | None]  # round -> episodes that no plan made, or none
SECONDS = ("cpu_seconds", "wall_seconds")


def explore(
    model: DynamicsModel,
    prior: ActionPrior | None,
    train: Trajectories,
    held_out: Trajectories,
    tasks: Tasks,
    options: ExplorationOptions,
    *,
    seed: int = 0,
    folder: PathLike | None = None,
    progress: str = "",
    measure: Measure | None = None,
    callback: Callback | None = None,
    augmented: Callable[[Trajectories], Trajectories] | None = None,
    episodes: Episodes | None = None,
) -> Exploration:
    """Rounds of planning, executing and learning.

    Model and prior are trained in place, on all data so far; they keep the weights that they begin
    a round with where no others do better on the held-out data.

    Args:
        model: trained on ``train``.
        prior: trained on ``train``; None searches the actions themselves.
        train: training data.
        held_out: data of the same robot.
        tasks: round k = 1, 2, ... -> its task, at least 2 starts, one episode each.
        options: the schedule.
        seed: of plans and training.
        folder: of its own, from which a loop that was stopped goes on with the same bits.
        progress: title of the progress bar; none without.
        measure: model and prior -> named numbers after every round, by names that no record has.
        callback: called with a ``Progress`` at every round.
        augmented: training data -> with their symmetric copies, say, for the model.
        episodes: round -> what is learned from in place of plans, or None for no new ones;
            ``tasks`` are then not asked.

    Returns:
        All data, and a record of every round.

    Raises:
        ValueError: model, prior, data and tasks are not of one robot.
        StoreError: ``folder`` is of another loop, or in use.
    """
    options = _checked(model, prior, train, held_out, options)
    net = cast(Configured, model)
    seed = require_seed("seed", seed)
    for name, function in (("tasks", tasks), ("measure", measure), ("callback", callback)):
        if function is not None:
            require_callable(name, function, "a function")
    folder = None if folder is None else Path(folder)
    identity = {} if folder is None else _identity(net, prior, train, held_out, options, seed)
    if augmented is not None and folder is not None:
        identity["augmented"] = artifacts.trajectories_digest(augmented(train))
    found, began = Exploration(train, held_out), time.process_time()
    with ExitStack() as stack:
        if folder is not None:
            stack.enter_context(writer_lock(folder, f"exploration, seed {seed}"))
        for k in tqdm(range(1, options.rounds + 1), desc=progress, disable=not progress):
            given = None if episodes is None else episodes(k)
            task = None if episodes is not None else _task(tasks, k, train)
            files = None
            if folder is not None:
                subject = "nothing" if given is None else artifacts.trajectories_digest(given)
                about: Json = subject if task is None else _task_identity(task)
                whole = encode_nonfinite({**identity, "learns from": about})
                files = RoundFiles(folder / f"round-{k:03d}", whole)
            new, record = given, dict[str, float]()
            if task is not None:
                new, record = _collected(k, model, prior, train, task, options, seed, files)
            found.episodes.append(new)
            steps = int(record.get("discarded_steps", 0))
            steps += int(found.records[-1]["env_steps"]) if found.records else 0
            if new is not None:
                n = min(len(new) - 1, max(1, round(options.held_out * len(new))))
                if n:
                    found.held_out = found.held_out.joined(new.take(slice(n)))
                found.train = found.train.joined(new.take(slice(n, None)))
                steps += int(new.steps.sum())
            record = {"round": k, "env_steps": steps} | record
            data = found.train if augmented is None else augmented(found.train)
            record = _trained(k, net, prior, found, data, record, options, seed, files, measure)
            found.seconds.append({name: record.pop(name) for name in SECONDS if name in record})
            found.records.append(record)
            if callback is not None:
                callback(Progress(k, time.process_time() - began, record))
    return found


def _checked(
    model: DynamicsModel,
    prior: ActionPrior | None,
    train: Trajectories,
    held_out: Trajectories,
    options: ExplorationOptions,
) -> ExplorationOptions:
    """The options as they are used; an error unless all are of one robot."""
    require_type("model", model, nn.Module, "a model of tsmlib, such as tsmlib.TSM.for_data(data)")
    require_type("prior", prior, (ActionPrior, type(None)), "an ActionPrior, or None")
    for name, data in (("train", train), ("held_out", held_out)):
        require_type(name, data, Trajectories, "tsmlib.Trajectories")
    require_type("options", options, ExplorationOptions, "tsmlib.ExplorationOptions(model=...)")
    train.robot.require_same(held_out.robot, "training and held-out data")
    for net in (model, prior):
        if net is not None:
            require_robot(net, train.robot, "what explores and its training data", but=("env",))
    options = replace(options, model=options.model.for_model(cast(nn.Module, model), train))
    if prior is not None and options.prior is not None:
        options = replace(options, prior=options.prior.for_model(prior, train))
    if not as_dynamics(model).stochastic:  # by its one rollout
        options = replace(options, judging=0, screened=1.0)
    return options


def _identity(
    model: Configured,
    prior: ActionPrior | None,
    train: Trajectories,
    held_out: Trajectories,
    options: ExplorationOptions,
    seed: int,
) -> dict[str, Json]:
    """What a loop is, by values."""
    nets = [net for net in (model, prior) if net is not None]
    weights = {f"{i}.{k}": v for i, net in enumerate(nets) for k, v in net.state_dict().items()}
    return {
        "options": asdict(options),
        "seed": seed,
        "env": train.env,
        "began with": artifacts.digest(weights)[:16],
        "configurations": [net.config() for net in nets],
        "data": [artifacts.trajectories_digest(data) for data in (train, held_out)],
    }


def _task_identity(task: Task) -> Json:
    """What a round's task is, by values."""
    start = torch.from_numpy(task.start)
    return {
        "task": task.name,
        "horizon": task.horizon,
        "tolerance": task.tolerance,
        "starts": artifacts.digest({"start": start, "target": task.target})[:16],
        "reward of chance": list(fingerprint(task.reward, start, task.horizon, task.action_dim)),
    }


def _task(tasks: Tasks, k: int, like: Trajectories) -> Task:
    """The task of round k, checked."""
    task = tasks(k)
    require_type(f"the task of round {k}", task, Task, "a tsmlib.Task")
    like.robot.require_same(task.robot, f"the data and the tasks of round {k}")
    if len(task) < 2:
        raise ValueError(
            f"round {k} has {len(task)} task; expected at least 2, since one episode is held out"
        )
    return task


def _collected(
    k: int,
    model: DynamicsModel,
    prior: ActionPrior | None,
    like: Trajectories,
    task: Task,
    options: ExplorationOptions,
    seed: int,
    files: RoundFiles | None,
) -> tuple[Trajectories | None, dict[str, float]]:
    """The episodes of round k, None where all are lost, and what is said of them."""
    if files is not None and (stored := files.episodes()) is not None:
        return stored
    began = _now()
    space: SearchSpace
    if prior is not None:
        space = LatentActions(prior, task.horizon)
    elif options.rms is not None:
        space = DirectActions(task.horizon, task.action_dim, rms=options.rms)
    else:
        space = DirectActions.for_data(like, task.horizon)
    draw = (seed * 1_000_003 + 1000 * k) % 2**31
    planner = partial(
        cem,
        candidates=options.candidates,
        elites=options.elites,
        iterations=options.iterations,
        screened=options.screened,
        seed=draw,
    )
    judge: Judge = model_predictor
    if options.judging:
        judge = partial(expected_predictor, samples=options.judging)
    run = partial(mpc, every=options.every, judge=judge, seed=draw + 1)
    stable = without_unstable(task, lambda left, _: run(left, model, space, planner))
    record = _means(task, stable.found)
    record |= {"lost": stable.lost, "discarded_steps": stable.discarded_steps} | _since(began)
    if stable.found is None:
        return None, record
    episodes = cast(Trajectories, stable.found.seen)  # of mpc, there always
    if files is not None:
        files.keep_episodes(episodes, record)
    return episodes, record


def _trained(
    k: int,
    model: Configured,
    prior: ActionPrior | None,
    found: Exploration,
    augmented: Trajectories,
    record: dict[str, float],
    options: ExplorationOptions,
    seed: int,
    files: RoundFiles | None,
    measure: Measure | None,
) -> dict[str, float]:
    """The record of round k with what training gave; the nets trained, or loaded."""
    if files is not None and (stored := files.models(model, prior)) is not None:
        return stored
    began, parts = _now(), list[tuple[str, Configured, Trajectories, TrainingOptions]]()
    if prior is not None and options.prior is not None:
        parts.append(("prior_validation", prior, found.train, options.prior))
    parts.append(("validation", model, augmented, options.model))
    for name, part, data, training in parts:
        loss = cast(Loss, part.loss)
        checkpoint = None if files is None else files.folder / f"{name}.checkpoint"
        fine_tune(
            part,
            data,
            found.held_out,
            training,
            loss,
            seed=seed + k,
            checkpoint=checkpoint,
            progress=False,
        )
        lengths = cast(int, training.past_len), cast(int, training.future_len)  # by _checked
        windows = fixed_windows(found.held_out, *lengths)
        record[name] = validate(loss, windows, seed + k)
    record |= {name: record.get(name, 0.0) + spent for name, spent in _since(began).items()}
    if measure is not None:
        measured = measure(cast(DynamicsModel, model), prior)
        if taken := sorted(record.keys() & measured):
            raise ValueError(
                f"measure gave {', '.join(map(repr, taken))}, which the record of a round has of "
                f"its own episodes; return it by another name, such as 'tested_{taken[0]}'"
            )
        record |= measured
    if files is not None:
        files.keep_models(model, prior, record)
    return record


def _now() -> tuple[float, float]:
    """Of this process and on the wall, in the order of SECONDS."""
    return time.process_time(), time.perf_counter()


def _since(began: tuple[float, float]) -> dict[str, float]:
    return {name: now - then for name, now, then in zip(SECONDS, _now(), began, strict=True)}


def _means(task: Task, trial: Trial | None) -> dict[str, float]:
    """Means over the episodes of a trial; NaN by the same names where all were lost."""
    if trial is None:
        still = torch.from_numpy(task.start)[:, None].expand(-1, task.horizon + 1, -1)
        (distance, success), nothing = task.judged(still), torch.full((1,), math.nan)
        values = {"executed_return": nothing, "predicted_return": nothing, "gap": nothing}
    else:
        distance, success, plan = trial.final_distance, trial.success, cast(Plan, trial.plan)
        values = {"executed_return": trial.executed_return}
        values |= {"predicted_return": plan.predicted_return, "gap": trial.gap.abs()}
    if success is not None:
        values["success"] = success.float()
    if not distance.isnan().any():
        values["final_distance"] = distance
    return {k: math.nan if trial is None else float(v.mean()) for k, v in values.items()}
