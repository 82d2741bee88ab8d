"""Dynamics models, and segments chained into horizons.

A one-step model is a segment model with H = 1. Planners, policies and scores are written once against this.
"""

import inspect
from collections import deque
from collections.abc import Callable
from typing import Protocol, cast, runtime_checkable

import torch
from torch import Tensor

from tsmlib.models.features import Features
from tsmlib.models.layers import on_device_of
from tsmlib.sampling import Noise, NoNoise, by_generator
from tsmlib.storage.files import Json
from tsmlib.trajectory import Segment, Window

Step = Callable[[Tensor], Tensor]  # an action (B, du) -> the state (B, dx) that it leads to


class DynamicsModel(Protocol):
    """P(X+ | X-, U-, U+) over segments of up to ``segment_len`` steps, given ``past_len`` steps of past (section 3).

    stochastic: whether a generator makes a difference. features: statistics of the training data, in whose units
    losses and scores are. ``begin`` is the one primitive; all else that predicts is a function of it, below.
    """

    segment_len: int
    past_len: int
    stochastic: bool
    features: Features

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read ``past`` (B, L, .) and predict one action at a time, for up to H actions.

        No generator: the mode; with one: a sample. What is drawn for a segment (a code, a member) is drawn here.
        """
        ...

    def loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Objective of the training: a scalar for one batch of windows (A.1 for TSM, section 5.2 for baselines)."""
        ...

    def config(self) -> dict[str, Json]:
        """The constructor's arguments, as they travel with the weights."""
        ...


@runtime_checkable
class SegmentModel(Protocol):
    """The least that a model of one's own needs: (past, actions (B, K <= H, du)) -> states (B, K, dx).

    ``predict_segment`` may take a ``generator``, a torch.Generator to draw a sample from or None for the mode; planners
    ask once per candidate, each time with the same random numbers. Without an attribute ``past_len`` the past has H
    steps. A DynamicsModel has it too where whole segments are faster than steps.
    """

    segment_len: int

    @property
    def predict_segment(self) -> Callable[..., Tensor]: ...


Model = DynamicsModel | SegmentModel
_LEAST = (
    "The least that a model needs: segment_len, its number of steps H, and predict_segment(past, actions), which gives "
    "the states (B, K, dx) that actions (B, K, du) of up to H steps lead to"
)


