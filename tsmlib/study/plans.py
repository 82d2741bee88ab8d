"""Plans made with trained models, open loop and closed loop, kept in the run's folder."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tsmlib.planning.base import Plan, Planner, Predictor, SearchSpace
from tsmlib.planning.execution import Trial, execute, mpc
from tsmlib.planning.planners import adam, cem, mppi, plan_at, reevaluate, sampled_starts
from tsmlib.planning.predictors import model_predictor, simulator_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task, random_torques, zero_torques
from tsmlib.storage import artifacts
from tsmlib.study.data import short
from tsmlib.study.models import load_or_train
from tsmlib.study.predictions import RESULTS
from tsmlib.study.runs import Run

PLANNERS = ("adam", "adam+starts", "cem", "mppi")
VERSION = 2  # of planners and kept plans; others are made again
KEPT = 4  # samples of the predicted states, of the 32 behind a promise


def trial(run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int = 0, every: int = 0) -> Trial:
    """Plan with one method and execute in the true simulator.

    model: any of DYNAMICS, or oracle (the true simulator), or none. planner: adam (from zero, as the paper),
    adam+starts (from the best of sampled candidates), cem, mppi; with model none: random or zero torques. prior: codes
    (Eq. 3) or actions (Eq. 2). iterations: of the planner; 0 means the scale's default. every: 0 executes open loop, as
    the paper; else the arm stops after as many steps to plan again (``control.mpc``), beginning with that plan.
    """
    if model == "none":
        return execute(task, {"random": random_torques, "zero": zero_torques}[planner](task))
    return execute(task, plan(run, task, model, planner, prior, iterations=iterations, every=every))


def plan(run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int = 0, every: int = 0) -> Plan:
    """The plan alone; see ``trial``. ``predicted`` comes from 32 model samples that the planner did not see.

    Of a closed loop it is what was done, with the first promise. Given iterations, it keeps its ``trace``. Plans are
    kept in the run's folder and found again as long as task, models and budget are the same; a task with a reward of
    its own is planned for each time. At scale laptop the oracle's plans are those that ship in data/results, since it
    simulates every candidate.
    """
    if planner not in PLANNERS or prior not in ("codes", "actions") or iterations < 0 or every < 0:
        raise ValueError(
            f"planner is {planner!r}, prior {prior!r}, iterations {iterations}, every {every}; expected "
            f"{', '.join(PLANNERS[:-1])} or {PLANNERS[-1]}, codes or actions, and 0 (the scale's default) or more"
        )
    nets = {}
    if prior == "codes":
        nets["prior"], _ = load_or_train(run, task.env, "prior")
    if model != "oracle":
        nets["model"], _ = load_or_train(run, task.env, model)
    candidates, steps = _budget(run, planner, iterations, every)
    kind = f"-every{every}" * bool(every) + f"-{iterations}" * bool(iterations)
    name = f"{short(task.env)}-{model}-{prior}-{planner}{kind}.safetensors"
    posed = {"version": VERSION, "task": task.name, "env": task.env, "horizon": task.horizon, "every": every}
    made_from = posed | {
        "seed": run.seed, "candidates": candidates, "iterations": steps,
        "weights": {word: artifacts.digest(net.state_dict()) for word, net in nets.items()},
    }  # fmt: skip
    own, shipped = run.folder("plans") / name, RESULTS / name
    if task.own is None and (kept := _kept(own, task, made_from)):
        return kept
    if task.own is None and model == "oracle" and run.scale == "laptop" and (kept := _kept(shipped, task, posed)):
        return kept
    for net in nets.values():
        net.to(run.device)
    bar = f"{task.name}: {model}, {planner} over {prior}"
    if every:
        first = plan(run, task, model, planner, prior)
        found = _closed_loop(run, task, _planner(planner, candidates, steps, run.seed), nets, every, first, bar)
    else:
        found = _search(run, task, planner, nets, candidates, steps, bar)
    found = replace(found, states=found.states[:KEPT], trace=found.trace if iterations else None)
    if task.own is None:
        arrays: dict[str, Any] = {
            "start": task.start, "target": task.target, "actions": found.actions, "parameters": found.parameters,
            "states": found.states, "predicted": found.predicted_return, "curve": found.curve,
        } | ({} if found.trace is None else {"trace": found.trace})  # fmt: skip
        artifacts.save(
            own, arrays, kind="plan", header={"made_from": made_from, "seconds": found.seconds, "device": run.device}
        )
    return found


def along_the_way(
    run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int, at: list[int]
) -> dict[int, Trial]:
    """What a long optimisation promises and earns along its way: iteration -> trial (``trajopt.stopped``)."""
    whole = plan(run, task, model, planner, prior, iterations=iterations)
    nets = {word: load_or_train(run, task.env, word)[0].to(run.device) for word in ("prior", model)}
    space, judge = _space(task, nets if prior == "codes" else {}), _judge(run, task, nets[model])
    return {i: execute(task, plan_at(whole, i, judge, task.reward, space)) for i in at}


def _budget(run: Run, planner: str, iterations: int, every: int) -> tuple[int, int]:
    """Candidates, and iterations of each plan; a plan that is made again starts from what is left of the last."""
    candidates = run.pick(smoke=8, laptop=96, paper=96)
    if planner in ("cem", "mppi"):
        usual = run.pick(smoke=1, laptop=3, paper=4) if every else run.pick(smoke=2, laptop=8, paper=10)
    else:
        usual = run.pick(smoke=2, laptop=20, paper=20) if every else run.pick(smoke=3, laptop=100, paper=100)
    return candidates, iterations or usual


def _planner(word: str, candidates: int, iterations: int, seed: int, bar: str = "") -> Planner:
    options: dict[str, Any] = dict(iterations=iterations, progress=bar)
    if word == "cem":
        return partial(cem, candidates=candidates, elites=max(2, candidates // 10), seed=seed, **options)
    if word == "mppi":
        return partial(mppi, candidates=candidates, seed=seed, **options)
    return partial(adam, **options)


def _space(task: Task, nets: dict[str, Any]) -> SearchSpace:
    return LatentActions(nets["prior"], task.horizon) if "prior" in nets else DirectActions(task.horizon)


def _samples(model: Any, n: int = 2) -> int:
    """As many as a planner searches with; a deterministic model's are all the same."""
    return n if getattr(model, "stochastic", True) else 1


