"""Policies learned inside trained models, kept in the run's folder."""

import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self, cast

import pandas as pd
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.actions import within
from tsmlib.plots.method import SEARCH_SPACES, Method
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.tasks import Task
from tsmlib.policies.learning import (
    Draw,
    LearningCurve,
    LearningOptions,
    episodes_from,
    imagine,
    learn_policy,
)
from tsmlib.policies.networks import OneStepPolicy, Policy, SegmentPolicy, controller
from tsmlib.policies.stacked import learn_stacked
from tsmlib.storage import artifacts, tables
from tsmlib.storage.files import Json
from reproduction.comparison import table
from reproduction.data import dataset, fingerprint, sizes
from reproduction.models import TrainedModel, load_or_train, load_prior
from reproduction.results.policies import (
    EARLY,
    EPISODES,
    gradients,
    learning_curves,
    learning_rows,
    plateau_rows,
)
from reproduction.results.table import PolicyHeader, Row, of_task, select
from reproduction.runs import Run
from reproduction.seeds import make_as_one, require_seeds


@dataclass(frozen=True)
class Budget:
    """How a policy is learned: copies side by side from different seeds, and iterations; 0 means smoke 4, laptop 300,
    paper 2,200."""

    copies: int = 1
    iterations: int = 0


USUAL = Budget()
MEASURED = {
    "smoke": 2,
    "laptop": 8,
    "paper": 100,
}  # first targets of a task that a learning curve is of, at most


class Learned(NamedTuple):
    """A learned policy, and the header of its file: learning curve, seconds, seed, scale."""

    policy: Policy
    header: PolicyHeader


def learn(run: Run, task: Task, method: Method, budget: Budget = USUAL) -> Learned:
    """A policy learned inside a trained model.

    method: a model and a search space, latent (a SegmentPolicy, acting through the action prior) or direct (a
    OneStepPolicy). Episodes start as those of the training data, so the environment is not asked. Its executed
    return on the first targets of ``task``, as many as ``MEASURED`` says, is measured at ten points along the way,
    beside the return that the model predicts there (``assess``); neither has a part in learning.

    From the run's folder; else, at scale laptop with seed 0, the shipped one, whatever its budget; else learned now,
    going on from its checkpoint if it was stopped.
    """
    asked = _Asked.of(run, task, method, budget)
    return asked.kept() or asked.learned()


def learn_as_one(
    runs: Sequence[Run], task: Task, method: Method, budget: Budget = USUAL
) -> list[Learned]:
    """``learn`` of runs with several seeds; those that lack the policy learn it as one (``learn_stacked``,
    ``make_as_one``)."""
    require_seeds(runs)
    asked = {run.seed: _Asked.of(run, task, method, budget) for run in runs}
    return make_as_one(
        f"{task.env}: the {method.search_space} policy in {method.model}",
        runs,
        lambda run: asked[run.seed].kept() is None,
        lambda lacking: _learn_as_one([asked[run.seed] for run in lacking]),
        lambda run: asked[run.seed].kept() or asked[run.seed].learned(),
    )


def complete(run: Run, budget: Budget) -> Budget:
    """The budget with the scale's iterations where it has none of its own."""
    return replace(
        budget, iterations=budget.iterations or run.pick(smoke=4, laptop=300, paper=2200)
    )


