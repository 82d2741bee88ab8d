"""Queries of claims to the results tables: numbers that every training seed has, and arithmetic over them.

    q.ll(TSM, REACHER) - q.ll(LSTM, REACHER) > 0.5                 a row per seed; the difference is paired by seed
    q.plans("return_true", TSM, PUSH).mean() > -5                  a row per target, averaged inside the seed
    (q.plans("iterations_to_95", TSM, PUSH) <= 100).share() > 0.5  share of a seed's targets for which it is true
    between(-0.1 * a, b, 0.1 * a)                                  equivalence: two one-sided tests of 5 %

An inequality of two numbers is a `Check`. Nothing is computed here: `evaluate.measure` gives ``Number.of`` the arrays
of each seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tsmlib.envs.spec import EnvSpec
from tsmlib.planning.tasks import HORIZON
from tsmlib.zoo import PAPERS

# Models, places and readings -----------------------------------------------------------------------------------------


class Model(NamedTuple):
    """A word of the column ``model``, and the search space of plans and policies."""

    word: str
    space: str = "direct"


class Place(NamedTuple):
    """An environment, and how imperfect the arm is. table: where its rows are, if not in the notebook's own."""

    env: str
    noise: float | str = ""
    delay: float | str = ""
    table: str = ""

    @property
    def horizon(self) -> int:
        """Steps of the task."""
        return HORIZON["push" if EnvSpec.parse(self.env).task == "push" else "reach"]

    @property
    def name(self) -> str:
        """ReacherPush, Reacher noise."""
        imperfect = " noise" * bool(self.noise) + " delay" * bool(self.delay)
        return self.env.removeprefix("tsm/").rpartition("-")[0] + imperfect


TSM, LAP = Model(PAPERS), Model(PAPERS, "latent")  # without and with its latent action prior
ONE_STEP, MULTI_STEP, LSTM = Model("onestep"), Model("multistep"), Model("lstm")
PETS = Model("pets")  # mbrl-lib's
ENSEMBLE = Model("ensemble+mse")
ONE_STEPS, BASELINES = (ONE_STEP, MULTI_STEP), (ONE_STEP, MULTI_STEP, LSTM)

REACHER, OBSTACLE, PUSH = map(
    Place, ("tsm/Reacher-v0", "tsm/ReacherObstacle-v0", "tsm/ReacherPush-v1")
)
CLEAN = REACHER._replace(table="06_robustness")
NOISE, DELAY = CLEAN._replace(noise=0.25), CLEAN._replace(delay=5)
PENDULUM, WEAK_MOTORS = Place("Pendulum-v1"), Place("tsm/Reacher-gain0.7-v0")
TASKS, ARMS = (REACHER, PUSH), (REACHER, OBSTACLE, PUSH)

# Other readings of the paper: name -> fields of Query. A1 to A34 are numbers of docs/deviations.md.
VARIANCE = {"A1d one variance per step and dimension": {"likelihood": "ll_horizon"}}
LIKELIHOODS = {"A1b one shared variance": {"likelihood": "ll_shared"}, **VARIANCE}
PROTOCOLS = {**LIKELIHOODS, "A6 segments from the true past": {"execution": "segments"}}
PAPERS_PLANNER = "A20 Adam from zero"  # the paper has Adam, and does not say where it begins
ADAM = {
    PAPERS_PLANNER: {"planner": "adam"},
    "A20 Adam from sampled starts": {"planner": "adam+starts"},
}
CLOCKS = {
    "with the samples of the data set": {"samples": "env_samples_to_90"},
    "by the clock": {"samples": "seconds_to_90"},
}


# Numbers and inequalities --------------------------------------------------------------------------------------------


