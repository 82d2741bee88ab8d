"""The models of the study: the one place where a model is added. Imports nothing heavy.

Trained, scored, planned with and drawn it is by its word alone: every other file asks here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from importlib import import_module
from itertools import product
from typing import TYPE_CHECKING, Literal

from tsmlib.plots.method import PLANNERS, SEARCH_SPACES, Look, Method

if TYPE_CHECKING:
    import torch

    from tsmlib.envs.spec import EnvSpec
    from tsmlib.storage.files import Json
    from tsmlib.training.fit import TrainingOptions

BUDGET = {  # seconds of training on one core at scale paper, the same for every dynamics model of an environment
    "Reacher": 320.0,
    "ReacherObstacle": 480.0,
    "ReacherPush": 2320.0,
    "PymunkReacher": 160.0,
    "PymunkObstacle": 160.0,
    "PymunkPush": 580.0,
}


@dataclass(frozen=True)
class Stage:
    """One part of a training: a loss of the model, minimised for a share of the budget.

    rate: updates per second on one core of the machine that the published models were trained on, on the plain arm and
    where there is a block. future_len: steps ahead, 2 H. lr: of Adam, which trains what Muon does not. bf16: whether
    products in bfloat16 are faster and teach as much, on a processor that has them (``training.precision``; elsewhere
    float32): not where a gated stack is run step by step, nor of the LSTM. muon, weight_decay, patience and span: of
    ``TrainingOptions``; stages that share one schedule have spans that follow each other, as (0, 0.6) and (0.6, 1) do.
    """

    loss: str
    rate: float | tuple[float, float]
    share: float = 1.0
    future_len: int = 20
    lr: float = 4e-3
    batch: int = 256
    bf16: bool = True
    muon: float = 0.0
    weight_decay: float = 0.0
    patience: int = 0
    span: tuple[float, float] = (0.0, 1.0)

    def within(self, seconds: float, block: bool) -> Updates:
        """The stage in its share of a budget: updates in tens, and never fewer than 20."""
        rate = self.rate[block] if isinstance(self.rate, tuple) else self.rate
        steps = max(20, 10 * round(seconds * self.share * rate / 10))
        return Updates(
            self.loss,
            steps,
            self.future_len,
            self.lr,
            self.batch,
            self.bf16,
            self.muon,
            self.weight_decay,
            self.patience,
            self.span,
        )


@dataclass(frozen=True)
class Updates:
    """A stage of a training with its number of updates.

    Fields with a default came later: models whose headers do not have them were trained by the default.
    """

    loss: str
    steps: int
    future_len: int
    lr: float
    batch: int
    bf16: bool
    muon: float = 0.0
    weight_decay: float = 0.0
    patience: int = 0
    span: tuple[float, float] = (0.0, 1.0)

    def options(self, past_len: int, **changes: float | tuple[float, float]) -> TrainingOptions:
        """What ``fit`` takes. past_len: of the model; changes: of other fields, or of these."""
        from tsmlib.training.fit import TrainingOptions  # heavy

        own = {name: value for name, value in asdict(self).items() if name not in ("loss", "batch")}
        return TrainingOptions(**{"past_len": past_len, "batch_size": self.batch} | own | changes)

    def stated(self) -> dict[str, Json]:
        """The stage as it stands in the header of a model: without ``bf16``, which holds where it is native."""
        return _as_json({name: value for name, value in asdict(self).items() if name != "bf16"})


def stated(schedule: Iterable[Mapping[str, Json]]) -> list[dict[str, Json]]:
    """The schedule in the header of a model, complete: what came later is at its default."""
    later = {field.name: field.default for field in fields(Updates) if field.default is not MISSING}
    return [{**_as_json(later), **stage} for stage in schedule]


def _as_json(stage: Mapping[str, Json]) -> dict[str, Json]:
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in stage.items()
    }


@dataclass(frozen=True)
class ModelSpec:
    """A model: how it looks, what it is made of and how it is trained.

    cls: ``module:Class``, imported when first used. arguments: of the class, beyond the sizes of states and actions.
    budget: seconds of training of its own, in place of the environment's. group: dynamics models are compared
    everywhere; an ablation is TSM with a part put in or taken away, a choice changes one of the paper's; the prior is
    the prior.
    planned: whether figure 6 plans with it. pushing: its stages there, where they differ.
    """

    word: str
    look: Look
    cls: str
    stages: tuple[Stage, ...]
    arguments: Callable[[EnvSpec], Mapping[str, Json]] = lambda env: {}
    group: Literal["dynamics", "ablation", "choice", "prior"] = "dynamics"
    budget: float | None = None
    planned: bool = False
    pushing: tuple[Stage, ...] = ()

    def load(self) -> type[torch.nn.Module]:
        """The class."""
        module, _, name = self.cls.partition(":")
        return getattr(import_module(module), name)

    def seconds(self, env: EnvSpec) -> float:
        """Its whole budget, on an imperfect arm as on the plain one."""
        return BUDGET[env.standard.name] if self.budget is None else self.budget

    def schedule(self, env: EnvSpec, share: float = 1.0) -> list[Updates]:
        """How the model is trained in a share of its budget."""
        stages = (env.task == "push" and self.pushing) or self.stages
        return [stage.within(share * self.seconds(env), env.has_block) for stage in stages]


# Training stages and arguments ----------------------------------------------------------------------------------------


_SLOW = 0.003  # rate of Muon of TSM, which diverges at a higher


def _free(
    loss: str, rate: float | tuple[float, float], share: float = 0.75, *, muon: float = _SLOW
) -> Stage:
    """Free-running over two chained segments."""
    return Stage(loss, rate, share, lr=2e-3, batch=128, bf16=False, muon=muon)


def _baseline(loss: str, rate: float, *, bf16: bool = True) -> Stage:
    """With Muon at half the rate that was best for the one-step model and the LSTM in a quarter of the time
    (``benchmarks/settings``, sections 5, 7 and 8)."""
    return Stage(loss, rate, lr=2e-3, bf16=bf16, muon=0.01)


TEACHER = Stage("teacher_forced_loss", (30, 20), 0.25, future_len=10, muon=_SLOW)
LONGER = Stage("teacher_forced_loss", 26, 0.4, future_len=10, muon=_SLOW)
RECURRENT = (  # the mode first, since a sample costs less than two; at last over longer windows
    replace(_free("point_loss", 17, 0.5, muon=0.01), bf16=True, span=(0.0, 0.5)),
    replace(_free("loss", 11, 0.35, muon=0.01), bf16=True, span=(0.5, 0.85)),
    replace(_free("loss", 7.5, 0.15, muon=0.01), bf16=True, span=(0.85, 1.0), future_len=30),
)
PAPER = (
    TEACHER,
    _free("loss", (16, 10.5)),
)  # teacher forcing for a quarter of the time, then squared error and KL


def _wide(env: EnvSpec) -> dict[str, Json]:
    """Appendix A.1."""
    return {"channels": 64, "head_channels": 128} if env.has_block else {}


def _skip(env: EnvSpec) -> dict[str, Json]:
    """A head that sees the state itself, over a narrower stack."""
    return {"channels": 32, "state_skip": 200}


def _choice(word: str, name: str, colour: str, **arguments: Json) -> ModelSpec:
    """One of the paper's choices, changed; as many updates as TSM."""
    look = Look(f"TSM, {name}", colour)
    return ModelSpec(
        word, look, "tsmlib.models.tsm:TSM", PAPER, lambda env: _wide(env) | arguments, "choice"
    )


