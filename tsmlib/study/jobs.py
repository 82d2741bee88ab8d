"""Jobs: data sets, models, scores, plans and policies that a run keeps in its folder, each with what it needs.

A notebook's are listed by ``needs``. ``parallel.precompute`` makes them on this machine, ``workflow`` on any number.
Whether a kept file still holds is judged where it is made, from its header, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import ClassVar, Protocol, runtime_checkable

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation import prediction
from tsmlib.figures.method import Method
from tsmlib.storage.files import Json
from tsmlib.study import models, plans, policies, predictions, zoo
from tsmlib.study.data import dataset, sizes
from tsmlib.study.plans import CANDIDATES, TORQUES
from tsmlib.study.policies import USUAL, Budget
from tsmlib.study.results.policies import EPISODES
from tsmlib.study.runs import RESULTS, Run
from tsmlib.study.tasks import load_task


class Job(Protocol):
    """Something that a run keeps. Two jobs of one name are the same."""

    @property
    def kind(self) -> str:
        """Data, model, scores, plan or policy."""

    @property
    def name(self) -> str:
        """Its file, relative to the run's folder and without suffix."""

    def needs(self, run: Run) -> Sequence[Job]:
        """What has to be there before."""

    def make(self, run: Run) -> object:
        """Find it, or make it and keep it."""

    def settings(self, run: Run) -> Json:
        """Numbers that decide what is made. A workflow does the job, and what needs it, again where they change."""

    def seconds(self, run: Run) -> float:
        """About how long it takes on one core."""

    def ships(self, run: Run) -> bool:
        """Whether one comes with the package that a run may take in place of its own."""


@runtime_checkable
class SeedsJob(Job, Protocol):
    """A job that several seeds may do as one."""

    def make_as_one(self, runs: Sequence[Run]) -> object:
        """Find it in runs of several seeds; for those that lack it, make it as one."""


@dataclass(frozen=True)
class Data:
    """A split of an environment's data."""

    env: str
    split: str
    kind: ClassVar[str] = "data"

    @property
    def name(self) -> str:
        return f"data/{EnvSpec.parse(self.env).name}/{self.split}"

    def needs(self, run: Run) -> Sequence[Job]:
        return ()

    def make(self, run: Run) -> object:
        return dataset(run, self.env, self.split)

    def settings(self, run: Run) -> Json:
        return {"n": sizes(run, self.env)[self.split]}

    def seconds(self, run: Run) -> float:
        return sizes(run, self.env)[self.split] / 100

    def ships(self, run: Run) -> bool:
        return False


@dataclass(frozen=True)
class Model:
    """A model of the zoo, by its word."""

    env: str
    word: str
    kind: ClassVar[str] = "model"

    @property
    def name(self) -> str:
        return f"models/{EnvSpec.parse(models.trained_on(self.env, self.word)).name}/{self.word}"

    def needs(self, run: Run) -> Sequence[Job]:
        if self.ships(run):
            return ()
        return [Data(models.trained_on(self.env, self.word), split) for split in ("train", "validation")]

    def make(self, run: Run) -> object:
        return models.load_or_train(run, self.env, self.word)

    def make_as_one(self, runs: Sequence[Run]) -> object:
        return models.load_or_train_as_one(runs, self.env, self.word)

    def settings(self, run: Run) -> Json:
        env = models.trained_on(self.env, self.word)
        return {
            "schedule": [stage.stated() for stage in models.schedule(run, env, self.word)],
            "arguments": zoo.find(self.word).arguments(EnvSpec.parse(env)),
        }

    def seconds(self, run: Run) -> float:
        return models.training_seconds(run, models.trained_on(self.env, self.word), self.word)

    def ships(self, run: Run) -> bool:
        return _shipped(run, models.trained_on(self.env, self.word), self.word)


@dataclass(frozen=True)
class Scores:
    """Scores of a model on test episodes, open loop or of ``segments`` from the true past."""

    env: str
    model: str
    segments: bool = False
    kind: ClassVar[str] = "scores"

    @property
    def name(self) -> str:
        return f"scores/{EnvSpec.parse(self.env).name}/{self.model}{'-segments' * self.segments}"

    def needs(self, run: Run) -> Sequence[Job]:
        return [Model(self.env, self.model), Data(self.env, "validation"), Data(self.env, "test")]

    def make(self, run: Run) -> object:
        return predictions.scores(run, self.env, self.model, segments=self.segments)

    def settings(self, run: Run) -> Json:
        return {"version": prediction.VERSION, "rows": prediction.ROWS, **predictions.score_sizes(run)}

    def seconds(self, run: Run) -> float:
        return run.pick(smoke=1, laptop=4, paper=40)

    def ships(self, run: Run) -> bool:
        return False