class Term(NamedTuple):
    """Rows of a table, one per seed or, with ``trials``, one per target or copy of each seed.

    columns: column -> wanted value, '' if it is to be empty; a column that is not named may hold anything.
    curve: the column along which rows are a learning curve, of which the last value is meant, or the average.
    """

    table: str
    metric: str
    model: str
    place: Place
    columns: tuple[tuple[str, str | float], ...]
    trials: bool = False
    curve: str = ""
    average: bool = False

    @property
    def wanted(self) -> dict[str, str | float]:
        """Every column that is asked for, model and metric apart."""
        about = {
            "env": self.place.env,
            "noise": self.place.noise,
            "delay": self.place.delay,
            "scale": "paper",
        }
        return {**about, **dict(self.columns)}

    @property
    def text(self) -> str:
        """``nrmse(tsm, ReacherPush, steps_ahead 90)``."""
        told = [(name, value) for name, value in self.columns if name in TOLD and value != ""]
        said = [str(value) if isinstance(value, str) else f"{name} {value}" for name, value in told]
        words = [self.model, *said, "average" * self.average, self.place.name]
        return f"{self.metric}({', '.join(word for word in words if word not in ('', 'none'))})"


TOLD = (  # what tells a term from its like
    "planner",
    "search_space",
    "steps_ahead",
    "subset",
    "lag",
    "configuration",
    "iteration",
)
INFIX = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
NAMES = {"absolute": "abs", "negative": "-"}
COMPARED = {"greater": ">", "greater_equal": ">=", "less": "<", "less_equal": "<="}


@dataclass(frozen=True, eq=False)
class Number(np.lib.mixins.NDArrayOperatorsMixin):
    """A number of every seed: a formula over the rows that ``terms`` ask for, and how it is read.

    Sums, products and ``abs`` of numbers are numbers; their inequalities are checks.
    """

    text: str
    terms: tuple[Term, ...]
    of: Callable[[Mapping[Term, np.ndarray]], Any]
    sign: str = ""  # of the operator that joins it

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *operands: Number | float
    ) -> Number | Check:
        name = ufunc.__name__
        if name in COMPARED:
            left, right = operands
            assert isinstance(left, Number)
            margin = 0.0 if isinstance(right, Number) else right
            return Check(
                left - right if isinstance(right, Number) else left, COMPARED[name], margin
            )
        return _apply(ufunc, *operands)

    def mean(self) -> Number:
        """Over the trials of a seed."""
        return _apply(np.mean, self)


@dataclass(frozen=True, eq=False)
class Check:
    """One inequality: a number, an operator and a margin. level: of the interval that has to lie beyond the margin.

    premise: the estimate has to be on the accepted side, or the claim cannot be asked: of a lead of which another
    check's margin is a share, since a share of no lead is no margin.
    """

    number: Number
    op: str
    margin: float
    level: float = 0.95
    premise: bool = False

    @property
    def asked(self) -> str:
        """The margin, and where: ``> 0.5 (ReacherPush, Reacher noise)``."""
        places = ", ".join(dict.fromkeys(term.place.name for term in self.number.terms))
        return f"{self.op} {self.margin:g}" + f" ({places})" * bool(places)

    @property
    def text(self) -> str:
        """All of it as it is read."""
        return f"{self.number.text} {self.op} {self.margin:g}"

    def accepts(self, low: float | np.ndarray, high: float | np.ndarray) -> bool | np.ndarray:
        """Whether all that lies between ``low`` and ``high`` is on the accepted side of the margin."""
        return {
            ">": low > self.margin,
            ">=": low >= self.margin,
            "<": high < self.margin,
            "<=": high <= self.margin,
            "==": (low <= self.margin) & (self.margin <= high),
        }[self.op]

    def assumed(self) -> Check:
        """The same as a premise."""
        return replace(self, premise=True)

    def share(self) -> Number:
        """The share of a seed's trials for which it is true."""

        def share(rows: Mapping[Term, np.ndarray]) -> np.floating:
            values = self.number.of(rows)
            return np.mean(self.accepts(values, values))

        return Number(f"share({self.text})", self.number.terms, share)


Checks = Iterator[Check]