# The models, in the order in which they are drawn: Okabe and Ito's colours, distinct with any colour vision --------

_TSM, _RECURRENT, _ONE_STEP, _LSTM, _ENSEMBLE, _PRIOR = (
    f"tsmlib.models.{name}"
    for name in (
        "tsm:TSM",
        "recurrent:RecurrentTSM",
        "baselines:OneStep",
        "baselines:LSTM",
        "ensemble:Ensemble",
        "action_prior:ActionPrior",
    )
)
_MODELS = (
    ModelSpec("tsm", Look("TSM", "#3D9BE0", "o"), _TSM, PAPER, _wide, planned=True),
    ModelSpec(
        "rtsm",
        Look("recurrent TSM", "#0B2F8A", "*"),
        _RECURRENT,
        RECURRENT,
        planned=True,
        pushing=tuple(replace(stage, muon=0.005) for stage in RECURRENT),
    ),
    ModelSpec(  # the energy score in place of squared error and KL
        "tsm+energy",
        Look("TSM + energy", "#56B4E9", "p"),
        _TSM,
        (TEACHER, _free("energy_loss", (11, 6.9))),
        _wide,
        "ablation",
    ),
    ModelSpec(  # the same with the state skip, and more teacher forcing
        "tsm+energy+direct",
        Look("TSM + energy + skip", "#4F7FBF", ">"),
        _TSM,
        (LONGER, _free("energy_loss", 8, 0.6)),
        _skip,
        "ablation",
    ),
    ModelSpec(
        "tsm+teacher",
        Look("TSM, teacher forcing only", "#1B2A5C", "<"),
        _TSM,
        (replace(TEACHER, share=1.0),),
        _wide,
        "ablation",
    ),
    ModelSpec(  # the state skip with the paper's loss
        "tsm+direct",
        Look("TSM + skip", "#7BA7D9", "h"),
        _TSM,
        (LONGER, _free("loss", 11, 0.6)),
        _skip,
        "ablation",
    ),
    ModelSpec(
        "onestep",
        Look("one-step", "#E69F00", "s"),
        _ONE_STEP,
        (_baseline("loss", 36),),
        planned=True,
    ),
    ModelSpec(  # free-running over 2 H steps
        "multistep",
        Look("multi-step", "#D55E00", "^"),
        _ONE_STEP,
        (_baseline("multi_step_loss", 21),),
        planned=True,
    ),
    ModelSpec(
        "lstm",
        Look("LSTM", "#009E73", "v"),
        _LSTM,
        (_baseline("loss", 14.5, bf16=False),),
        planned=True,
    ),
    ModelSpec(
        "ensemble",
        Look("ensemble (Gaussian)", "#CC79A7", "P"),
        _ENSEMBLE,
        (_baseline("loss", 33.3),),
        lambda env: {"gaussian": True},
    ),
    ModelSpec(
        "ensemble+mse",
        Look("ensemble (squared error)", "#6A2BD9", "X"),
        _ENSEMBLE,
        (_baseline("loss", 33.3),),
        lambda env: {"gaussian": False},
        planned=True,
    ),
    ModelSpec(
        "prior",
        Look("action prior", "#882255"),
        _PRIOR,
        (Stage("loss", 30, lr=1e-3, bf16=False),),
        group="prior",
        budget=100.0,
    ),
    _choice("tsm+full", "full encoder", "#4C6A92", full_encoder=True),
    _choice("tsm+plain", "no skip connections", "#6C8EBF", plain=True),
    _choice("tsm+z4", "4 latent dimensions", "#8AB6D6", latent_dim=4),
    _choice("tsm+z16", "16 latent dimensions", "#2F6F9F", latent_dim=16),
    _choice("tsm+h1", "H = 1", "#A6C8E0", segment_len=1),
    replace(
        _choice(
            "tsm+h20", "H = 20", "#1F4E79", segment_len=20, dilations=(1, 2, 4, 8, 16, 8)
        ),  # receptive field 2 H
        stages=(replace(TEACHER, future_len=20), PAPER[1]),
    ),
)
ZOO = {spec.word: spec for spec in _MODELS}
PAPERS, OURS = "tsm", "rtsm"  # the model of the paper, and the one that goes beyond it
CODED = (
    "TSM",
    "RecurrentTSM",
)  # classes whose predictions are a function of codes; the first has an encoder too
LOOKS = {  # of what is run and drawn beside the models; greys for what is no method
    "ppo": Look("PPO", "#999933"),
    "trpo": Look("TRPO", "#7B4B2A"),
    "sac": Look("SAC", "#D81B60"),
    "oracle": Look("oracle", "#111111"),
    "random": Look("random torques", "#7A7A7A"),
    "zero": Look("zero torque", "#B0B0B0"),
    "data": Look("data", "#4A4A4A"),
    "filter": Look("Kalman filter", "#B03A2E"),
    "exponential": Look("exponential average", "#8C8C8C"),
    "pets": Look("PETS (mbrl-lib)", "#C2A5CF", "H"),
    "pets+mse": Look("PETS (mbrl-lib), squared error", "#9970AB", "8"),
}