@dataclass(frozen=True)
class _Asked:
    """A policy that a run asks for: what it is learned in, and where its file is."""

    run: Run
    task: Task
    method: Method
    net: TrainedModel
    prior: ActionPrior | None
    budget: Budget
    path: Path

    @classmethod
    def of(cls, run: Run, task: Task, method: Method, budget: Budget) -> Self:
        """With its models, trained where they are missing."""
        if method.search_space not in SEARCH_SPACES or budget.iterations < 0 or budget.copies < 1:
            raise ValueError(
                f"search space is {method.search_space!r}, iterations {budget.iterations}, copies {budget.copies}; "
                f"expected {' or '.join(SEARCH_SPACES)}, 0 (the scale's default) or more iterations, and at least one "
                "copy"
            )
        if not task.is_standard:  # a file of a policy is known by the name of its task
            raise ValueError(
                f"task {task.name!r} has a reward of its own; expected the paper's. Learn for it with "
                "tsmlib.learn_policy"
            )
        net = load_or_train(run, task.env, method.model).model
        prior = load_prior(run, task.env) if method.search_space == "latent" else None
        return cls(
            run, task, method, net, prior, complete(run, budget), _path(run, task.env, method)
        )

    @property
    def made_from(self) -> dict[str, Json]:
        """What a file has to be made from to be this policy."""
        weights: dict[str, Json] = {"model": artifacts.digest(self.net.state_dict())}
        if self.prior is not None:
            weights["prior"] = artifacts.digest(self.prior.state_dict())
        return {
            "task": self.task.name,
            "horizon": self.task.horizon,
            "seed": self.run.seed,
            "weights": weights,
        }

    def kept(self) -> Learned | None:
        """The policy that is there."""
        run, shipped = self.run, self.run.shipped / self.path.parent.name / self.path.name
        cls: type[Policy] = OneStepPolicy if self.prior is None else SegmentPolicy
        for path in (
            [self.path, shipped] if run.scale == "laptop" and run.seed == 0 else [self.path]
        ):
            if path.exists():
                header = cast(PolicyHeader, artifacts.read_header(path))
                asked = path == shipped or header.get("budget") == asdict(self.budget)
                if header.get("made_from") == self.made_from and asked:
                    return Learned(
                        artifacts.load_model(path, cls, expect=fingerprint(self.task.env)), header
                    )
        return None

    def learned(self) -> Learned:
        """The policy, learned now, going on from the checkpoint beside its file, and stored."""
        print(self.announcement())
        policy, title = (
            self.policy().to(self.run.device),
            f"{self.path.parent.name}: {self.path.stem}",
        )
        curve = learn_policy(
            policy,
            self.net.to(self.run.device),
            self.task.reward_for,
            self.episodes(),
            self.options(),
            seed=self.seed,
            measure=self.measure,
            checkpoint=self.checkpoint,
            progress=title,
        )
        return self.store(policy, curve)

    def announcement(self, seeds: str = "") -> str:
        """What is going to be learned, and how long; seeds: of several as one."""
        replaced = ""
        if self.path.exists() and (there := _budget(self.path)) != self.budget:
            replaced = f" with {self.budget}, but one with {there}, which is replaced"
        return (
            f"{self.task.env}: no {self.method.search_space} policy learned in {self.method.model} at scale "
            f"{self.run.scale}{seeds}{replaced}; learning it now, {self.budget.iterations} iterations of 0.1 to 1 s"
            f"{', several times that for all' if seeds else ''}. Stopped, it goes on from there the next time"
        )

    @property
    def seed(self) -> int:
        """Of the first copy."""
        return 1000 * self.run.seed

    @property
    def checkpoint(self) -> Path:
        """Folder beside the file."""
        return self.path.with_suffix(".checkpoint")

    def policy(self) -> Policy:
        """The policy as learning starts."""
        data, (copies, seed) = (
            dataset(self.run, self.task.env, "train"),
            (self.budget.copies, self.seed),
        )
        dx, du = data.states.shape[2], data.actions.shape[2]
        policy: Policy
        if self.prior is None:
            policy = OneStepPolicy(dx, du, angles=data.angles, copies=copies, seed=seed)
        else:
            policy = SegmentPolicy(dx, self.prior, angles=data.angles, copies=copies, seed=seed)
        policy.features.fit(torch.from_numpy(data.states), data.lengths)
        return policy

    def episodes(self) -> Draw:
        """Starts as those of the training data."""
        return episodes_from(
            torch.from_numpy(dataset(self.run, self.task.env, "train").states[:, 0])
        )

    def options(self) -> LearningOptions:
        """Schedule of the run's scale and the budget."""
        n = self.budget.iterations
        return LearningOptions(
            horizon=self.task.horizon,
            iterations=n,
            episodes=EPISODES[self.run.scale],
            record_every=max(1, n // 10),
        )

    @property
    def measured(self) -> Task:
        """What the learning curve is of, the same for every notebook that asks for the policy at a scale."""
        return self.task.take(min(len(self.task), MEASURED[self.run.scale]))

    def measure(self, policy: Policy) -> dict[str, Tensor]:
        """Numbers of the learning curve."""
        return assess(policy, self.net, self.measured, seed=self.run.seed + 1)

    def store(self, policy: Policy, curve: LearningCurve) -> Learned:
        """The policy as it is kept in the run's folder."""
        header: dict[str, Json] = {
            "made_from": self.made_from,
            "budget": asdict(self.budget),
            "model": self.method.model,
            "search_space": self.method.search_space,
            "targets": len(self.measured),
            "fingerprint": fingerprint(self.task.env),
            "seed": self.run.seed,
            "scale": self.run.scale,
            "curve": asdict(curve),
            "seconds": curve.seconds[-1],
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
            "device": self.run.device,
            "finished": time.strftime("%Y-%m-%d"),
        }
        artifacts.save_model(self.path, policy.cpu(), header)
        shutil.rmtree(self.checkpoint)
        return Learned(policy, cast(PolicyHeader, artifacts.read_header(self.path)))


def _learn_as_one(asked: Sequence[_Asked]) -> None:
    """Learn the policies of several seeds as one and store each where its run finds it."""
    first, device = asked[0], asked[0].run.device
    print(first.announcement(f" with seeds {', '.join(str(each.run.seed) for each in asked)}"))
    policies = [each.policy().to(device) for each in asked]
    curves = learn_stacked(
        policies,
        [cast(torch.nn.Module, each.net.to(device)) for each in asked],
        first.task.reward_for,
        [each.episodes() for each in asked],
        first.options(),
        seeds=[each.seed for each in asked],
        measures=[each.measure for each in asked],
        checkpoints=[each.checkpoint for each in asked],
        progress=f"{first.path.parent.name}: {first.path.stem}, {len(asked)} seeds",
    )
    for each, policy, curve in zip(asked, policies, curves, strict=True):
        each.store(policy, curve)


def policy_rows(run: Run, wanted: Sequence[tuple[Task, Method, Budget]]) -> list[Row]:
    """Rows of policies: how each was learned and what its model and prior have cost, its steps within the data's
    torques, and when those with a prior and the model-free ones came to their common plateau (``plateau_rows``), to
    which those of scale laptop never come. No seconds of what was trained or learned as one of several: they are of
    all together.

    Learned where they are missing. Early records (``early_rows``) are rows, too, where the run has them.
    """
    rows: list[Row] = []
    for task, method, budget in wanted:
        found, words = (
            learn(run, task, method, budget),
            [method.model] + ["prior"] * (method.search_space == "latent"),
        )
        trained = [load_or_train(run, task.env, word).header for word in words]
        seconds = (
            None
            if any("copies" in each for each in trained)
            else sum(each["seconds"] for each in trained)
        )
        rows += learning_rows(
            found.header,
            samples=100 * sizes(run, task.env)["train"],
            train_seconds=seconds,
            n=found.header.get("targets", 100),  # those that it was measured on as it was learned
            within_data=within_data(run, task, found.policy).tolist(),
        )
        if (early := _early_path(run, task.env, method)).exists():
            rows += early_rows(run, [(task, method, _budget(early))])
    return rows + plateaus(run, [task for task, *_ in wanted], tables.frame(rows))


def plateaus(run: Run, tasks: Iterable[Task], learned: pd.DataFrame) -> list[Row]:
    """``plateau_rows`` of one seed's tasks, from the rows of its policies, ``early_rows`` among them, and of those
    without a model. None where either are missing, on a noisy or late arm, on which nobody learned without a model, or
    at scale laptop, whose policies come to no plateau."""
    if run.scale == "laptop":
        return []
    free = gradients(table(run, "model_free").drop(columns="source"))
    both, rows = tables.frame(pd.concat([learned, free[free["seed"] == run.seed]])), list[Row]()
    for task in {task.env: task for task in tasks}.values():
        own = select(
            both, env=task.env, noise=None, delay=None
        )  # none of an imperfect arm, whose id is no row's env
        curves, early = (learning_curves(own, subset).get(task.name, {}) for subset in ("", EARLY))
        compared = {way: curve for way, curve in curves.items() if way.search_space != "direct"}
        if {bool(way.search_space) for way in compared} == {True, False}:
            common, steps = (
                of_task(task, run) | {"horizon": None},
                task.horizon * EPISODES[run.scale],
            )
            rows += plateau_rows(compared, common, steps=steps, early=early)
    return rows


def early_rows(run: Run, wanted: Sequence[tuple[Task, Method, Budget]]) -> list[Row]:
    """True returns of the first iterations of policies, which are learned again as far as their budgets say, with ten
    records on the way, in the run's folder ``early``. An iteration does the same whatever the budget, so these are the
    policies that longer learning goes on with, if it is in the same model and through the same prior.
    """
    rows = list[Row]()
    for task, method, budget in wanted:
        asked = replace(
            _Asked.of(run, task, method, budget), path=_early_path(run, task.env, method)
        )
        header = (asked.kept() or asked.learned()).header
        found = learning_rows(header, samples=0, train_seconds=None, n=header.get("targets", 100))
        rows += [row | {"subset": EARLY} for row in found if row["metric"] == "return_true"]
    return rows


def stored_budget(run: Run, env: str, method: Method) -> Budget | None:
    """How the policy that the run's folder holds was learned, for ``learn`` to find it again; else None.

    For tables of whatever was learned; a notebook asks for its own budget, by which ``learn`` learns anew.
    """
    path = _path(run, env, method)
    return _budget(path) if path.exists() else None


def _budget(path: Path) -> Budget:
    """How the policy in a file was learned."""
    return Budget(**cast("dict[str, int]", artifacts.read_header(path)["budget"]))


def _path(run: Run, env: str, method: Method) -> Path:
    return run.dir / "models" / EnvSpec.parse(env).name / f"{file_name(method)}.safetensors"


def _early_path(run: Run, env: str, method: Method) -> Path:
    return (
        run.dir / EARLY / EnvSpec.parse(env).name / f"{file_name(method)}-{EARLY}.safetensors"
    )  # none ships


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
    seen = imagine(
        policy, model, start, many.target, horizon=task.horizon, noise=0.0, generator=draw
    )
    found = {
        "return_true": done.executed_return,
        "return_predicted": many.reward(*seen).sum(-1),
        "final_distance": done.final_distance,
        "success": cast("Tensor", done.success).float(),
    }
    return {
        name: values.unflatten(0, (policy.copies, -1)).mean(1) for name, values in found.items()
    }
