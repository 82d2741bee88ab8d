"""Plans made with trained models, kept in the run's folder."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tsmlib import store
from tsmlib.control import Task, Trial, execute, random_torques, zero_torques
from tsmlib.runs import Run
from tsmlib.study.data import short
from tsmlib.study.models import load_or_train
from tsmlib.study.predictions import RESULTS
from tsmlib.trajopt import (
    DirectActions,
    LatentActions,
    Plan,
    Space,
    adam,
    cem,
    reassess,
    sampled_starts,
    through_model,
    through_simulator,
)


def trial(run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int = 0) -> Trial:
    """Plan with one method and execute open loop in the true simulator.

    model: any of DYNAMICS, or oracle (the true simulator), or none. planner: adam (from zero, as the paper),
    adam+starts (from the best of sampled candidates), cem; with model none: random or zero torques. prior: codes
    (Eq. 3) or actions (Eq. 2). iterations: of the planner; 0 means the scale's default.
    """
    if model == "none":
        return execute(task, {"random": random_torques, "zero": zero_torques}[planner](task))
    return execute(task, plan(run, task, model, planner, prior, iterations=iterations))


def plan(run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int = 0) -> Plan:
    """The plan alone; see ``trial``. ``predicted`` comes from 32 model samples that the planner did not see.

    Plans are kept in the run's folder and found again as long as task, models and budget are the same. At scale
    laptop the oracle's plans are those that ship in data/results, since it simulates every candidate.
    """
    if planner not in ("adam", "adam+starts", "cem") or prior not in ("codes", "actions") or iterations < 0:
        raise ValueError(
            f"planner is {planner!r}, prior {prior!r}, iterations {iterations}; expected adam, adam+starts or cem, "
            "codes or actions, and 0 (the scale's default) or more"
        )
    nets = {}
    if prior == "codes":
        nets["prior"], _ = load_or_train(run, task.env, "prior")
    if model != "oracle":
        nets["model"], _ = load_or_train(run, task.env, model)
    budget = (
        run.pick(smoke=8, laptop=96, paper=128),
        iterations
        or (run.pick(smoke=2, laptop=8, paper=12) if planner == "cem" else run.pick(smoke=3, laptop=100, paper=100)),
    )
    name = f"{short(task.env)}-{model}-{prior}-{planner}.safetensors"
    made_from = {
        "env": task.env, "horizon": task.horizon, "seed": run.seed, "candidates": budget[0], "iterations": budget[1],
        "weights": {word: store.digest(net.state_dict()) for word, net in nets.items()},
    }  # fmt: skip
    own, shipped = run.folder("plans") / name, RESULTS / name
    if own.exists() and store.read_header(own)["made_from"] == made_from and (kept := _kept(own, task)):
        return kept
    if model == "oracle" and run.scale == "laptop" and shipped.exists() and (kept := _kept(shipped, task, prefix=True)):
        return kept
    found = _search(run, task, planner, nets, *budget, bar=f"{task.name}: {model}, {planner} over {prior}")
    if model != "oracle":
        net = nets["model"]
        fresh_samples = through_model(net, task.past(net.past_len), samples=32, seed=run.seed + 1)
        found = reassess(found, fresh_samples, task.reward)
    arrays: dict[str, Any] = {
        "start": task.start, "target": task.target, "actions": found.actions, "parameters": found.parameters,
        "states": found.states[:1], "predicted": found.predicted, "curve": found.curve,
    }  # fmt: skip
    store.save(own, arrays, kind="plan", header={"made_from": made_from, "seconds": found.seconds})
    return found


def _search(
    run: Run, task: Task, planner: str, nets: dict[str, Any], candidates: int, iterations: int, *, bar: str
) -> Plan:
    began = time.perf_counter()
    space: Space = LatentActions(nets["prior"], task.horizon) if "prior" in nets else DirectActions(task.horizon)
    if "model" in nets:
        predict = through_model(nets["model"], task.past(nets["model"].past_len), samples=2, seed=run.seed)
    else:
        predict = through_simulator(task.env, task.start)
    if planner == "cem":
        found = cem(
            predict, task.reward, space, len(task),
            candidates=candidates, elites=max(2, candidates // 10), iterations=iterations, seed=run.seed, progress=bar,
        )  # fmt: skip
    else:
        start = torch.zeros(1, len(task), *space.shape)
        if planner == "adam+starts":
            start = sampled_starts(
                predict, task.reward, space, len(task), candidates=candidates, keep=2, seed=run.seed
            )  # fmt: skip
        found = adam(predict, task.reward, space, start, iterations=iterations, progress=bar)
    return replace(found, seconds=time.perf_counter() - began)


def _kept(path: Path, task: Task, *, prefix: bool = False) -> Plan | None:
    """The plan in ``path`` if it was made for this task, or, with ``prefix``, for more targets that begin with its."""
    tensors, header = store.load(path, kind="plan")
    n = len(task)
    same = np.array_equal(tensors["start"][:n].numpy(), task.start) and torch.equal(tensors["target"][:n], task.target)
    if not same or (len(tensors["start"]) != n and not prefix):
        return None
    return Plan(
        actions=tensors["actions"][:n], parameters=tensors["parameters"][:n], states=tensors["states"][:, :n],
        predicted=tensors["predicted"][:n], curve=tensors["curve"][:, :n], seconds=header["seconds"],
    )  # fmt: skip