def keys(stages: Sequence[Stage | Updates]) -> list[str]:
    """A word for each stage of a training: its loss, numbered from the second time on that it is minimised."""
    losses = [stage.loss for stage in stages]
    return [
        f"{loss}-{n}" if (n := 1 + losses[:i].count(loss)) > 1 else loss
        for i, loss in enumerate(losses)
    ]


def words(*groups: str, cls: Sequence[str] = ()) -> tuple[str, ...]:
    """The models of some groups, or of all, in the order of ZOO; cls: of some classes alone, CODED for example."""
    named = ((word, spec) for word, spec in ZOO.items() if not groups or spec.group in groups)
    return tuple(word for word, spec in named if not cls or spec.cls.partition(":")[2] in cls)


def find(word: str) -> ModelSpec:
    """The entry of a model; ValueError naming those that there are."""
    if word not in ZOO:
        raise ValueError(f"no model is called {word!r:.80}; there are {', '.join(ZOO)}")
    return ZOO[word]


def look(word: str) -> Look:
    """How a model is drawn, or what stands in a model's place; ValueError naming those that there are."""
    if word in LOOKS:
        return LOOKS[word]
    if word not in ZOO:
        raise ValueError(f"nothing is called {word!r:.80}; there are {', '.join([*ZOO, *LOOKS])}")
    return ZOO[word].look


