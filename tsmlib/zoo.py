"""The models by the words that name them: how each is made, trained and drawn.

The one place where a model is added. Imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import torch

    from tsmlib.envs.spec import EnvSpec
    from tsmlib.storage.files import Json

Marker = str | tuple[int, int, float]  # matplotlib's: a letter, or corners, kind and angle


@dataclass(frozen=True)
class Look:
    """How a model is drawn.

    Args:
        name: as the reader meets it.
        colour: in every figure.
        marker: matplotlib's; no diamond, which is the reader's own.
    """

    name: str
    colour: str
    marker: Marker = "o"


@dataclass(frozen=True)
class Updates:
    """A stage of a training, in updates.

    Args:
        loss: name of the model's loss that is minimised.
        steps: updates.
        future_len: steps ahead, 2 H.
        lr: peak learning rate of Adam, which trains what Muon does not.
        batch: windows of an update.
        muon: peak learning rate of Muon.
        span: part of one schedule that the stage covers, where several share one.
    """

    loss: str
    steps: int
    future_len: int = 20
    lr: float = 2e-3
    batch: int = 256
    muon: float = 0.01
    span: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Stage:
    """A stage of a training as a share of a budget.

    Args:
        updates: the stage, of one update.
        rates: updates per second on one core of the machine that the published models were trained
            on, on the plain arm and where there is a block.
        share: of the budget.
    """

    updates: Updates
    rates: tuple[float, float]
    share: float = 1.0


@dataclass(frozen=True)
class ModelSpec:
    """A model: how it looks, what it is made of and how it is trained.

    Args:
        word: its name in commands, tables and files.
        look: in figures.
        cls: ``module:Class``, imported when first used.
        stages: of its training.
        arguments: of the class, beyond the sizes of states and actions.
        group: dynamics models are compared everywhere; an ablation is TSM by the paper's loss
            alone, a choice that with one of the paper's choices changed; the prior is the prior.
        budget: seconds of training of its own, in place of the environment's.
        planned: whether figure 6 plans with it.
        pushing: its stages there, where they differ.
    """

    word: str
    look: Look
    cls: str
    stages: tuple[Stage, ...]
    arguments: Callable[[EnvSpec], Mapping[str, Json]] = field(default=lambda env: {})
    group: Literal["dynamics", "ablation", "choice", "prior"] = "dynamics"
    budget: float | None = None
    planned: bool = False
    pushing: tuple[Stage, ...] = ()

    def load(self) -> type[torch.nn.Module]:
        """The class."""
        module, _, name = self.cls.partition(":")
        return getattr(import_module(module), name)


# Training stages and arguments -----------------------------------------------------------------

_SLOW = 0.003  # rate of Muon of TSM, which diverged at 0.02


def _baseline(loss: str, rate: float) -> tuple[Stage]:
    """With Muon at half the rate that was best in a quarter of the time."""
    return (Stage(Updates(loss, 1), (rate, rate)),)


def _recurrent(muon: float) -> tuple[Stage, ...]:
    """The mode first, since a sample costs less than two; at last over longer windows."""
    sample = Updates("loss", 1, batch=128, muon=muon)
    return (
        Stage(replace(sample, loss="point_loss", span=(0.0, 0.5)), (17, 17), 0.5),
        Stage(replace(sample, span=(0.5, 0.85)), (11, 11), 0.35),
        Stage(replace(sample, span=(0.85, 1.0), future_len=30), (7.5, 7.5), 0.15),
    )


def _wide(env: EnvSpec) -> dict[str, Json]:
    """Appendix A.1."""
    return {"channels": 64, "head_channels": 128} if env.has_block else {}


# The models, in the order in which they are drawn: Okabe and Ito's colours, distinct with any
# colour vision ----------------------------------------------------------------------------------

_TSM, _ONE_STEP, _ENSEMBLE = (
    f"tsmlib.models.{name}" for name in ("tsm:TSM", "baselines:OneStep", "ensemble:Ensemble")
)
_TEACHER = Stage(
    Updates("teacher_forced_loss", 1, future_len=10, lr=4e-3, muon=_SLOW), (30, 20), 0.25
)
_ELBO = (  # the paper's loss: true states for a quarter of the time, then its own over two segments
    _TEACHER,
    Stage(Updates("loss", 1, batch=128, muon=_SLOW), (16, 10.5), 0.75),
)
_SAMPLES = (  # the energy score of samples for half of it; at last the encoder alone
    _TEACHER,
    Stage(Updates("loss", 1, batch=128, muon=_SLOW, span=(0.0, 0.3)), (25, 16), 0.225),
    Stage(Updates("energy_loss", 1, batch=128, muon=_SLOW, span=(0.3, 1.0)), (18, 12), 0.525),
    Stage(Updates("encoder_loss", 1, batch=128, muon=_SLOW), (25, 16), 0.05),
)


def _choice(word: str, name: str, colour: str, **arguments: Json) -> ModelSpec:
    """The paper's loss alone, with one of its choices changed; as many updates as without."""
    look = Look(f"TSM, paper's loss, {name}", colour)
    return ModelSpec(word, look, _TSM, _ELBO, lambda env: _wide(env) | arguments, "choice")


