"""What a dynamics model is, and how segments are chained into horizons.

A dynamics model maps a past segment and planned actions to future states. A one-step model is a segment model with
H = 1. Everything else in the package (plan, learn a policy, score, draw) is written once against this.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from tsmlib.models.layers import on_device_of
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Window

Step = Callable[[Tensor], Tensor]  # an action (B, du) -> the state (B, dx) that it leads to


class DynamicsModel(Protocol):
    """P(X+ | X-, U-, U+) over segments of up to ``segment_len`` steps, given ``past_len`` steps of past."""

    segment_len: int
    past_len: int

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """What training minimises: a scalar for one batch of windows."""
        ...

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        """Future states (B, K, dx) under ``actions`` (B, K <= H, du). No generator: the mode; with one: a sample."""
        ...


def rollout(model: DynamicsModel, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
    """Chain segments over a horizon: ``actions`` (B, T, du) -> states (B, T, dx), physical units (section 3).

    Each predicted segment becomes the past of the next one. The past must hold at least ``model.past_len`` steps. What
    is given may be on another device than the model; the states are where the actions are.
    """
    _require_past(model, past)
    home, (*known, actions) = actions.device, on_device_of(model, *past, actions)
    past, predicted = Segment(*known), []
    for segment_actions in actions.split(model.segment_len, dim=1):
        states = model.predict_segment(past.last(model.past_len), segment_actions, generator=generator)
        predicted.append(states)
        past = past.last(model.past_len).then(Segment(states, segment_actions))
    return torch.cat(predicted, dim=1).to(home)


def stepper(model: DynamicsModel, past: Segment, *, generator: Noise | None = None) -> Step:
    """Roll out one action at a time, each chosen after the state before it was seen, as a policy acts (section 4.3).

    The states are those of ``rollout`` under the actions that were taken: a code, or a member of an ensemble, is held
    for a segment of H steps, with activations and hidden states carried from step to step; then a new segment begins on
    the last steps. A model that cannot do this (it has no ``stepper`` of its own) predicts segments of one action, each
    on the last ``past_len`` steps and with noise of its own. The two agree where H = 1.
    """
    _require_past(model, past)
    begin = getattr(model, "stepper", None)
    states, actions = (deque(part.unbind(1), maxlen=model.past_len) for part in past)
    running, taken = None, 0

    def step(u: Tensor) -> Tensor:
        nonlocal running, taken
        if begin is None or taken % model.segment_len == 0:
            recent = Segment(torch.stack(tuple(states), dim=1), torch.stack(tuple(actions), dim=1))
            if begin is not None:
                running = begin(recent, generator=generator)
        if running is not None:
            x = running(u)
        else:
            x = model.predict_segment(recent, u[:, None], generator=generator)[:, 0]
        states.append(x)
        actions.append(u)
        taken += 1
        return x

    return step


def _require_past(model: DynamicsModel, past: Segment) -> None:
    if past.states.shape[1] < model.past_len:
        raise ValueError(
            f"the past holds {past.states.shape[1]} steps, {type(model).__name__} needs {model.past_len}; "
            "at the start of an episode use tsmlib.trajectory.initial_past"
        )
