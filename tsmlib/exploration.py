"""Exploration: a model and an action prior that collect the data they learn from (section 6, future work).

    repeat: draw tasks; plan again and again through the model and its prior (``mpc``); execute;
            append the episodes to the data; go on training the model and the prior (``fine_tune``)

What the first data hold is where a model is right; plans lead elsewhere, so that data of plans are worth more than as
many random ones.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any, Protocol, cast

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel, as_dynamics, require_robot
from tsmlib.planning.base import Judge, Plan, Planner, Predictor, SearchSpace
from tsmlib.planning.execution import Trial, mpc, without_unstable
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import JUDGING, expected_predictor, model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward, rewarded
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json, StoreError, decode_nonfinite, encode_nonfinite, writer_lock
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.fine_tune import fine_tune
from tsmlib.training.fit import Loss, TrainingOptions, fixed_windows, validate
from tsmlib.trajectory import Trajectories


class Trainable(DynamicsModel, Protocol):
    """A dynamics model of this package: an ``nn.Module`` with a loss and the arguments that it was made with."""

    @property
    def loss(self) -> Loss: ...
    def config(self) -> dict[str, Json]: ...
    def state_dict(self) -> dict[str, Tensor]: ...


Tasks = Callable[[int], Task]  # round -> the tasks of its episodes
Measure = Callable[[DynamicsModel, ActionPrior | None], Mapping[str, float]]  # named numbers
Episodes = Callable[[int], Trajectories | None]  # round -> episodes that no plan made, or none
SECONDS = ("cpu_seconds", "wall_seconds")
BY_MODE: Mapping[str, Json] = {
    "judging": 0,
    "screened": 1.0,
}  # as all plans were judged before there was a choice


@dataclass(frozen=True)
class ExplorationOptions:
    """Schedule of ``explore``.

    model, prior: one round's training of each, from the weights it has; prior=None leaves it as it is. every,
    candidates, elites, iterations, screened: of the planning (``mpc``, ``cem``). judging: samples by which candidates
    are judged beside the mode (``expected_predictor``); 0: by the mode alone. held_out: share of each round's episodes
    that join the held-out data: at least one and never all, but none of a single one, which is trained on.
    rms: of the torques that are searched where there is no prior. noise: standard deviation of what is added to the
    parameters of every plan, in those of the search space.
    bonus: reward for each step per unit of disagreement, the standard deviation over ``samples`` predicted states, as a
    share of the data's, mean over dimensions; 0: none. With a bonus these samples judge, all candidates, and without
    the mode.
    """

    model: TrainingOptions
    prior: TrainingOptions | None = None
    rounds: int = 5
    every: int = 10
    candidates: int = 96
    elites: int = 9
    iterations: int = 4
    held_out: float = 0.1
    rms: float = 0.1
    noise: float = 0.0
    bonus: float = 0.0
    samples: int = 4
    judging: int = JUDGING
    screened: float = 0.25

    def __post_init__(self) -> None:
        least = {
            "rounds": 1,
            "every": 1,
            "candidates": 2,
            "elites": 1,
            "iterations": 1,
            "samples": 2,
            "judging": 0,
        }
        for name, low in least.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
                raise ValueError(
                    f"{name} is {value!r:.80}; expected a whole number of at least {low}"
                )
        if self.elites > self.candidates:
            raise ValueError(
                f"elites is {self.elites}, of {self.candidates} candidates; expected no more than these"
            )
        if not 0 < self.rms < math.inf:
            raise ValueError(
                f"rms is {self.rms}, expected the size of the torques to search, above zero"
            )
        for name in ("noise", "bonus"):
            if not 0 <= (value := getattr(self, name)) < math.inf:
                raise ValueError(f"{name} is {value}; expected a finite number, zero or above")
        if not 0 < self.held_out < 1:
            raise ValueError(f"held_out is {self.held_out}; expected a share between 0 and 1")
        if not 0 <= self.screened <= 1:
            raise ValueError(f"screened is {self.screened}; expected a share from 0 to 1")


@dataclass
class Exploration:
    """What ``explore`` leaves: all data, the episodes of each round (None: it had no new ones), and its record.

    records: ``round``; ``env_steps`` executed up to and with it; ``executed_return`` and, by the task's measures,
    ``success`` and ``final_distance``, means over its episodes; without a bonus ``predicted_return`` and the mean size
    of the ``gap``; ``lost``, episodes in which the simulation became unstable, whereupon the others begin anew
    (``discarded_steps``, what all had executed until then, which ``env_steps`` counts); after training the losses on
    held-out data, ``validation`` and ``prior_validation``, and what ``measure`` gave, by names of its own. Of a round
    that lost all its episodes the means are NaN.
    seconds: of each round, to plan, execute and train, without ``measure``: ``cpu_seconds`` and ``wall_seconds``; of a
    training that was stopped what was spent on it since. Rounds from a folder that has no seconds have none.
    """

    train: Trajectories
    held_out: Trajectories
    records: list[dict[str, float]] = field(default_factory=list)
    episodes: list[Trajectories | None] = field(default_factory=list)
    seconds: list[dict[str, float]] = field(default_factory=list)


def explore(
    model: Trainable,
    prior: ActionPrior | None,
    train: Trajectories,
    held_out: Trajectories,
    tasks: Tasks,
    options: ExplorationOptions,
    *,
    seed: int = 0,
    folder: Path | None = None,  # of its own
    progress: str = "",
    measure: Measure
    | None = None,  # of model and prior, after every round, by names that no record has
    callback: Callback | None = None,  # at every round
    augmented: Callable[[Trajectories], Trajectories]
    | None = None,  # of what the model is trained on
    episodes: Episodes | None = None,  # in place of plans, to compare with
) -> Exploration:
    """Rounds of planning, executing and learning, by a ``model`` and a ``prior`` that were trained on ``train``.

    Both go on being trained, in place, on all data so far, and keep the weights that they begin a round with where no
    others do better on the held-out data. prior=None: the actions themselves are searched. tasks(k):
    those of round k = 1, 2, ..., one episode each. Given a ``folder``, a loop that was killed goes on from there with
    the same bits; StoreError for the folder of another loop. ValueError for a model, a prior or tasks of another robot
    than the data's, windows with another past than the model's, and a bonus where the model has no samples;
    TrajectoryError for held-out data of another robot.

    augmented: training data -> with their symmetric copies, say; held-out data stay as they are. episodes: what is
    learned from in each round where nothing is planned, or None for what is there already; ``tasks`` are not asked.
    """
    _require_robot(model, prior, train, held_out)
    options = replace(options, model=options.model.for_model(cast(nn.Module, model), train))
    if prior is not None and options.prior is not None:
        options = replace(options, prior=options.prior.for_model(prior, train))
    if options.bonus and not as_dynamics(model).stochastic:
        raise ValueError(
            f"bonus is {options.bonus:g}, but {type(model).__name__} is deterministic: its samples do not disagree. "
            "Take bonus=0, or an ensemble or a segment model"
        )
    if (
        options.bonus or not as_dynamics(model).stochastic
    ):  # by the bonus's samples, or by the one rollout
        options = replace(options, judging=0, screened=1.0)
    weights = model.state_dict() | (
        {} if prior is None else {f"prior.{k}": v for k, v in prior.state_dict().items()}
    )
    identity: dict[str, Json] = {
        "options": asdict(options),
        "seed": seed,
        "env": train.env,
        "began with": artifacts.digest(weights)[:16],
        "configurations": [net.config() for net in (model, prior) if net is not None],
        "data": [artifacts.trajectories_digest(data) for data in (train, held_out)],
        "episodes": "planned" if episodes is None else "given",
    }
    found, began = Exploration(train, held_out), time.process_time()
    with ExitStack() as stack:
        if folder is not None:
            stack.enter_context(writer_lock(folder, f"exploration, seed {seed}"))
        for k in tqdm(range(1, options.rounds + 1), desc=progress, disable=not progress):
            place = (
                None
                if folder is None
                else _Round(folder / f"round-{k:03d}", encode_nonfinite(identity))
            )
            new, record = (
                _collected(k, model, prior, train, tasks, options, seed, place)
                if episodes is None
                else (episodes(k), dict[str, float]())
            )
            found.episodes.append(new)
            before = (found.records[-1]["env_steps"] if found.records else 0) + int(
                record.get("discarded_steps", 0)
            )
            if new is not None:
                n = min(len(new) - 1, max(1, round(options.held_out * len(new))))
                if n:
                    found.held_out = found.held_out.joined(new.take(slice(n)))
                found.train = found.train.joined(new.take(slice(n, None)))
                before += int(new.steps.sum())
            record = {"round": k, "env_steps": before} | record
            train_on = found.train if augmented is None else augmented(found.train)
            record = _trained(
                k, model, prior, found, train_on, record, options, seed, place, measure
            )
            found.seconds.append({name: record.pop(name) for name in SECONDS if name in record})
            found.records.append(record)
            if callback is not None:
                callback(Progress(k, time.process_time() - began, found.records[-1]))
    return found


def _require_robot(
    model: Trainable, prior: ActionPrior | None, train: Trajectories, held_out: Trajectories
) -> None:
    """Error unless all are of one robot, as far as their sizes and names tell."""
    train.robot.require_same(held_out.robot, "training and held-out data")
    for net in (model, prior):
        if net is not None:
            require_robot(net, train.robot, "what explores and its training data", but=("env",))


def _collected(
    k: int,
    model: Trainable,
    prior: ActionPrior | None,
    like: Trajectories,
    tasks: Tasks,
    options: ExplorationOptions,
    seed: int,
    place: _Round | None,
) -> tuple[Trajectories | None, dict[str, float]]:
    """The episodes of round k and what is said of them, from the folder if they are there; None where all are lost."""
    if place is not None and (stored := place.episodes()) is not None:
        return stored
    began, task = _now(), tasks(k)
    if task.env != like.env:
        raise ValueError(
            f"the tasks of round {k} are of {task.env}, the data of {like.env}; expected one robot"
        )
    if len(task) < 2:
        raise ValueError(
            f"round {k} has {len(task)} task; expected at least 2, since one episode is held out"
        )
    bonus = partial(
        _with_bonus, weight=options.bonus, scale=torch.from_numpy(like.flat_states.std(0))
    )
    aim = (
        replace(task, reward_for=lambda target: bonus(task.reward_for(target)))
        if options.bonus
        else task
    )
    direct = DirectActions(task.horizon, task.action_dim, rms=options.rms)
    space = direct if prior is None else LatentActions(prior, task.horizon)
    draw = seed * 1_000_003 + 1000 * k
    planner: Planner = partial(
        cem,
        candidates=options.candidates,
        elites=options.elites,
        iterations=options.iterations,
        screened=options.screened,
        seed=draw,
    )
    if options.noise:
        planner = _Perturbed(
            planner, options.noise, torch.Generator().manual_seed(-1 - draw)
        )  # of no search
    judge: Judge = model_predictor
    if options.bonus:
        judge = partial(model_predictor, samples=options.samples)
    elif options.judging:
        judge = partial(expected_predictor, samples=options.judging)
    stable = without_unstable(
        aim,
        lambda left, _: mpc(
            left, model, space, planner, every=options.every, judge=judge, seed=draw + 1
        ),
    )
    counted: dict[str, float] = {"lost": stable.lost, "discarded_steps": stable.discarded_steps}
    if (trial := stable.found) is None:
        return None, _unknown(task, bonus=bool(options.bonus)) | counted | _since(began)
    record = _said(trial, bonus=bool(options.bonus)) | counted | _since(began)
    seen = cast(Trajectories, trial.seen)  # of mpc, there always
    episodes = Trajectories.from_rows(
        seen.flat_states, seen.flat_actions, seen.lengths, like.robot, seen.terminated
    )
    if place is not None:
        place.keep_episodes(episodes, record)
    return episodes, record


def _trained(
    k: int,
    model: Trainable,
    prior: ActionPrior | None,
    found: Exploration,
    augmented: Trajectories,
    record: dict[str, float],
    options: ExplorationOptions,
    seed: int,
    place: _Round | None,
    measure: Measure | None,
) -> dict[str, float]:
    """The record of round k with what training gave; ``model`` and ``prior`` trained, or loaded if they are there."""
    if place is not None and (stored := place.models(model, prior)) is not None:
        return stored
    began, parts = _now(), list[tuple[str, nn.Module, Loss, Trajectories, TrainingOptions]]()
    if prior is not None and options.prior is not None:
        parts.append(("prior_validation", prior, prior.loss, found.train, options.prior))
    parts.append(("validation", cast(nn.Module, model), model.loss, augmented, options.model))
    for name, part, loss, data, training in parts:
        checkpoint = None if place is None else place.folder / f"{name}.checkpoint"
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
        windows = fixed_windows(found.held_out, training.past_len, training.future_len)
        record[name] = validate(loss, windows, seed + k)
    record |= {name: record.get(name, 0.0) + spent for name, spent in _since(began).items()}
    if measure is not None:
        measured = measure(model, prior)
        if taken := sorted(record.keys() & measured):
            raise ValueError(
                f"measure gave {', '.join(map(repr, taken))}, which the record of a round has of its own episodes; "
                f"return it by another name, such as 'tested_{taken[0]}'"
            )
        record |= measured
    if place is not None:
        place.keep_models(model, prior, record)
    return record


def _now() -> tuple[float, float]:
    """Of this process and on the wall, in the order of SECONDS."""
    return time.process_time(), time.perf_counter()


def _since(began: tuple[float, float]) -> dict[str, float]:
    return {name: now - then for name, now, then in zip(SECONDS, _now(), began, strict=True)}


def _said(trial: Trial, *, bonus: bool) -> dict[str, float]:
    """Means over the episodes of a trial."""
    record = {"executed_return": float(trial.executed_return.mean())}
    if trial.success is not None:
        record["success"] = float(trial.success.float().mean())
    if not trial.final_distance.isnan().any():
        record["final_distance"] = float(trial.final_distance.mean())
    if not bonus and trial.plan is not None:
        record["predicted_return"] = float(trial.plan.predicted_return.mean())
        record["gap"] = float(trial.gap.abs().mean())
    return record


def _unknown(task: Task, *, bonus: bool) -> dict[str, float]:
    """The names of ``_said`` for a round without episodes, all NaN, so that every record has the same columns."""
    final_distance, success = task.judged(
        torch.from_numpy(task.start)[:, None].expand(-1, task.horizon + 1, -1)
    )
    names = ["executed_return"]
    names += ["success"] if success is not None else []
    names += ["final_distance"] if not final_distance.isnan().any() else []
    names += [] if bonus else ["predicted_return", "gap"]
    return dict.fromkeys(names, math.nan)


def _with_bonus(reward: Reward, *, weight: float, scale: Tensor) -> Reward:
    """``reward`` plus ``weight`` times the disagreement of sampled states (S, C, B, T, dx); one rollout has none.

    scale (dx,): the data's standard deviation, in which disagreement is measured where the data move.
    """

    def total(states: Tensor, actions: Tensor) -> Tensor:
        plain = rewarded(reward, states, actions)
        if states.ndim < 5:
            return plain
        spread = states.std(0, unbiased=False, keepdim=True) / scale.where(scale > 0, torch.inf)
        return plain + weight * spread.mean(-1)

    return total


@dataclass
class _Perturbed:
    """A planner whose plans are disturbed before they are executed."""

    planner: Planner
    deviation: float
    generator: torch.Generator

    def __call__(
        self, predict: Predictor, reward: Reward, space: SearchSpace, start: Tensor | int, /
    ) -> Plan:
        plan = self.planner(predict, reward, space, start)
        noise = space.noise(1, len(plan.parameters), self.generator)[0]
        parameters = plan.parameters + self.deviation * space.scale * noise
        with torch.no_grad():
            return replace(plan, parameters=parameters, actions=space.decode(parameters[None])[0])


@dataclass(frozen=True)
class _Round:
    """The files of one round: its episodes, then the prior, at last the model with the whole record."""

    folder: Path
    identity: Mapping[str, Json]

    def episodes(self) -> tuple[Trajectories | None, dict[str, float]] | None:
        path, whole = self.folder / "episodes.safetensors", self.folder / "model.safetensors"
        if path.exists():
            return artifacts.load_trajectories(path), self._record(path)
        return (None, self._record(whole)) if whole.exists() else None  # all were lost

    def keep_episodes(self, episodes: Trajectories, record: Mapping[str, float]) -> None:
        artifacts.save_trajectories(
            self.folder / "episodes.safetensors", episodes, self._header(record)
        )

    def models(self, model: Trainable, prior: ActionPrior | None) -> dict[str, float] | None:
        """The record of the whole round, its weights now in ``model`` and ``prior``; None if not all is there."""
        path = self.folder / "model.safetensors"
        if not path.exists():
            return None
        record = self._record(path)
        for name, part in {"model": cast(nn.Module, model), "prior": prior}.items():
            if part is not None:
                stored = artifacts.load_model(
                    self.folder / f"{name}.safetensors", cast(Any, type(part))
                )
                part.load_state_dict(stored.state_dict())
        return record

    def keep_models(
        self, model: Trainable, prior: ActionPrior | None, record: Mapping[str, float]
    ) -> None:
        if prior is not None:
            artifacts.save_model(self.folder / "prior.safetensors", prior, self._header(record))
        artifacts.save_model(
            self.folder / "model.safetensors", cast(Any, model), self._header(record)
        )
        for checkpoint in self.folder.glob("*.checkpoint"):
            shutil.rmtree(checkpoint)

    def _header(self, record: Mapping[str, float]) -> dict[str, Json]:
        return {"identity": dict(self.identity), "record": encode_nonfinite(dict(record))}

    def _record(self, path: Path) -> dict[str, float]:
        header = artifacts.read_header(path)
        stored = cast(dict[str, Json], header.get("identity", {}))
        later: dict[str, Json] = {
            "episodes": "planned",
            "configurations": self.identity["configurations"],
        }
        options = {"rms": 0.1, **BY_MODE, **cast(dict[str, Json], stored.get("options", {}))}
        found = later | stored | {"options": options}
        if differs := artifacts.differences(found, dict(self.identity)):
            raise StoreError(
                f"{path} is of another exploration: {'; '.join(differs)}. Delete {self.folder.parent} to start anew, "
                "or go back to those settings"
            )
        return dict(decode_nonfinite(header["record"]))