def _apply(function: Callable[..., Any], *operands: Number | float, name: str = "") -> Number:
    """A function of numbers, each evaluated first; written with a sign where it has one."""
    numbers = [x if isinstance(x, Number) else constant(x) for x in operands]
    name, texts = (
        name or NAMES.get(function.__name__, function.__name__),
        [number.text for number in numbers],
    )
    sign = INFIX.get(name, "")
    if sign:
        tight = {"+": "", "-": "+-", "*": "+-", "/": "+-*/"}[
            sign
        ]  # what stands in brackets on the right of the sign
        brackets = ("+-" if sign in "*/" else "", tight)
        texts = [
            f"({text})" if x.sign and x.sign in b else text
            for text, x, b in zip(texts, numbers, brackets, strict=True)
        ]
    terms = tuple(dict.fromkeys(term for number in numbers for term in number.terms))
    text = f" {sign} ".join(texts) if sign else f"{name}({', '.join(texts)})"
    return Number(
        text, terms, lambda rows: function(*(number.of(rows) for number in numbers)), sign
    )


def constant(value: float, text: str = "") -> Number:
    """A number that needs no rows."""
    return Number(text or f"{value:g}", (), lambda _: value)


log = partial(_apply, np.log)
largest = partial(_apply, lambda *x: np.max(x), name="max")
smallest = partial(_apply, lambda *x: np.min(x), name="min")
median = partial(_apply, lambda *x: np.median(x), name="median")
extent = partial(_apply, lambda *x: np.ptp(x), name="range")
correlation = partial(
    _apply, lambda x, y: np.corrcoef(x, y)[0, 1], name="correlation"
)  # over the trials of a seed


def between(low: Number | float, number: Number, high: Number | float) -> Checks:
    """Two one-sided tests of 5 %: the 90 % interval lies between ``low`` and ``high``."""
    for check in (low < number, number < high):
        assert isinstance(check, Check)
        yield replace(check, level=0.90)


