"""Policies learned inside trained models."""

from __future__ import annotations

import shutil
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from tsmlib import rewards
from tsmlib.evaluation.actions import within
from tsmlib.planning.execution import execute
from tsmlib.planning.tasks import TOLERANCE, Task
from tsmlib.policies.learning import episodes_from, imagine, learn_policy
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy, controller
from tsmlib.storage import artifacts
from tsmlib.study.data import dataset, fingerprint, short
from tsmlib.study.models import load_or_train
from tsmlib.study.runs import Run

EPISODES = {"smoke": 4, "laptop": 20, "paper": 20}  # of each copy, per iteration (A.3)


def learn(
    run: Run, task: Task, model: str, prior: str, *, copies: int = 1, iterations: int = 0
) -> tuple[Any, dict[str, Any]]:
    """A policy learned inside a trained model, and the header of its file (learning curve, seconds, seed, scale).

    prior: codes (a SegmentPolicy, acting through the action prior) or actions (a OneStepPolicy). copies: learned side
    by side from different seeds. iterations: 0 means smoke 4, laptop 300, paper 2,200. Episodes start as those of the
    training data, so the environment is not asked. What the policy truly earns on ``task`` is measured at ten points
    along the way, beside what the model promises there (``assess``); neither has a part in learning.

    From the run's folder; else, at scale laptop with seed 0, the shipped one, whatever its copies and iterations; else
    learned now, going on from its checkpoint if it was stopped.
    """
    if prior not in ("codes", "actions") or iterations < 0 or copies < 1:
        raise ValueError(
            f"prior is {prior!r}, iterations {iterations}, copies {copies}; expected codes or actions, 0 (the scale's "
            "default) or more iterations, and at least one copy"
        )
    net, _ = load_or_train(run, task.env, model)
    nets = {"model": net} | ({"prior": load_or_train(run, task.env, "prior")[0]} if prior == "codes" else {})
    cls, own = SegmentPolicy if prior == "codes" else OneStepPolicy, _path(run, task, model, prior)
    shipped = run.shipped / short(task.env) / own.name
    weights = {word: artifacts.digest(net.state_dict()) for word, net in nets.items()}
    made_from = {"task": task.name, "horizon": task.horizon, "seed": run.seed, "weights": weights}
    budget = {"copies": copies, "iterations": iterations or run.pick(smoke=4, laptop=300, paper=2200)}
    for path in [own, shipped] if run.scale == "laptop" and run.seed == 0 else [own]:
        if path.exists():
            header = artifacts.read_header(path)
            if header.get("made_from") == made_from and (path == shipped or header.get("budget") == budget):
                return artifacts.load_model(path, cls, expect=fingerprint(task.env)), header
    print(f"{task.env}: no policy learned in {model} through {prior} at scale {run.scale}; learning it now")
    data = dataset(run, task.env, "train")
    options: dict[str, Any] = dict(angles=data.angles, copies=copies, seed=1000 * run.seed)
    if prior == "codes":
        policy: Any = SegmentPolicy(data.states.shape[2], nets["prior"], **options)
    else:
        policy = OneStepPolicy(data.states.shape[2], data.actions.shape[2], **options)
    policy.features.fit(torch.from_numpy(data.states))
    checkpoint = own.with_name(f"policy-{model}-{prior}.checkpoint")
    curve = learn_policy(
        policy.to(run.device), net.to(run.device), rewards.reach if task.name == "reach" else rewards.push,
        episodes_from(torch.from_numpy(data.states[:, 0])), horizon=task.horizon, iterations=budget["iterations"],
        episodes=EPISODES[run.scale], seed=1000 * run.seed,
        record_every=max(1, budget["iterations"] // 10), measure=lambda p: assess(p, net, task, seed=run.seed + 1),
        checkpoint=checkpoint, progress=f"{short(task.env)} policy in {model} through {prior}",
    )  # fmt: skip
    header = {
        "fingerprint": fingerprint(task.env), "made_from": made_from, "budget": budget, "model": model, "prior": prior,
        "seed": run.seed, "scale": run.scale, "curve": asdict(curve), "seconds": curve.seconds[-1],
        "torch": torch.__version__, "threads": torch.get_num_threads(), "device": run.device,
        "finished": time.strftime("%Y-%m-%d"),
    }  # fmt: skip
    artifacts.save_model(own, policy.cpu(), header)
    shutil.rmtree(checkpoint)
    return policy, artifacts.read_header(own)


def stored_budget(run: Run, task: Task, model: str, prior: str) -> dict[str, int] | None:
    """Copies and iterations of the policy that the run's folder holds, for ``learn`` to find it again; else None."""
    path = _path(run, task, model, prior)
    return dict(artifacts.read_header(path)["budget"]) if path.exists() else None


def _path(run: Run, task: Task, model: str, prior: str) -> Path:
    return run.folder(f"models/{short(task.env)}") / f"policy-{model}-{prior}.safetensors"


@torch.no_grad()
def within_data(run: Run, task: Task, policy: Any) -> torch.Tensor:
    """Share of the steps that a policy executes on a task whose torques are as the training data's (claim C16): (M,),
    one per copy. See ``invariants.within``."""
    many = task.times(policy.copies)
    known = torch.from_numpy(dataset(run, task.env, "train").actions)
    shares = within(execute(many, controller(policy, many.target)).actions, known)
    return shares.unflatten(0, (policy.copies, -1)).mean(1)


@torch.no_grad()
def assess(policy: Any, model: Any, task: Task, *, seed: int) -> dict[str, torch.Tensor]:
    """What a policy earns on a task and what the model promises there, without action noise: means, one per copy."""
    many = task.times(policy.copies)
    done = execute(many, controller(policy, many.target))
    start, draw = torch.from_numpy(many.start).float(), torch.Generator().manual_seed(seed)
    promised = many.reward(*imagine(policy, model, start, many.target, horizon=task.horizon, noise=0.0, generator=draw))
    found = {
        "return_true": done.executed_return, "return_predicted": promised.sum(-1),
        "final_distance": done.final_distance,
        "success": (done.final_distance < TOLERANCE).float(),
    }  # fmt: skip
    return {name: values.unflatten(0, (policy.copies, -1)).mean(1) for name, values in found.items()}
