"""What each notebook needs, environment by environment: models, scores, plans and policies, declared here alone.

``needs`` lists it as jobs. A notebook's first cell makes them ahead (``parallel.precompute``), a workflow before the
notebook begins. What a notebook asks for beyond ``needs`` it makes when it comes to it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE, EnvSpec
from tsmlib.figures.method import Method
from tsmlib.study import zoo
from tsmlib.study.data import SPLITS, parse_choice
from tsmlib.study.jobs import Data, Job, Model, Policy, Scores, complete, plan_jobs
from tsmlib.study.policies import Budget
from tsmlib.study.results.planning import BASELINES, ORACLE, PAPER, PUSH, REACH
from tsmlib.study.runs import Run
from tsmlib.study.zoo import OURS, PAPERS, method, methods

ZERO, RANDOM = method("zero"), method("random")
WHOLE, ON_IMPERFECT = Budget(copies=3), Budget(copies=3, iterations=880)  # of policies at scale paper
BEGUN = Budget(iterations=20)  # at scale laptop, half a minute


def needs(run: Run) -> list[Job]:
    """The jobs of a run's notebook and all that these need, each after what it needs; none where nothing is kept."""
    declared = _NEEDS.get(run.notebook, lambda run: [])
    return list(complete(run, declared(run)).values())


class Choice(NamedTuple):
    """Environments and models that a notebook's parameters ``env`` and ``models`` name."""

    envs: list[str]
    words: list[str]


def choice(run: Run) -> Choice:
    """What 02_train, 03_predict, 04_latent or 06_robustness is about."""
    coded = zoo.words(cls=zoo.CODED)
    known = {
        "02_train": [*zoo.words("dynamics", "ablation", cls=zoo.CODED), "prior"], "04_latent": coded,
    }.get(run.notebook, zoo.words("dynamics"))  # fmt: skip
    envs = [REACH] if run.notebook == "06_robustness" else parse_choice("env", str(run.parameter("env")), ENV_IDS)
    return Choice(envs, parse_choice("models", str(run.parameter("models")), known))


APART = ("tsm", "tsm+teacher", "tsm+energy", "tsm+direct", "tsm+energy+direct")  # TSM with parts put in or taken away


def ablations(run: Run) -> list[tuple[str, str]]:
    """Environments and models that 03_predict scores beside those that are chosen, where all are; at smoke for seed 0
    alone."""
    envs, words = choice(run)
    told = run.scale == "paper" or (run.scale == "smoke" and run.seed == 0)
    if not told or PUSH not in envs or not set(zoo.words("dynamics")) <= set(words):
        return []
    choices = run.pick(smoke=["tsm+plain"], laptop=[], paper=list(zoo.words("choice")))
    return [(PUSH, word) for word in (*APART, "onestep", *choices)]


class Control(NamedTuple):
    """What 05_control plans with, for ``n`` targets of each task in ``envs``, and which policies it learns."""

    n: int
    envs: tuple[str, str]
    open_loop: dict[str, list[Method]]  # by the name of the task
    closed_loop: list[Method]  # pushing
    along_the_way: list[Method]  # pushing, for n_few targets; iterations of the planner, and those that are shown
    along_iterations: int
    along_at: list[int]
    converging: list[Method]  # both tasks, for n_few targets
    converging_iterations: int
    policies: list[tuple[str, Method, Budget]]

    @property
    def n_few(self) -> int:
        return min(25, self.n)