class Adapted:
    """A SegmentModel as a DynamicsModel, to roll out: its steps are segments of one action with noise of their own.

    The model draws from torch generators alone: rows that share noise, or have several generators, go in parts.

    TypeError naming what the model lacks, or what is not as it has to be.
    """

    def __init__(self, model: SegmentModel) -> None:
        name = type(model).__name__
        if missing := [
            word for word in ("segment_len", "predict_segment") if not hasattr(model, word)
        ]:
            raise TypeError(
                f"{name} cannot predict: it has no {' and no '.join(missing)}. {_LEAST}"
            )
        if type(model.segment_len) is not int or model.segment_len < 1:
            raise TypeError(
                f"segment_len of {name} is {model.segment_len!r:.80}; expected a positive int. {_LEAST}"
            )
        self.model, self.segment_len = model, model.segment_len
        self.samples = "generator" in inspect.signature(model.predict_segment).parameters
        self.past_len: int = getattr(model, "past_len", model.segment_len)
        self.stochastic: bool = getattr(model, "stochastic", self.samples)

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        if not self.samples:
            return self._checked(past, actions)
        if generator is None or isinstance(
            generator, NoNoise
        ):  # which tells a model with members whose mode is asked
            return self._checked(past, actions, generator=generator)
        return torch.cat(
            [  # one after the other, since parts may share a generator, which is set back between them
                self._checked(Segment(*(x[rows] for x in past)), actions[rows], generator=own)
                for rows, own in by_generator(len(actions), generator)
            ]
        )

    def _checked(self, past: Segment, actions: Tensor, **noise: Noise | None) -> Tensor:
        """The model's own prediction; TypeError where it is of another shape."""
        states = self.model.predict_segment(past, actions, **noise)
        expected = (*actions.shape[:2], past.states.shape[2])
        if not isinstance(states, Tensor) or states.shape != expected:
            found = (
                f"a tensor {tuple(states.shape)}"
                if isinstance(states, Tensor)
                else f"a {type(states).__name__}"
            )
            raise TypeError(
                f"predict_segment of {type(self.model).__name__} gave {found} for actions {tuple(actions.shape)}; "
                f"expected states {expected}"
            )
        return states

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Segments of one action, each after the last ``past_len`` steps."""

        def step(u: Tensor) -> Tensor:
            nonlocal past
            past = past.last(self.past_len)
            states = self.predict_segment(past, u[:, None], generator=generator)
            past = past.then(Segment(states, u[:, None]))
            return states[:, 0]

        return step


class EnsembleModel:
    """A model with ``members``, of which each row of a rollout takes one: see ``sampling.draw_members``."""

    members: int


def members(model: Model) -> int:
    """Members of an ensemble, each of which has a mode of its own; 1 for any other model."""
    return model.members if isinstance(model, EnsembleModel) else 1


def as_dynamics(model: Model) -> DynamicsModel:
    """The model itself, or adapted where it has no ``begin`` of its own."""
    return cast(DynamicsModel, model if hasattr(model, "begin") else Adapted(model))


def predict_segment(
    model: Model, past: Segment, actions: Tensor, *, generator: Noise | None = None
) -> Tensor:
    """States (B, K, dx) under ``actions`` (B, K <= H, du). No generator: the mode; with one: a sample."""
    model = as_dynamics(model)
    if isinstance(model, SegmentModel):
        return model.predict_segment(past, actions, generator=generator)
    step = model.begin(past, generator=generator)
    return torch.stack([step(u) for u in actions.unbind(1)], dim=1)


def rollout(
    model: Model, past: Segment, actions: Tensor, *, generator: Noise | None = None
) -> Tensor:
    """Segments chained over a horizon: ``actions`` (B, T, du) -> states (B, T, dx), physical units (section 3).

    Each predicted segment becomes the past of the next one. The past must hold at least ``model.past_len`` steps. What
    is given may be on another device than the model; the states are where the actions are.
    """
    past_len = _past_len(model, past)
    home, (*known, actions) = actions.device, on_device_of(model, *past, actions)
    past, predicted = Segment(*known), []
    for segment_actions in actions.split(model.segment_len, dim=1):
        past = past.last(past_len)
        states = predict_segment(model, past, segment_actions, generator=generator)
        predicted.append(states)
        past = past.then(Segment(states, segment_actions))
    return torch.cat(predicted, dim=1).to(home)


def stepper(model: Model, past: Segment, *, generator: Noise | None = None) -> Step:
    """A rollout one action at a time, each chosen after the state before it was seen, as a policy acts (section 4.3).

    The states are those of ``rollout`` under the actions that were taken: a code, or a member of an ensemble, is held
    for a segment of H steps, with activations and hidden states carried from step to step; then a new segment begins on
    the last steps. Of a model that cannot step, see ``Adapted``, they are the same where H = 1. A Gaussian ``Ensemble``
    draws the noise of a segment at once, ``rollout`` for no more steps than there are, so that samples of it are the
    same where a rollout is of whole segments; after that, they are others of the same distribution.
    """
    recent, adapted = (
        [deque(part.unbind(1), maxlen=_past_len(model, past)) for part in past],
        as_dynamics(model),
    )
    taken, running = 0, None

    def step(u: Tensor) -> Tensor:
        nonlocal running, taken
        if running is None or taken % model.segment_len == 0:
            running = adapted.begin(
                Segment(*(torch.stack(tuple(part), dim=1) for part in recent)), generator=generator
            )
        x, taken = running(u), taken + 1
        for part, latest in zip(recent, (x, u), strict=True):
            part.append(latest)
        return x

    return step


def _past_len(model: Model, past: Segment) -> int:
    """Steps of past that ``model`` reads; ValueError where there are fewer, or it knows no statistics of its data."""
    features = getattr(model, "features", None)
    if isinstance(features, Features) and not features.fitted:
        raise ValueError(
            f"the features of this {type(model).__name__} were never fitted, so it cannot predict: make it with "
            f"{type(model).__name__}.for_data(trajectories), or call model.features.fit(torch.from_numpy(states))"
        )
    needed, found = as_dynamics(model).past_len, past.states.shape[1]
    if found < needed:
        raise ValueError(
            f"the past holds {found} steps, {type(model).__name__} needs {needed}; "
            "at the start of an episode use tsmlib.trajectory.initial_past"
        )
    return needed
