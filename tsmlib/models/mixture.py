"""Several trained models as one."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NoReturn, TypeVar

import torch
from torch import Tensor, nn

from tsmlib.models.base import EnsembleModel, Model, Step, as_dynamics, rollout, stepper
from tsmlib.models.features import Features
from tsmlib.models.predict import predict
from tsmlib.sampling import Noise, SeparateNoise, SharedNoise, draw_members
from tsmlib.trajectory import Robot, Segment

K = TypeVar("K")


@dataclass(frozen=True)
class _Share:
    """Rows of a batch (n,), the member that predicts them, and its noise."""

    rows: Tensor
    member: int
    noise: torch.Generator | SharedNoise | None


class Mixture(nn.Module, EnsembleModel):
    """An equal mixture of M models of one robot: p(X+ | .) = 1/M sum_m p_m(X+ | X-, U-, U+).

    A sample is a rollout of one of them, drawn once per rollout. The mode is the mean of theirs;
    planners judge a candidate by its mean return over the modes of all (``model_predictor``), which
    is harder to exploit than one model. Weights stay those of the models, which are trained and
    stored one by one.

    Args:
        models: of any kinds, with segments of any lengths; one that is given twice counts twice.

    Attributes:
        robot: that of the models; None where they know none.

    Raises:
        TypeError: no sequence of models is given.
        ValueError: none is in it, or they are of different robots.
    """

    segment_len = sys.maxsize  # a rollout of any length is one segment
    predict = predict

    def __init__(self, models: Iterable[Model]) -> None:
        if not isinstance(models, Iterable) or isinstance(models, nn.Module | str):
            raise TypeError(
                f"models is a {type(models).__name__}; expected a list of models, as in "
                "Mixture([one, another])"
            )
        super().__init__()
        self.models = tuple(models)
        if not self.models:
            raise ValueError(
                "models is empty; expected at least one, as in Mixture([one, another])"
            )
        dynamics = [as_dynamics(model) for model in self.models]
        self.parts = nn.ModuleList([model for model in self.models if isinstance(model, nn.Module)])
        self.members, self.past_len = len(self.models), max(model.past_len for model in dynamics)
        self.stochastic = self.members > 1 or dynamics[0].stochastic
        robots = self._known("robot", Robot)
        for robot in robots[1:]:
            robots[0].require_same(robot, "the models of a mixture")
        self.robot = robots[0] if robots else None
        states = {
            f"{len(features.step_std)} dimensions with angles {features.angles}"
            for features in self._known("features", Features)
        }
        if len(states) > 1:
            raise ValueError(
                f"models predict states of {' and '.join(sorted(states))}; expected one robot"
            )

    def _known(self, name: str, kind: type[K]) -> list[K]:
        """What those models that have it say of robot or statistics."""
        known = (getattr(model, name, None) for model in self.models)
        return [value for value in known if isinstance(value, kind)]

    @property
    def features(self) -> Features:
        """Statistics of the first model that has some, in whose units scores are.

        AttributeError without any: then scores need features of their own (``tsmlib.score``).
        """
        if not (known := self._known("features", Features)):
            raise AttributeError(
                "no model of this mixture has features (statistics of its training data)"
            )
        return known[0]

    def __repr__(self) -> str:
        """The models in it."""
        return f"Mixture([{', '.join(type(model).__name__ for model in self.models)}])"

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past by the models, and step through the mean of their modes or a sample.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            generator: None for the mode; else of each row's model and of what that model draws.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to, in physical units.
        """
        shares = list(self._shares(past.states, generator))
        steps = [
            stepper(
                self.models[share.member],
                Segment(*(part[share.rows] for part in past)),
                generator=share.noise,
            )
            for share in shares
        ]

        def step(u: Tensor) -> Tensor:
            states = [step(u[share.rows]) for step, share in zip(steps, shares, strict=True)]
            return _joined(states, shares, mode=generator is None)

        return step

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """Predict the states that ``begin`` steps through.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1].
            generator: as of ``begin``.

        Returns:
            States (B, K, dx) in physical units.
        """
        shares = list(self._shares(past.states, generator))
        states = [
            rollout(
                self.models[share.member],
                Segment(*(part[share.rows] for part in past)),
                actions[share.rows],
                generator=share.noise,
            )
            for share in shares
        ]
        return _joined(states, shares, mode=generator is None)

    def loss(self, *_: object) -> NoReturn:
        """Refuse a training, since each model is trained by itself.

        Args:
            _: whatever a training gives.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            "a Mixture is not trained; train or fine-tune each of its models, then make it anew"
        )

    def config(self) -> NoReturn:
        """Refuse a file, since each model is stored by itself.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            "a Mixture is not stored; save each of its models, and make it of what load_model gives"
        )

    def _shares(self, like: Tensor, noise: Noise | None) -> Iterator[_Share]:
        """The rows of each member, for the mode all of them."""
        rows = torch.arange(len(like), device=like.device)
        if noise is None:
            yield from (_Share(rows, k, None) for k in range(self.members))
        elif isinstance(noise, SeparateNoise):
            for part, own in zip(
                rows.split(len(rows) // len(noise.generators)), noise.generators, strict=True
            ):
                yield from (
                    _Share(part[share.rows], share.member, share.noise)
                    for share in self._shares(like[part], own)
                )
        else:
            member = draw_members(self.members, len(rows), noise, like[:, 0])
            for k in member.unique().tolist():
                yield _Share(rows[member == k], k, _of_share(noise, member == k))


def _of_share(noise: Noise, chosen: Tensor) -> torch.Generator | SharedNoise:
    """The noise of one member's rows: a generator of its own, so that members draw in any order.

    chosen: (B,), which rows they are. Rows that share noise are chosen together.
    """
    if not isinstance(noise, (torch.Generator, SharedNoise)):
        raise TypeError(
            f"a Mixture draws by a generator or SharedNoise, not by {type(noise).__name__}"
        )
    source = noise.generator if isinstance(noise, SharedNoise) else noise
    if not isinstance(source, torch.Generator):
        raise TypeError(
            "found several generators in SharedNoise; a Mixture takes one: "
            "SharedNoise(generator, period)"
        )
    seed = int(torch.randint(2**62, (), generator=source, device=source.device))
    own = torch.Generator(device=source.device).manual_seed(seed)
    return (
        SharedNoise(own, int(chosen[: noise.period].sum()))
        if isinstance(noise, SharedNoise)
        else own
    )


def _joined(states: Sequence[Tensor], shares: Sequence[_Share], *, mode: bool) -> Tensor:
    """The members' states as rows (B, ..., dx): of the mode their mean, else each in its place."""
    if mode:
        return torch.stack(list(states)).mean(0)
    return torch.cat(list(states))[torch.cat([share.rows for share in shares]).argsort()]