_H20 = _choice(  # receptive field 2 H
    "tsm+h20", "H = 20", "#1F4E79", segment_len=20, dilations=(1, 2, 4, 8, 16, 8)
)
_LONG = replace(_TEACHER, updates=replace(_TEACHER.updates, future_len=20))
_MODELS = (
    ModelSpec(  # half of the time on its own samples; beta by validation
        "tsm",
        Look("TSM", "#3D9BE0", "o"),
        _TSM,
        _SAMPLES,
        lambda env: _wide(env) | {"beta": 0.3},
        planned=True,
    ),
    ModelSpec(
        "rtsm",
        Look("recurrent TSM", "#0B2F8A", "*"),
        "tsmlib.models.recurrent:RecurrentTSM",
        _recurrent(0.01),
        planned=True,
        pushing=_recurrent(0.005),
    ),
    ModelSpec(
        "onestep",
        Look("one-step", "#E69F00", "s"),
        _ONE_STEP,
        _baseline("loss", 36),
        planned=True,
    ),
    ModelSpec(  # free-running over 2 H steps
        "multistep",
        Look("multi-step", "#D55E00", "^"),
        _ONE_STEP,
        _baseline("multi_step_loss", 21),
        planned=True,
    ),
    ModelSpec(
        "lstm",
        Look("LSTM", "#009E73", "v"),
        "tsmlib.models.baselines:LSTM",
        _baseline("loss", 14.5),
        planned=True,
    ),
    ModelSpec(
        "ensemble",
        Look("ensemble (Gaussian)", "#CC79A7", "P"),
        _ENSEMBLE,
        _baseline("loss", 33.3),
        lambda env: {"gaussian": True},
    ),
    ModelSpec(
        "ensemble+mse",
        Look("ensemble (squared error)", "#6A2BD9", "X"),
        _ENSEMBLE,
        _baseline("loss", 33.3),
        lambda env: {"gaussian": False},
        planned=True,
    ),
    ModelSpec(
        "prior",
        Look("action prior", "#882255"),
        "tsmlib.models.action_prior:ActionPrior",
        (Stage(Updates("loss", 1, lr=1e-3, muon=0.0), (30, 30)),),
        group="prior",
        budget=100.0,
    ),
    ModelSpec(
        "tsm+elbo", Look("TSM, paper's loss", "#56B4E9", "p"), _TSM, _ELBO, _wide, "ablation"
    ),
    _choice("tsm+plain", "no skip connections", "#6C8EBF", plain=True),
    _choice("tsm+h1", "H = 1", "#A6C8E0", segment_len=1),
    replace(_H20, stages=(_LONG, _ELBO[1])),
)
ZOO = {spec.word: spec for spec in _MODELS}
LOOKS = {  # of what is run and drawn beside the models; greys for what is no method
    "ppo": Look("PPO", "#999933"),
    "trpo": Look("TRPO", "#7B4B2A"),
    "sac": Look("SAC", "#D81B60"),
    "oracle": Look("simulator, same search", "#111111"),
    "random": Look("random torques", "#7A7A7A"),
    "zero": Look("zero torque", "#B0B0B0"),
    "data": Look("data", "#4A4A4A"),
    "filter": Look("Kalman filter", "#B03A2E"),
    "exponential": Look("exponential average", "#8C8C8C"),
    "pets": Look("PETS (mbrl-lib)", "#C2A5CF", "H"),
    "pets+mse": Look("PETS (mbrl-lib), squared error", "#9970AB", "8"),
}


def words(*groups: str) -> tuple[str, ...]:
    """The models of some groups, or of all, in the order of ZOO."""
    return tuple(word for word, spec in ZOO.items() if not groups or spec.group in groups)


def find(word: str) -> ModelSpec:
    """The entry of a model; ValueError naming those that there are."""
    if word not in ZOO:
        raise ValueError(f"no model is called {word!r:.80}; there are {', '.join(ZOO)}")
    return ZOO[word]


def look(word: str) -> Look:
    """How a model is drawn, or what stands in a model's place; ValueError naming all."""
    if word in LOOKS:
        return LOOKS[word]
    if word not in ZOO:
        raise ValueError(f"nothing is called {word!r:.80}; there are {', '.join([*ZOO, *LOOKS])}")
    return ZOO[word].look


def trained_on(env: str, word: str) -> str:
    """The environment whose data a model is trained on.

    The prior is that of an arm with equally many episodes, which hold the same torques.
    """
    from tsmlib.envs.spec import EnvSpec

    if find(word).group != "prior":
        return env
    return "tsm/ReacherObstacle-v0" if EnvSpec.parse(env).has_block else "tsm/Reacher-v0"
