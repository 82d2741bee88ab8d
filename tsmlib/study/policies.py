"""Policies learned inside trained models, kept in the run's folder."""

import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple, cast

import pandas as pd
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.actions import within
from tsmlib.figures.method import SEARCH_SPACES, Method
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.tasks import Task
from tsmlib.policies.learning import LearningOptions, episodes_from, imagine, learn_policy
from tsmlib.policies.networks import OneStepPolicy, Policy, SegmentPolicy, controller
from tsmlib.storage import artifacts, tables
from tsmlib.storage.files import Json
from tsmlib.study.comparison import table
from tsmlib.study.data import dataset, fingerprint, sizes
from tsmlib.study.models import TrainedModel, load_or_train, load_prior
from tsmlib.study.results.policies import EPISODES, GRADIENTS, finished, learning_curves, learning_rows, plateau_rows
from tsmlib.study.results.table import PolicyHeader, Row, of_task, select
from tsmlib.study.runs import Run
from tsmlib.trajectory import Trajectories


@dataclass(frozen=True)
class Budget:
    """How a policy is learned: copies side by side from different seeds, and iterations; 0 means smoke 4, laptop 300,
    paper 2,200."""

    copies: int = 1
    iterations: int = 0


USUAL = Budget()


class Learned(NamedTuple):
    """A learned policy, and the header of its file: learning curve, seconds, seed, scale."""

    policy: Policy
    header: PolicyHeader


def learn(run: Run, task: Task, method: Method, budget: Budget = USUAL) -> Learned:
    """A policy learned inside a trained model.

    method: a model and a search space, latent (a SegmentPolicy, acting through the action prior) or direct (a
    OneStepPolicy). Episodes start as those of the training data, so the environment is not asked. Its executed
    return on ``task`` is measured at ten points along the way, beside the return that the model predicts there
    (``assess``); neither has a part in learning.

    From the run's folder; else, at scale laptop with seed 0, the shipped one, whatever its budget; else learned now,
    going on from its checkpoint if it was stopped.
    """
    if method.search_space not in SEARCH_SPACES or budget.iterations < 0 or budget.copies < 1:
        raise ValueError(
            f"search space is {method.search_space!r}, iterations {budget.iterations}, copies {budget.copies}; "
            f"expected {' or '.join(SEARCH_SPACES)}, 0 (the scale's default) or more iterations, and at least one copy"
        )
    if not task.is_standard:  # a file of a policy is known by the name of its task
        raise ValueError(
            f"task {task.name!r} has a reward of its own; expected the paper's. Learn for it with tsmlib.learn_policy"
        )
    net = load_or_train(run, task.env, method.model).model
    prior = load_prior(run, task.env) if method.search_space == "latent" else None
    weights = {"model": artifacts.digest(net.state_dict())}
    if prior is not None:
        weights["prior"] = artifacts.digest(prior.state_dict())
    made_from: dict[str, Json] = {"task": task.name, "horizon": task.horizon, "seed": run.seed, "weights": weights}
    budget = complete(run, budget)
    own = _path(run, task.env, method)
    shipped = run.shipped / own.parent.name / own.name
    cls: type[Policy] = OneStepPolicy if prior is None else SegmentPolicy
    for path in [own, shipped] if run.scale == "laptop" and run.seed == 0 else [own]:
        if path.exists():
            header = cast(PolicyHeader, artifacts.read_header(path))
            if header.get("made_from") == made_from and (path == shipped or header.get("budget") == asdict(budget)):
                return Learned(artifacts.load_model(path, cls, expect=fingerprint(task.env)), header)
    print(
        f"{task.env}: no {method.search_space} policy learned in {method.model} at scale {run.scale}; learning it now, "
        f"{budget.iterations} iterations of 0.1 to 1 s. Stopped, it goes on from there the next time"
    )
    about: PolicyHeader = {"made_from": made_from, "budget": asdict(budget), "model": method.model,
             "search_space": method.search_space, "targets": len(task)}  # fmt: skip
    return _learn(run, task, net, prior, budget, own, about)


def complete(run: Run, budget: Budget) -> Budget:
    """The budget with the scale's iterations where it has none of its own."""
    return replace(budget, iterations=budget.iterations or run.pick(smoke=4, laptop=300, paper=2200))


