"""Dynamics models, and segments chained into horizons.

A one-step model is a segment model with H = 1. Planners, policies and scores are written once
against this.
"""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable
from typing import Protocol, cast, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import as_tensor
from tsmlib.models.features import Features
from tsmlib.models.layers import first_weight
from tsmlib.sampling import Noise, NoNoise, by_generator
from tsmlib.storage.files import Json
from tsmlib.trajectory import Robot, Segment, Window

Step = Callable[[Tensor], Tensor]  # an action (B, du) -> the state (B, dx) that it leads to
Numbers = Tensor | np.ndarray | list  # of any number type


class DynamicsModel(Protocol):
    """P(X+ | X-, U-, U+) over segments of up to ``segment_len`` steps (section 3).

    ``begin`` is the one primitive; all else that predicts is a function of it, below.

    Attributes:
        segment_len: most steps of one segment, after which the last states are read anew.
        past_len: steps of past that it reads.
        stochastic: whether a generator makes a difference.
        features: statistics of the training data, in whose units losses and scores are.
    """

    segment_len: int
    past_len: int
    stochastic: bool
    features: Features

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past and predict one action at a time, for up to H actions.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            generator: None for the mode, else of a sample, all of whose segment is drawn here.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to, in physical units.
        """
        ...

    def loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Compute the objective of the training on one batch of windows.

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: of random numbers.

        Returns:
            A scalar.
        """
        ...

    def config(self) -> dict[str, Json]:
        """Tell the constructor's arguments, as they travel with the weights.

        Returns:
            The arguments by name, as JSON values.
        """
        ...


@runtime_checkable
class SegmentModel(Protocol):
    """The least that a model of one's own needs: past and actions (B, K <= H, du) -> (B, K, dx).

    ``predict_segment`` may take a ``generator``: a torch.Generator to draw a sample from, or None
    for the mode. Planners ask once per candidate, each time with the same random numbers. Without
    an attribute ``past_len`` the past has H steps. A DynamicsModel has ``predict_segment`` too
    where whole segments are faster than steps.
    """

    segment_len: int

    @property
    def predict_segment(self) -> Callable[..., Tensor]:
        """A function (past, actions) -> states."""
        ...


Model = DynamicsModel | SegmentModel
_LEAST = (
    "The least that a model needs: segment_len, its number of steps H, and "
    "predict_segment(past, actions), which gives the states (B, K, dx) that actions (B, K, du) "
    "of up to H steps lead to"
)


def repeated(step: Callable[[Tensor, Tensor], Tensor], x: Tensor) -> Step:
    """The ``begin`` of a one-step model: x (B, dx) goes through ``step`` (x, u) at each action."""

    def following(u: Tensor) -> Tensor:
        nonlocal x
        x = step(x, u)
        return x

    return following