def _judge(run: Run, task: Task, model: Any) -> Predictor:
    return model_predictor(model, task.past(model.past_len), samples=_samples(model, 32), seed=run.seed + 1)


def _search(
    run: Run, task: Task, planner: str, nets: dict[str, Any], candidates: int, iterations: int, bar: str
) -> Plan:
    began = time.perf_counter()
    space, model = _space(task, nets), nets.get("model")
    if model is not None:
        predict = model_predictor(model, task.past(model.past_len), samples=_samples(model), seed=run.seed)
    else:
        predict = simulator_predictor(task.env, task.start)
    start = torch.zeros(1, len(task), *space.shape)
    if planner == "adam+starts":
        start = sampled_starts(predict, task.reward, space, len(task), candidates=candidates, keep=2, seed=run.seed)
    found = _planner(planner, candidates, iterations, run.seed, bar)(predict, task.reward, space, start)
    found = replace(found, seconds=time.perf_counter() - began)
    return found if model is None else reevaluate(found, _judge(run, task, model), task.reward)


def _closed_loop(
    run: Run, task: Task, planner: Planner, nets: dict[str, Any], every: int, first: Plan, bar: str
) -> Plan:
    """``control.mpc`` from the kept plan on; seconds of both."""
    model = nets.get("model")
    done = mpc(
        task, model, _space(task, nets), planner, every=every, plan=first,
        samples=_samples(model), seed=run.seed, progress=bar,
    ).plan  # fmt: skip
    assert done is not None
    return replace(done, seconds=first.seconds + done.seconds)


def _kept(path: Path, task: Task, wanted: dict[str, Any]) -> Plan | None:
    """The plan in ``path`` if it was made as ``wanted`` for this task, or for more targets that begin with its."""
    if not path.exists():
        return None
    tensors, header = artifacts.load(path, kind="plan")
    n, made_from = len(task), header.get("made_from", {})
    if any(made_from.get(word) != value for word, value in wanted.items()):
        return None
    if not np.array_equal(tensors["start"][:n], task.start) or not torch.equal(tensors["target"][:n], task.target):
        return None
    return Plan(
        actions=tensors["actions"][:n], parameters=tensors["parameters"][:n], states=tensors["states"][:, :n],
        predicted_return=tensors["predicted"][:n], curve=tensors["curve"][:, :n], seconds=header["seconds"],
        trace=tensors["trace"][:, :n] if "trace" in tensors else None,
    )  # fmt: skip