def _learn(
    run: Run, task: Task, net: TrainedModel, prior: ActionPrior | None, budget: Budget, path: Path, about: PolicyHeader
) -> Learned:
    """Learn a policy and store it at ``path``. Resumes from the checkpoint beside it."""
    data = dataset(run, task.env, "train")
    policy, checkpoint = _initialise(run, data, prior, budget), path.with_suffix(".checkpoint")
    curve = learn_policy(
        policy.to(run.device), net.to(run.device), task.reward_for,
        episodes_from(torch.from_numpy(data.states[:, 0])),
        LearningOptions(
            horizon=task.horizon, iterations=budget.iterations, episodes=EPISODES[run.scale],
            record_every=max(1, budget.iterations // 10),
        ),
        seed=1000 * run.seed, measure=lambda p: assess(p, net, task, seed=run.seed + 1), checkpoint=checkpoint,
        progress=f"{path.parent.name}: {path.stem}",
    )  # fmt: skip
    header: dict[str, Json] = {
        **cast("dict[str, Json]", about), "fingerprint": fingerprint(task.env), "seed": run.seed, "scale": run.scale,
        "curve": asdict(curve), "seconds": curve.seconds[-1], "torch": torch.__version__,
        "threads": torch.get_num_threads(), "device": run.device, "finished": time.strftime("%Y-%m-%d"),
    }  # fmt: skip
    artifacts.save_model(path, policy.cpu(), header)
    shutil.rmtree(checkpoint)
    return Learned(policy, cast(PolicyHeader, artifacts.read_header(path)))


def _initialise(run: Run, data: Trajectories, prior: ActionPrior | None, budget: Budget) -> Policy:
    """The policy as learning starts."""
    (dx, du), seed = (data.states.shape[2], data.actions.shape[2]), 1000 * run.seed
    policy: Policy
    if prior is None:
        policy = OneStepPolicy(dx, du, angles=data.angles, copies=budget.copies, seed=seed)
    else:
        policy = SegmentPolicy(dx, prior, angles=data.angles, copies=budget.copies, seed=seed)
    policy.features.fit(torch.from_numpy(data.states), data.lengths)
    return policy


def policy_rows(run: Run, wanted: Sequence[tuple[Task, Method, Budget]]) -> list[Row]:
    """Rows of policies: how each was learned and what its model and prior have cost, its steps within the data's
    torques, and when those with a prior and the model-free ones came to their common plateau (``plateau_rows``), to
    which those of scale laptop never come.

    Learned where they are missing.
    """
    rows: list[Row] = []
    for task, method, budget in wanted:
        found, words = learn(run, task, method, budget), [method.model] + ["prior"] * (method.search_space == "latent")
        seconds = sum(load_or_train(run, task.env, word).header["seconds"] for word in words)
        rows += learning_rows(
            found.header, samples=100 * sizes(run, task.env)["train"], train_seconds=seconds,
            n=found.header.get("targets", 100),  # those that it was measured on as it was learned
            within_data=within_data(run, task, found.policy).tolist(),
        )  # fmt: skip
    if run.scale == "laptop":
        return rows
    free = finished(select(table(run, "model_free"), model=GRADIENTS).drop(columns="source"))
    curves = learning_curves(tables.frame(pd.concat([tables.frame(rows), free[free["seed"] == run.seed]])))
    for task in {task.env: task for task, *_ in wanted}.values():
        compared = {way: own for way, own in curves[task.name].items() if way.search_space != "direct"}
        common = of_task(task, run) | {"horizon": None}
        rows += plateau_rows(compared, common, steps=task.horizon * EPISODES[run.scale])
    return rows


def stored_budget(run: Run, env: str, method: Method) -> Budget | None:
    """How the policy that the run's folder holds was learned, for ``learn`` to find it again; else None."""
    path = _path(run, env, method)
    return Budget(**cast("dict[str, int]", artifacts.read_header(path)["budget"])) if path.exists() else None


def _path(run: Run, env: str, method: Method) -> Path:
    return run.dir / "models" / EnvSpec.parse(env).name / f"{file_name(method)}.safetensors"


def file_name(method: Method) -> str:
    """What the file of a policy is called, without suffix."""
    return f"policy-{method.model}-{method.search_space}"


def execute_policy(task: Task, policy: Policy) -> Trial:
    """Every copy of a policy on every target, one copy after the other."""
    many = task.times(policy.copies)
    return execute(many, controller(policy, many.target), past_len=policy.past_len)


@torch.no_grad()
def within_data(run: Run, task: Task, policy: Policy) -> Tensor:
    """Share of the steps that a policy executes on a task whose torques are as the training data's (claim C16): (M,),
    one per copy. See ``actions.within``."""
    known = torch.from_numpy(dataset(run, task.env, "train").actions)
    shares = within(execute_policy(task, policy).actions, known)
    return shares.unflatten(0, (policy.copies, -1)).mean(1)


@torch.no_grad()
def assess(policy: Policy, model: DynamicsModel, task: Task, *, seed: int) -> dict[str, Tensor]:
    """Executed and predicted return of a policy on a task, without action noise: means, one per copy."""
    many, done = task.times(policy.copies), execute_policy(task, policy)
    start, draw = torch.from_numpy(many.start).float(), torch.Generator().manual_seed(seed)
    seen = imagine(policy, model, start, many.target, horizon=task.horizon, noise=0.0, generator=draw)
    found = {
        "return_true": done.executed_return, "return_predicted": many.reward(*seen).sum(-1),
        "final_distance": done.final_distance,
        "success": cast("Tensor", done.success).float(),
    }  # fmt: skip
    return {name: values.unflatten(0, (policy.copies, -1)).mean(1) for name, values in found.items()}
