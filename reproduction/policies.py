"""Policies learned inside trained models (tables 05 and 06)."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path

import torch

import tsmlib
from reproduction.episodes import load_data, load_model, load_prior
from reproduction.measures.actions import within
from reproduction.runs import Run, env_id
from reproduction.tables import Row, place
from tsmlib import rewards
from tsmlib.envs import fingerprint
from tsmlib.models.base import DynamicsModel
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.policies.imagination import imagine
from tsmlib.policies.learning import episodes_from
from tsmlib.policies.networks import Policy, controller
from tsmlib.storage import artifacts

NEAR = 0.05  # m: a target that is reached (claim C42)
UNITS = {"return_true": "m", "return_predicted": "m", "final_distance": "m", "success": "share"}


def the_task(run: Run, name: str) -> Task:
    """The test targets that a learning curve is of."""
    return tsmlib.load_task(env_id(name)).take(run.pick(2, 8, 100))


def make_policy(run: Run, name: str, policy_name: str, path: Path) -> Policy:
    """A policy such as ``tsm-latent``: one that acts through the prior, or ``direct``; with
    ``value`` a direct one that learns short pieces and the value of the rest.

    Its learning curve is in the file's header. Learning that was killed goes on.
    """
    word, space = policy_name.split("-")
    net, data, task = (
        load_model(run, name, word),
        load_data(run, name, "train"),
        the_task(run, name),
    )
    dx, du = data.states.shape[2], data.actions.shape[2]
    seed = 1000 * run.seed
    how = {"angles": data.angles, "seed": seed}
    if space == "value":
        tip, block = rewards.TIP.start, rewards.BLOCK.start
        places = (tip, block) if task.name == "push" else (tip,)
        policy: Policy = tsmlib.OneStepPolicy(dx, du, hidden=256, places=places, **how)
    elif space == "latent":
        policy = tsmlib.SegmentPolicy(dx, load_prior(run, name), **how)
    else:
        policy = tsmlib.OneStepPolicy(dx, du, **how)
    policy.features.fit(data)
    n = run.pick(4, 300, 2200 if name == "Reacher" else 880)
    options = tsmlib.LearningOptions(
        horizon=task.horizon,
        iterations=n,
        episodes=run.pick(4, 20, 20),
        record_every=run.pick(1, 30, 110),
    )
    if space == "value":
        n = run.pick(4, 500, 3000)
        options = tsmlib.LearningOptions.with_value(
            horizon=task.horizon, iterations=n, record_every=max(1, n // 12)
        )
    checkpoint = path.with_suffix(".checkpoint")
    curve = tsmlib.learn_policy(
        policy,
        net,
        task.reward_for,
        episodes_from(torch.from_numpy(data.states[:, 0])),
        options,
        seed=seed,
        measure=partial(assess, model=net, task=task, seed=run.seed + 1),
        checkpoint=checkpoint,
        progress=f"{name} {policy_name}",
    )
    header = {"fingerprint": fingerprint(task.env), "curve": asdict(curve), "targets": len(task)}
    artifacts.save_model(path, policy, header)
    shutil.rmtree(checkpoint)
    return policy


@torch.no_grad()
def assess(policy: Policy, model: DynamicsModel, task: Task, *, seed: int) -> dict[str, float]:
    """Executed and predicted return of a policy, without noise: means."""
    done = executed(policy, task)
    start, draw = torch.from_numpy(task.start).float(), torch.Generator().manual_seed(seed)
    seen = imagine(
        policy, model, start, task.target, horizon=task.horizon, noise=0.0, generator=draw
    )
    found = {
        "return_true": done.executed_return,
        "return_predicted": task.reward(*seen).sum(-1),
        "final_distance": done.final_distance,
        "success": (done.final_distance <= task.tolerance).float(),
    }
    return {k: float(values.mean()) for k, values in found.items()}


def executed(policy: Policy, task: Task) -> Trial:
    """A policy on every target."""
    return tsmlib.execute(task, controller(policy, task.target), past_len=policy.past_len)


@torch.no_grad()
def learning_rows(run: Run, name: str, policy_name: str) -> list[Row]:
    """The learning curve of a policy, the share of its torques within the data's (claim C16), and
    the share of targets that it reaches."""
    path, task = run.require(f"policies/{name}/{policy_name}"), the_task(run, name)
    word, space = policy_name.split("-")
    kind = tsmlib.SegmentPolicy if space == "latent" else tsmlib.OneStepPolicy
    policy, header = artifacts.load_model(path, kind), artifacts.read_header(path)
    curve, data = header["curve"], load_data(run, name, "train")
    about = place(task.env) | {"task": task.name, "model": word, "search_space": space}
    about |= {"planner": "policy", "execution": "policy"}
    measured = {k: torch.tensor(values) for k, values in curve["measured"].items()}
    measured["exploitation_gap"] = measured["return_predicted"] - measured["return_true"]
    rows = [
        about | {"iteration": i, "metric": k, "value": v, "copy": 0, "n": header["targets"]}
        for k, values in measured.items()
        for i, v in zip(curve["iteration"], values.tolist(), strict=True)
    ]
    rows += [
        about | {"iteration": i, "metric": "seconds", "value": s, "unit": "s"}
        for i, s in zip(curve["iteration"], curve["seconds"], strict=True)
    ]
    trial, known = executed(policy, task), torch.from_numpy(data.actions)
    ends = {"within_data": within(trial.actions, known)}
    ends["success50"] = (trial.final_distance < NEAR).float()
    about |= {"iteration": curve["iteration"][-1], "n": len(task)}
    about_data = {"metric": "samples", "value": 100 * len(data), "unit": "steps"}
    return [
        *rows,
        about | about_data,
        *(
            about | {"metric": k, "value": float(values.mean()), "unit": "share", "copy": 0}
            for k, values in ends.items()
        ),
    ]