def method(model: str, search_space: str = "", planner: str = "", variant: str = "") -> Method:
    """A method by its words, as they stand in the tables; there, random and zero torques are planners of model none.

    ValueError for a model, a search space or a planner that is not known.
    """
    if model == "none":
        model, planner = planner, ""
    if search_space not in ("", *SEARCH_SPACES) or planner not in ("", "none", "policy", *PLANNERS):
        raise ValueError(
            f"search space is {search_space!r:.80}, planner {planner!r:.80}; expected {' or '.join(SEARCH_SPACES)}, "
            f"and one of {', '.join(PLANNERS)}, policy; or ''"
        )
    return Method(
        model, search_space, "" if planner == "none" else planner, variant, look=look(model)
    )


def methods(
    models: Iterable[str], planner: str, spaces: Iterable[str] = SEARCH_SPACES
) -> list[Method]:
    """Every model with a planner, in every search space."""
    return [method(model, space, planner) for model, space in product(models, spaces)]


def policies(models: Iterable[str]) -> list[Method]:
    """Every model with a policy that acts directly, and those that have codes also with a latent one."""
    coded = words(cls=CODED)
    return [
        way
        for way in methods(models, "policy")
        if way.search_space == "direct" or way.model in coded
    ]


def trained_on(env: str, word: str) -> str:
    """The environment whose data a model is trained on: of the prior, since equally many episodes hold the same
    torques, one with as many."""
    from tsmlib.envs.spec import EnvSpec

    if find(word).group != "prior":
        return env
    return "tsm/ReacherObstacle-v0" if EnvSpec.parse(env).has_block else "tsm/Reacher-v0"