# The paper's quantities ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Query:
    """How claims ask for rows, under one reading of the paper: ``Claim.readings`` change its fields.

    subject: the model that stands where the paper's own is meant. Of a step '' means the mean over all.
    """

    subject: str = PAPERS
    likelihood: str = "ll_paper"
    execution: str = "open loop"  # of predictions
    planner: str = "cem"
    samples: str = "samples_to_90"
    unfiltered: str = (
        "none"  # what a model that filters noise is held against: the observation, or a filter
    )

    def score(
        self, metric: str, model: Model, place: Place, *, step: float | str = "", subset: str = ""
    ) -> Number:
        """A score of predictions."""
        return self._ask(
            place.table or "03_predict",
            metric,
            model.word,
            place,
            execution=self.execution,
            subset=subset,
            steps_ahead=step,
        )

    def ll(self, model: Model, place: Place, *, step: float | str = "", subset: str = "") -> Number:
        """The log-likelihood, in nats per step, under the reading's protocol."""
        return self.score(self.likelihood, model, place, step=step, subset=subset)

    def ablation(self, model: Model) -> Number:
        """The log-likelihood on pushing of a model with one thing changed."""
        return self.ll(model, PUSH._replace(table="03_ablation"))

    def latent(self, metric: str, place: Place, *, subset: str = "") -> Number:
        """What was measured of the codes, in segments from the true past; of contacts (a subset), open loop."""
        return self._ask(
            place.table or "04_latent",
            metric,
            PAPERS,
            place,
            execution="open loop" if subset else "segments",
            subset=subset,
            steps_ahead="",
        )

    def plans(
        self, metric: str, model: Model, place: Place, *, planner: str = "", trials: bool = True
    ) -> Number:
        """Of plans that were executed open loop, one by one; without ``trials`` of all at once."""
        return self._ask(
            "05_control",
            metric,
            model.word,
            place,
            trials=trials,
            planner=planner or self.planner,
            search_space=model.space,
            horizon=place.horizon,
            execution="open loop",
            iteration="",
        )

    def gap(self, model: Model, place: Place) -> Number:
        """Predicted minus executed return, plan by plan."""
        return self.plans("return_predicted", model, place) - self.plans(
            "return_true", model, place
        )

    def executed(self, model: Model, place: Place) -> Number:
        """The mean executed return of plans."""
        return self.plans("return_true", model, place).mean()

    def torques(
        self, metric: str, model: Model, place: Place, *, planner: str = "", trials: bool = False
    ) -> Number:
        """What was measured of planned torques."""
        return self._ask(
            "07_action_prior",
            metric,
            model.word,
            place,
            trials=trials,
            planner=planner or self.planner,
            search_space=model.space,
            subset="",
        )

    def policy(self, metric: str, model: Model, place: Place, *, average: bool = False) -> Number:
        """Of a policy at the end of its learning curve, or averaged along it, copy by copy."""
        return self._ask(
            place.table or "05_control",
            metric,
            model.word,
            place,
            trials=True,
            curve="iteration",
            average=average,
            planner="policy",
            search_space=model.space,
            execution="policy",
            subset="",
        )

    def final(self, model: Model, place: Place) -> Number:
        """The final return of a policy."""
        return self.policy("return_true", model, place).mean()

    def model_free(self, place: Place) -> Number:
        """The final return of the better of two policy gradients in the environment."""
        ppo, trpo = (
            self._ask(
                "model_free",
                "return_true",
                word,
                place,
                curve="env_steps",
                search_space="",
                execution="policy",
                subset="",
            )
            for word in ("ppo", "trpo")
        )
        return largest(ppo, trpo)

    def samples_ratio(self, place: Place) -> Number:
        """Samples to 90 % of the common plateau: TSM with prior over the better policy gradient of each seed."""
        tsm, ppo, trpo = (
            self._ask(
                "05_control",
                self.samples,
                word,
                place,
                search_space=space,
                execution="policy",
                iteration="",
            )
            for word, space in (LAP, ("ppo", ""), ("trpo", ""))
        )
        return tsm / smallest(ppo, trpo)

    def random_return(self, place: Place) -> Number:
        """The executed return of random torques."""
        return self._ask(
            "05_control", "return_true", "none", place, planner="random", horizon=place.horizon
        )

    def data(self, metric: str, place: Place, *, lag: float | str = "") -> Number:
        """A property of the training data."""
        return self._ask("01_collect", metric, "none", place, split="train", lag=lag)

    def explored(
        self,
        metric: str,
        model: Model,
        place: Place,
        configuration: str,
        *,
        env_steps: float,
        steps_ahead: float | str = "",
    ) -> Number:
        """Of rounds of exploration after so many steps, or of an adapted model; configuration: by which data or how."""
        return self._ask(
            "10_explore",
            metric,
            model.word,
            place,
            configuration=configuration,
            env_steps=env_steps,
            steps_ahead=steps_ahead,
        )

    def pushed(self, configuration: str, *, after: int, metric: str = "return_true") -> Number:
        """Executed return, or another metric, after so many rounds of exploration on the arm that pushes."""
        return self._ask(
            "10_explore",
            metric,
            PAPERS,
            PUSH,
            configuration=configuration,
            iteration=after,
            execution="closed loop",
        )

    def searched(self, prior: str, configuration: str = "own plans") -> Number:
        """Return that a search of ten iterations through the true simulator ends with, in codes of a prior."""
        return self._ask(
            "10_explore",
            "return_true",
            PAPERS,
            PUSH,
            configuration=configuration,
            subset=prior,
            iteration=10,
            execution="open loop",
        )

    def gradient_error(self) -> Number:
        return self._ask("02_train", "gradient_error", PAPERS, PUSH)

    def rmse_clean(self, word: str) -> Number:
        """The error to the clean state, with noise."""
        return self._ask(
            "06_robustness", "rmse_clean", word, NOISE, execution="segments", steps_ahead=""
        )

    def _ask(
        self,
        table: str,
        metric: str,
        model: str,
        place: Place,
        *,
        trials: bool = False,
        curve: str = "",
        average: bool = False,
        **columns: float | str,
    ) -> Number:
        word = self.subject if model == PAPERS else model
        term = Term(table, metric, word, place, tuple(columns.items()), trials, curve, average)
        return Number(term.text, (term,), lambda rows: rows[term])