class Adapted:
    """A SegmentModel as a DynamicsModel, to roll out: its steps are segments of one action.

    The model draws from torch generators alone: rows that share noise go in parts.

    Raises:
        TypeError: naming what the model lacks, or what is not as it has to be.
    """

    def __init__(self, model: SegmentModel) -> None:
        name = type(model).__name__
        needed = ("segment_len", "predict_segment")
        if missing := [word for word in needed if not hasattr(model, word)]:
            raise TypeError(
                f"model is a {name}, which cannot predict: it has no "
                f"{' and no '.join(missing)}. {_LEAST}"
            )
        if type(model.segment_len) is not int or model.segment_len < 1:
            raise TypeError(
                f"segment_len of {name} is {model.segment_len!r:.80}; expected a positive int. "
                f"{_LEAST}"
            )
        self.model, self.segment_len = model, model.segment_len
        self.samples = "generator" in inspect.signature(model.predict_segment).parameters
        self.past_len: int = getattr(model, "past_len", model.segment_len)
        self.stochastic: bool = getattr(model, "stochastic", self.samples)

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """States (B, K, dx) under actions (B, K, du)."""
        if not self.samples:
            return self._checked(past, actions)
        if generator is None or isinstance(generator, NoNoise):  # tells a model with members which
            return self._checked(past, actions, generator=generator)
        # One part after the other: parts may share a generator, which is set back between them.
        parts = [
            self._checked(Segment(*(x[rows] for x in past)), actions[rows], generator=own)
            for rows, own in by_generator(len(actions), generator)
        ]
        return torch.cat(parts)

    def _checked(self, past: Segment, actions: Tensor, **noise: Noise | None) -> Tensor:
        """The model's own prediction; TypeError where it is of another shape."""
        states = self.model.predict_segment(past, actions, **noise)
        expected = (*actions.shape[:2], past.states.shape[2])
        found = getattr(states, "shape", None)
        if not isinstance(states, Tensor) or states.shape != expected:
            raise TypeError(
                f"predict_segment of {type(self.model).__name__} gave a {type(states).__name__}"
                f"{'' if found is None else f' {tuple(found)}'} for actions "
                f"{tuple(actions.shape)}; expected a Tensor of states {expected}"
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
    """A model with ``members``, of which each row of a rollout takes one."""

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
    """States (B, K, dx) under ``actions`` (B, K <= H, du): the mode, or a sample."""
    model = as_dynamics(model)
    if isinstance(model, SegmentModel):
        return model.predict_segment(past, actions, generator=generator)
    step = model.begin(past, generator=generator)
    return torch.stack([step(u) for u in actions.unbind(1)], dim=1)


def rollout(
    model: Model,
    past: Segment | tuple[Numbers, Numbers],
    actions: Numbers,
    *,
    generator: Noise | None = None,
) -> Tensor:
    """Chain segments over a horizon, each predicted one the past of the next (section 3).

    Args:
        model: any dynamics model.
        past: states (B, L, dx), physical units, and the actions (B, L, du) that led to them; at
            least ``model.past_len`` steps. ``tsmlib.trajectory.initial_past`` makes one of a start.
        actions: (B, T, du) in [-1, 1], for any number of steps.
        generator: None for the mode; a torch.Generator for a sample of each row.

    Returns:
        States (B, T, dx), physical units, where the actions are; with gradients.

    Raises:
        TypeError: what is given holds no numbers, or the model cannot predict.
        ValueError: shapes that do not fit the model or each other, values that are not finite, a
            past that is too short, or a model that was never fitted.
    """
    dynamics, predicted = as_dynamics(model), []
    past, actions, home = inputs(model, past, actions)
    for segment_actions in actions.split(dynamics.segment_len, dim=1):
        past = past.last(dynamics.past_len)
        states = predict_segment(model, past, segment_actions, generator=generator)
        predicted.append(states)
        past = past.then(Segment(states, segment_actions))
    return torch.cat(predicted, dim=1).to(home)


def stepper(model: Model, past: Segment, *, generator: Noise | None = None) -> Step:
    """A rollout one action at a time, each chosen after the state before it was seen (section 4.3).

    The states are those of ``rollout`` under the actions that were taken: a code, or a member of an
    ensemble, is held for a segment of H steps, with hidden states carried from step to step; then
    a new segment begins on the last steps. A model that has no ``begin`` takes segments of one
    step, which are the same where H = 1. A Gaussian ``Ensemble`` draws the noise of a segment at
    once, ``rollout`` for no more steps than there are, so that their samples are the same only
    where a rollout is of whole segments.

    Args:
        model: any dynamics model.
        past: states and actions (B, L, .), at least ``model.past_len`` steps.
        generator: as of ``rollout``.

    Returns:
        A function: actions (B, du) -> the states (B, dx) that they lead to.
    """
    dynamics = as_dynamics(model)
    past_len = _past_len(dynamics, past, type(model).__name__)
    recent = [deque(part.unbind(1), maxlen=past_len) for part in past]
    taken, running = 0, None

    def step(u: Tensor) -> Tensor:
        nonlocal running, taken
        if running is None or taken % dynamics.segment_len == 0:
            seen = Segment(*(torch.stack(tuple(part), dim=1) for part in recent))
            running = dynamics.begin(seen, generator=generator)
        x, taken = running(u), taken + 1
        for part, latest in zip(recent, (x, u), strict=True):
            part.append(latest)
        return x

    return step


def require_robot(model: object, robot: Robot, what: str, *, but: tuple[str, ...] = ()) -> None:
    """Compare a model's robot with that of data or a task.

    Args:
        model: one that has a ``robot`` is compared by it, any other by the sizes that it states.
        robot: of the data or task.
        what: what the two are of, such as "the model and its training data".
        but: fields of a robot that may differ.

    Raises:
        ValueError: they differ; both sides are named.
    """
    if not hasattr(model, "state_dim"):  # a prior knows actions alone
        but = (*but, "env", "names", "units", "angles")
    if (own := getattr(model, "robot", None)) is not None:
        own.require_same(robot, what, but=but)
    features = getattr(model, "features", None)
    stated = {name: getattr(model, name, None) for name in ("state_dim", "action_dim")}
    stated["angles"] = tuple(features.angles) if isinstance(features, Features) else None
    for name, value in stated.items():
        if value is not None and value != getattr(robot, name):
            raise ValueError(
                f"{what} are not of one robot: {name} is {value} and {getattr(robot, name)} "
                f"({robot.env}). Expected the same: {type(model).__name__}.for_data(data) makes a "
                "model that fits"
            )


def inputs(
    model: Model, past: Segment | tuple[Numbers, ...], actions: Numbers
) -> tuple[Segment, Tensor, torch.device]:
    """Past and actions as the model's own kind of tensors; and the device that actions are on."""
    if not isinstance(past, tuple) or len(past) != 2:
        raise TypeError(
            f"past is a {type(past).__name__}; expected tsmlib.Segment(states, actions) with "
            "states (B, L, dx) and actions (B, L, du). At the start of an episode: "
            "tsmlib.trajectory.initial_past(states, past_len, action_dim)"
        )
    weight = first_weight(model)
    like = actions if weight is None else weight
    dtype, device = getattr(like, "dtype", None), None if weight is None else weight.device
    if dtype not in (torch.float32, torch.float64):
        dtype = torch.float32
    dx, du = getattr(model, "state_dim", "dx"), getattr(model, "action_dim", "du")
    moves = as_tensor("actions", actions, ("B", "T", du), dtype=dtype, device=device)
    rows, steps, du = moves.shape
    if not rows or not steps:
        raise ValueError(f"actions have shape {tuple(moves.shape)}; expected rows and steps")
    states = as_tensor("past.states", past[0], (rows, "L", dx), dtype=dtype, device=device)
    shape = (rows, states.shape[1], du)
    seen = Segment(states, as_tensor("past.actions", past[1], shape, dtype=dtype, device=device))
    _past_len(as_dynamics(model), seen, type(model).__name__)
    return seen, moves, actions.device if isinstance(actions, Tensor) else torch.device("cpu")


def _past_len(model: DynamicsModel, past: Segment, name: str) -> int:
    """Steps of past that ``model`` reads; ValueError where there are fewer, or no statistics."""
    features = getattr(model, "features", None)
    if isinstance(features, Features) and not features.fitted:
        raise ValueError(
            f"the features of this {name} were never fitted, so it cannot predict: make it with "
            f"{name}.for_data(data), or train it with tsmlib.fit(model, data)"
        )
    needed, found = model.past_len, past.states.shape[1]
    if found < needed:
        raise ValueError(
            f"past holds {found} steps, {name} needs {needed}; at the start of an episode use "
            f"tsmlib.trajectory.initial_past(states, {needed}, action_dim)"
        )
    return needed
