"""Plans made with trained models, open loop and closed loop, kept in the run's folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.plots.method import PLANNERS, SEARCH_SPACES, Method
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import members
from tsmlib.planning.base import Judge, Plan, Planner, Predictor, SearchSpace
from tsmlib.planning.execution import Trial, execute, mpc
from tsmlib.planning.planners import adam, cem, mppi, plan_at, reevaluate, sampled_starts
from tsmlib.planning.predictors import (
    JUDGING,
    expected_predictor,
    fresh_predictor,
    model_predictor,
    simulator_predictor,
)
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task, random_torques, zero_torques
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json
from reproduction.models import TrainedModel, load_or_train, load_prior
from reproduction.runs import RESULTS, Run

VERSION = 2  # of planners and kept plans; others are made again
CANDIDATES = {
    "smoke": 8,
    "laptop": 96,
    "paper": 96,
}  # of each iteration of cem and mppi, and for adam+starts
ITERATIONS = {  # of an open-loop plan
    "cem": {"smoke": 2, "laptop": 8, "paper": 10},
    "adam": {"smoke": 3, "laptop": 100, "paper": 100},
}
AGAIN = {  # of each later plan of a closed loop, which starts from what is left of the one before
    "cem": {"smoke": 1, "laptop": 3, "paper": 4},
    "adam": {"smoke": 2, "laptop": 20, "paper": 20},
}
SCREENED = 0.25  # of the candidates of cem, which all samples or members judge (benchmarks/settings, sections 3, 6)
KEPT = 4  # samples of the predicted states, of those behind a predicted return
TORQUES: dict[str, Callable[[Task], Tensor]] = {"random": random_torques, "zero": zero_torques}

Methods = (
    Sequence[Method] | Mapping[str, Sequence[Method]]
)  # for every task, or by the name of the task


def trial(run: Run, task: Task, method: Method, *, iterations: int = 0, every: int = 0) -> Trial:
    """Plan with a method and execute in the true simulator.

    method: a model of the zoo, or the oracle (the true simulator), with a search space and a planner: adam (from zero,
    as the paper), adam+starts (from the best of sampled candidates), cem or mppi; or random or zero torques.
    iterations: of the planner; 0 means the scale's default. every: 0 executes open loop, as the paper; else the arm
    stops after as many steps to plan again (``execution.mpc``), beginning with that plan.
    """
    if torques := TORQUES.get(method.model):
        return execute(task, torques(task))
    return execute(task, plan(run, task, method, iterations=iterations, every=every))


def trials(
    run: Run, tasks: Sequence[Task], methods: Methods, *, iterations: int = 0, every: int = 0
) -> dict[str, dict[Method, Trial]]:
    """Environment -> method -> trial."""
    return {
        task.env: {
            m: trial(run, task, m, iterations=iterations, every=every) for m in _of(methods, task)
        }
        for task in tasks
    }


def usual_iterations(run: Run, method: Method, *, again: bool = False) -> int:
    """A planner's iterations at a run's scale; again: of a later plan of a closed loop."""
    by_slope = method.planner in ("adam", "adam+starts")
    return (AGAIN if again else ITERATIONS)["adam" if by_slope else "cem"][run.scale]


def plan(run: Run, task: Task, method: Method, *, iterations: int = 0, every: int = 0) -> Plan:
    """The plan alone; see ``trial``. ``predicted_return`` comes from 32 model samples that the planner did not see.

    Of a closed loop it is what was done, with the first predicted return. Given iterations, it keeps its ``trace``.
    Plans are kept in the run's folder and found again as long as task, models and budget are the same; a task with a
    reward of its own is planned for each time. At scale laptop the oracle's plans are those that ship in data/results,
    since it simulates every candidate.
    """
    if (
        method.planner not in PLANNERS
        or method.search_space not in SEARCH_SPACES
        or min(iterations, every) < 0
    ):
        raise ValueError(
            f"planner is {method.planner!r}, search space {method.search_space!r}, iterations {iterations}, every "
            f"{every}; expected {', '.join(list(PLANNERS)[:-1])} or {list(PLANNERS)[-1]}, "
            f"{' or '.join(SEARCH_SPACES)}, and 0 (the scale's default) or more"
        )
    problem = _Problem.of(run, task, method, iterations, every)
    name = f"{file_name(task.env, method, iterations=iterations, every=every)}.safetensors"
    own, made_from = run.folder("plans") / name, problem.made_from()
    if task.is_standard and (kept := _kept(own, task, made_from)):
        return kept
    if task.is_standard and method.model == "oracle" and run.scale == "laptop":
        posed = {word: value for word, value in made_from.items() if word in POSED}
        if kept := _kept(RESULTS / name, task, posed):
            return kept
    found = problem.closed_loop() if every else problem.search()
    found = replace(found, states=found.states[:KEPT], trace=found.trace if iterations else None)
    if task.is_standard:
        arrays: dict[str, Tensor | np.ndarray] = {
            "start": task.start,
            "target": task.target,
            "actions": found.actions,
            "parameters": found.parameters,
            "states": found.states,
            "predicted": found.predicted_return,
            "curve": found.curve,
        }
        if found.trace is not None:
            arrays["trace"] = found.trace
        header: dict[str, Json] = {
            "made_from": made_from,
            "seconds": found.seconds,
            "device": run.device,
        }
        artifacts.save(own, arrays, kind="plan", header=header)
    return found


def file_name(env: str, method: Method, *, iterations: int = 0, every: int = 0) -> str:
    """What the file of a plan is called, without suffix."""
    kind = f"-every{every}" * bool(every) + f"-{iterations}" * bool(iterations)
    return (
        "-".join((EnvSpec.parse(env).name, method.model, method.search_space, method.planner))
        + kind
    )


def along_the_way(
    run: Run, task: Task, method: Method, *, iterations: int, at: Iterable[int]
) -> dict[int, Trial]:
    """Predicted and executed returns along a long optimisation: iteration -> trial (``planners.plan_at``)."""
    whole, problem = (
        plan(run, task, method, iterations=iterations),
        _Problem.of(run, task, method, iterations, 0),
    )
    _, fresh = problem.predictors()
    return {i: execute(task, plan_at(whole, i, fresh, task.reward, problem.space())) for i in at}


def with_modes(run: Run, task: Task, method: Method, trial: Trial) -> Trial:
    """The trial of an open-loop plan with the mode's rollout, of an ensemble its members', in place of fresh samples.

    For films; the predicted return stays that of the fresh samples.
    """
    if trial.plan is None:
        raise ValueError("these actions were not planned, so there is no predicted rollout")
    with torch.no_grad():
        seen = _Problem.of(run, task, method, 0, 0).modes()(trial.plan.actions[None])[:, 0]
    return replace(trial, plan=replace(trial.plan, states=seen))


POSED = (
    "version",
    "task",
    "env",
    "horizon",
    "every",
)  # of what a plan is made from, what says which task it is for


@dataclass(frozen=True)
class _Problem:
    """A task to be planned for with a method and a budget. model None: the true simulator."""

    run: Run
    task: Task
    method: Method
    model: TrainedModel | None
    prior: ActionPrior | None
    candidates: int
    iterations: int  # of each plan; one that is made again starts from what is left of the last
    every: int

    @staticmethod
    def of(run: Run, task: Task, method: Method, iterations: int, every: int) -> _Problem:
        """With its models, trained where they are missing, and the scale's budget."""
        prior = load_prior(run, task.env) if method.search_space == "latent" else None
        model = (
            None if method.model == "oracle" else load_or_train(run, task.env, method.model).model
        )
        usual = usual_iterations(run, method, again=bool(every))
        return _Problem(
            run, task, method, model, prior, CANDIDATES[run.scale], iterations or usual, every
        )

    def made_from(self) -> dict[str, Json]:
        """All that the plan is a function of."""
        nets = {"prior": self.prior, "model": self.model}
        judge: dict[str, Json] = (
            {} if self.model is None else {"samples": JUDGING if self.by_expectation else 0}
        )
        n = 1 if self.model is None else members(self.model)
        if n > 1:
            judge["members"] = n
        if self.method.planner == "cem" and (n > 1 or self.by_expectation):
            judge["screened"] = SCREENED
        return judge | {
            "version": VERSION,
            "task": self.task.name,
            "env": self.task.env,
            "horizon": self.task.horizon,
            "every": self.every,
            "seed": self.run.seed,
            "candidates": self.candidates,
            "iterations": self.iterations,
            "weights": {
                word: artifacts.digest(net.state_dict())
                for word, net in nets.items()
                if net is not None
            },
        }

    @property
    def by_expectation(self) -> bool:
        """Whether candidates are judged by samples, beside the mode: by cem, which screens them, of a single model."""
        net = self.model
        return (
            self.method.planner == "cem"
            and net is not None
            and net.stochastic
            and members(net) == 1
        )

    @property
    def judge(self) -> Judge:
        """What candidates are judged by."""
        return (
            partial(expected_predictor, samples=JUDGING) if self.by_expectation else model_predictor
        )

    def space(self) -> SearchSpace:
        if self.prior is None:
            return DirectActions(self.task.horizon)
        return LatentActions(self.prior.to(self.run.device), self.task.horizon)

    def predictors(self) -> tuple[Predictor, Predictor]:
        """What candidates are judged by, and what the return of the finished plan is predicted with."""
        if self.model is None:
            simulator = self.modes()
            return simulator, simulator
        net, seed = self.model.to(self.run.device), self.run.seed
        past = self.task.past(net.past_len)
        return self.judge(net, past, seed=seed), fresh_predictor(net, past, seed=seed + 1)

    def modes(self) -> Predictor:
        """Predicts the mode, of an ensemble that of each member; without a model, the true simulator."""
        if self.model is None:
            return simulator_predictor(self.task.env, self.task.start)
        return model_predictor(self.model.to(self.run.device), self.task.past(self.model.past_len))

    def planner(self, progress: str = "") -> Planner:
        word, seed, candidates = self.method.planner, self.run.seed, self.candidates
        if word == "cem":
            elites = max(2, candidates // 10)
            found: Callable[..., Plan] = partial(
                cem, candidates=candidates, elites=elites, screened=SCREENED, seed=seed
            )
        elif word == "mppi":
            found = partial(mppi, candidates=candidates, seed=seed)
        else:
            found = adam
        return partial(found, iterations=self.iterations, progress=progress)

    def title(self) -> str:
        return f"{self.task.name}: {self.method.label}"

    def search(self) -> Plan:
        """Open loop."""
        began = time.perf_counter()
        space, (predict, fresh), task = self.space(), self.predictors(), self.task
        start = torch.zeros(1, len(task), *space.shape)
        if self.method.planner == "adam+starts":
            n, seed = self.candidates, self.run.seed
            start = sampled_starts(
                predict, task.reward, space, len(task), candidates=n, keep=2, seed=seed
            )
        found = self.planner(self.title())(predict, task.reward, space, start)
        found = replace(found, seconds=time.perf_counter() - began)
        return found if self.model is None else reevaluate(found, fresh, task.reward)

    def closed_loop(self) -> Plan:
        """``execution.mpc`` from the kept open-loop plan on; seconds of both."""
        first = plan(self.run, self.task, self.method)
        net = None if self.model is None else self.model.to(self.run.device)
        done = mpc(
            self.task,
            net,
            self.space(),
            self.planner(),
            every=self.every,
            plan=first,
            judge=self.judge,
            seed=self.run.seed,
            progress=self.title(),
        ).plan
        assert done is not None
        return replace(done, seconds=first.seconds + done.seconds)


def _of(methods: Methods, task: Task) -> Sequence[Method]:
    return methods[task.name] if isinstance(methods, Mapping) else methods


def models_of(method: Method) -> list[str]:
    """The trained models that planning with a method needs."""
    return [method.model] * (method.model != "oracle") + ["prior"] * (
        method.search_space == "latent"
    )


def _kept(path: Path, task: Task, wanted: Mapping[str, Json]) -> Plan | None:
    """The plan in ``path`` if it was made as ``wanted`` for this task, or for more targets that begin with its."""
    if not path.exists():
        return None
    tensors, header = artifacts.load(path, kind="plan")
    n, made_from = len(task), header.get("made_from")
    if not isinstance(made_from, dict) or any(
        made_from.get(word) != value for word, value in wanted.items()
    ):
        return None
    if not np.array_equal(tensors["start"][:n], task.start) or not torch.equal(
        tensors["target"][:n], task.target
    ):
        return None
    return Plan(
        actions=tensors["actions"][:n],
        parameters=tensors["parameters"][:n],
        states=tensors["states"][:, :n],
        predicted_return=tensors["predicted"][:n],
        curve=tensors["curve"][:, :n],
        seconds=cast("float", header["seconds"]),
        trace=tensors["trace"][:, :n] if "trace" in tensors else None,
    )