def control(run: Run) -> Control:
    """What 05_control asks for at a run's scale."""
    whole, smoke = run.scale == "paper", run.scale == "smoke"
    common = methods(run.pick(smoke=(PAPERS, OURS, "onestep"), laptop=(OURS, "onestep"), paper=PAPER), "cem")
    reach = [*methods([PAPERS], "adam"), method("oracle", "direct", "cem")] * whole
    push = [*methods((PAPERS, OURS, "onestep", "lstm"), "adam"), *methods(("onestep", "lstm"), "mppi"),
            method(OURS, "latent", "mppi")] * whole  # fmt: skip
    push += [method(PAPERS, "latent", "adam"), method(PAPERS, "direct", "mppi")] * smoke
    five = (PAPERS, OURS, "onestep", "multistep", "lstm")
    loops = run.pick(smoke=(OURS, "oracle"), laptop=(OURS,), paper=(*five, "oracle"))
    long, at = run.pick(smoke=(4, [0, 2, 4]), laptop=(0, []), paper=(40, [0, 1, 2, 4, 7, 10, 15, 20, 30, 40]))
    longer, searched = run.pick(smoke=(6, [PAPERS]), laptop=(0, []), paper=(500, [PAPERS, OURS]))
    return Control(
        n=int(str(run.parameter("n_targets"))) or run.pick(smoke=2, laptop=8, paper=100),
        envs=(REACH, PUSH),
        open_loop={name: [*common, *more, ORACLE, ZERO, RANDOM] for name, more in (("reach", reach), ("push", push))},
        closed_loop=methods(loops, "cem", ["latent"]),
        along_the_way=methods((OURS, "onestep"), "cem") if at else [], along_iterations=long, along_at=at,
        converging=methods(searched, "adam", ["latent"]), converging_iterations=longer,
        policies=_policies(run),
    )  # fmt: skip


def _policies(run: Run) -> list[tuple[str, Method, Budget]]:
    """Environment, method and budget, the smaller one where an iteration takes long: inside the paper's model, and on
    pushing. At scale laptop one begins to learn to reach."""
    inside = zoo.policies((PAPERS, OURS, *BASELINES))
    found: list[tuple[str, Method, Budget]] = []
    envs = run.pick(smoke=(REACH, PUSH), laptop=(REACH,), paper=(REACH, PUSH))
    for env, way in product(envs, run.pick(smoke=inside[:1], laptop=[method(OURS, "latent", "policy")], paper=inside)):
        whole = ON_IMPERFECT if way.model == PAPERS or env == PUSH else WHOLE
        found.append((env, way, run.pick(smoke=Budget(), laptop=BEGUN, paper=whole)))
    return found


class Robustness(NamedTuple):
    """What 06_robustness scores and learns. worlds: name -> environment, of the policies for ``n_targets`` targets."""

    words: list[str]
    worlds: dict[str, str]
    n_targets: int
    policies: dict[tuple[str, Method], Budget]  # by world
    noises: list[float]
    delays: list[int]
    subject: str
    rivals: list[str]
    cells: dict[tuple[str, str], str]  # environment and model -> the same without noise, whose states are true

    @property
    def scored(self) -> list[tuple[str, str]]:
        """Environments and models that are scored first."""
        return list(product((self.worlds["noise"], self.worlds["delay"]), self.words))


def robustness(run: Run) -> Robustness:
    """What 06_robustness asks for at a run's scale; the map of noise and delay of seed 0 alone."""
    words = choice(run).words
    words = run.pick(smoke=words[::2][:2], laptop=words, paper=words)
    ways = [method(*way, "policy") for way in (
        (PAPERS, "latent"), (PAPERS, "direct"), (OURS, "latent"),
        *((word, "direct") for word in ("onestep", "multistep", "lstm")),
    )]  # fmt: skip
    ways = run.pick(smoke=ways[:1], laptop=ways[:1], paper=ways)
    worlds = {"clean": REACH, "noise": imperfect(REACH, noise=NOISE), "delay": imperfect(REACH, delay=DELAY)}
    few = run.pick(smoke=Budget(), laptop=Budget(), paper=ON_IMPERFECT)
    usual = run.pick(smoke=Budget(), laptop=Budget(), paper=WHOLE)  # on the clean arm those of 05_control
    noises, delays = run.pick(
        smoke=([0.0], [0]), laptop=([0.0, 0.1, 0.25], [0, 5]), paper=([0.0, 0.1, 0.25], [0, 5])
    )  # fmt: skip
    compared = [OURS, "onestep", "lstm"]
    subject, *rivals = run.pick(smoke=words, laptop=compared, paper=compared)
    cells = [(REACH, 0.0, 0), (REACH, 0.1, 0), (REACH, NOISE, 0), (REACH, 0.0, DELAY), (REACH, NOISE, DELAY)]
    cells += [("tsm/ReacherObstacle-v0", 0.0, 0)]  # noise and delay there each cost the training of three models
    cells = run.pick(smoke=[cells[0], cells[-1]], laptop=[], paper=cells) if run.seed == 0 else []
    return Robustness(
        words, worlds, run.pick(smoke=10, laptop=100, paper=100),
        {(world, way): usual if world == "clean" and way.model != PAPERS else few
         for world, way in product(worlds, ways)},
        noises, delays, subject, rivals,
        {(imperfect(arm, noise=noise, delay=delay), word): imperfect(arm, delay=delay)
         for (arm, noise, delay), word in product(cells, (subject, *rivals))},
    )  # fmt: skip