@dataclass(frozen=True)
class Plan:
    """Plans for the first ``n`` targets of an environment's task; see ``plans.plan``."""

    env: str
    n: int
    method: Method
    iterations: int = 0
    every: int = 0
    kind: ClassVar[str] = "plan"

    @property
    def name(self) -> str:
        return f"plans/{plans.file_name(self.env, self.method, iterations=self.iterations, every=self.every)}"

    def needs(self, run: Run) -> Sequence[Job]:
        first = [Plan(self.env, self.n, self.method)] if self.every else []  # which a closed loop begins with
        return [*(Model(self.env, word) for word in plans.models_of(self.method)), *first]

    def make(self, run: Run) -> object:
        task = load_task(self.env).take(self.n)
        return plans.plan(run, task, self.method, iterations=self.iterations, every=self.every)

    def settings(self, run: Run) -> Json:
        iterations = self.iterations or plans.usual_iterations(run, self.method, again=bool(self.every))
        return {"version": plans.VERSION, "n": self.n, "candidates": CANDIDATES[run.scale], "iterations": iterations}

    def seconds(self, run: Run) -> float:
        each = 5.0 if self.method.model == "oracle" else 1.0  # for each target, as rows of 05_control say
        longer = self.iterations / plans.usual_iterations(run, self.method) if self.iterations else 1
        return self.n * each * longer * (3 if self.every else 1) * run.pick(smoke=0.01, laptop=0.5, paper=1)

    def ships(self, run: Run) -> bool:
        file = plans.file_name(self.env, self.method, iterations=self.iterations, every=self.every)
        return run.scale == "laptop" and self.method.model == "oracle" and (RESULTS / f"{file}.safetensors").exists()


@dataclass(frozen=True)
class Policy:
    """A policy learned inside a model, measured on the first ``n`` targets; see ``policies.learn``."""

    env: str
    n: int
    method: Method
    budget: Budget = USUAL
    kind: ClassVar[str] = "policy"

    @property
    def name(self) -> str:
        return f"models/{EnvSpec.parse(self.env).name}/{policies.file_name(self.method)}"

    def needs(self, run: Run) -> Sequence[Job]:
        words = [self.method.model] + ["prior"] * (self.method.search_space == "latent")
        return [*(Model(self.env, word) for word in words), Data(self.env, "train")]

    def make(self, run: Run) -> object:
        return policies.learn(run, load_task(self.env).take(self.n), self.method, self.budget)

    def make_as_one(self, runs: Sequence[Run]) -> object:
        return policies.learn_as_one(runs, load_task(self.env).take(self.n), self.method, self.budget)

    def settings(self, run: Run) -> Json:
        return {**asdict(policies.complete(run, self.budget)), "episodes": EPISODES[run.scale]}

    def seconds(self, run: Run) -> float:
        each = 0.4 if self.method.search_space == "latent" else 0.1  # for each update, as rows of 05_control say
        return policies.complete(run, self.budget).iterations * each * run.pick(smoke=0.5, laptop=1.0, paper=1.0)

    def ships(self, run: Run) -> bool:
        return _shipped(run, self.env, policies.file_name(self.method))


def _shipped(run: Run, env: str, file: str) -> bool:
    """Whether a model or policy comes with the package: for scale laptop and seed 0."""
    path = run.shipped / EnvSpec.parse(env).name / f"{file}.safetensors"
    return run.scale == "laptop" and run.seed == 0 and path.exists()


def complete(run: Run, wanted: Iterable[Job]) -> dict[str, Job]:
    """Name -> job: those that are wanted and all that they need, each after what it needs."""
    found: dict[str, Job] = {}

    def add(job: Job) -> None:
        if job.name not in found:
            for other in job.needs(run):
                add(other)
            found[job.name] = job

    for job in wanted:
        add(job)
    return found


def plan_jobs(env: str, n: int, methods: Iterable[Method], *, iterations: int = 0, every: int = 0) -> list[Job]:
    """A job for each method that plans; random and zero torques need none."""
    return [Plan(env, n, each, iterations, every) for each in methods if each.model not in TORQUES]