class PriorPlans(NamedTuple):
    """What 07_action_prior plans with, for ``n`` targets of each task."""

    n: int
    envs: tuple[str, str]
    methods: list[Method]


def action_prior(run: Run) -> PriorPlans:
    """What 07_action_prior asks for at a run's scale."""
    few = [(PAPERS, "cem"), ("oracle", "cem")]
    many = [(PAPERS, "adam"), *few, (OURS, "cem")]
    ways = [way for model, planner in run.pick(smoke=many, laptop=few, paper=many) for way in methods([model], planner)]
    n = int(str(run.parameter("n_targets"))) or run.pick(smoke=2, laptop=10, paper=100)
    return PriorPlans(n, (REACH, PUSH), ways)


def _for_collect(run: Run) -> list[Job]:
    return [Data(env, split) for env, split in product(ENV_IDS, SPLITS)]


def _for_models(run: Run) -> list[Job]:
    envs, words = choice(run)
    return [*(Model(env, word) for env, word in product(envs, words)), *(Data(env, "test") for env in envs)]


def _for_predict(run: Run) -> list[Job]:
    pairs = [*product(*choice(run)), *ablations(run)]
    return [Scores(env, word, segments) for env, word in pairs for segments in (False, True)]


def _for_control(run: Run) -> list[Job]:
    asked, jobs = control(run), list[Job]()
    for env in asked.envs:
        jobs += plan_jobs(env, asked.n, asked.open_loop[EnvSpec.parse(env).task])
        jobs += plan_jobs(env, asked.n_few, asked.converging, iterations=asked.converging_iterations)
    jobs += plan_jobs(PUSH, asked.n, asked.closed_loop, every=10)
    jobs += plan_jobs(PUSH, asked.n_few, asked.along_the_way, iterations=asked.along_iterations)
    return [*jobs, *(Policy(env, asked.n, way, budget) for env, way, budget in asked.policies)]


def _for_robustness(run: Run) -> list[Job]:
    asked = robustness(run)
    jobs: list[Job] = [Data(REACH, split) for split in SPLITS]
    jobs += [Scores(env, word, segments) for env, word in asked.scored for segments in (False, True)]
    jobs += [Policy(asked.worlds[world], asked.n_targets, way, b) for (world, way), b in asked.policies.items()]
    jobs += [Scores(env, word, segments) for env, word in asked.cells for segments in (False, True)]
    return [*jobs, *(Data(env, "test") for env in dict.fromkeys(asked.cells.values()))]


def _for_action_prior(run: Run) -> list[Job]:
    asked, jobs = action_prior(run), list[Job]()
    for env in asked.envs:
        jobs += [Model(env, word) for word in (PAPERS, OURS, "prior")]
        jobs += [Data(env, split) for split in ("train", "test")]
        jobs += plan_jobs(env, asked.n, asked.methods)
    return jobs


_NEEDS: dict[str, Callable[[Run], list[Job]]] = {  # the others make what they show
    "01_collect": _for_collect, "02_train": _for_models, "03_predict": _for_predict, "04_latent": _for_models,
    "05_control": _for_control, "06_robustness": _for_robustness, "07_action_prior": _for_action_prior,
}  # fmt: skip
