"""What a dynamics model is, and how segments are chained into horizons.

A dynamics model maps a past segment and planned actions to future states. A one-step model is a segment model with
H = 1. Everything else in the package (plan, learn a policy, score, draw) is written once against this.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from tsmlib.nets import Noise
from tsmlib.trajectory import Segment, Window


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

    Each predicted segment becomes the past of the next one. The past must hold at least ``model.past_len`` steps.
    """
    if past.states.shape[1] < model.past_len:
        raise ValueError(
            f"the past holds {past.states.shape[1]} steps, {type(model).__name__} needs {model.past_len}; "
            "at the start of an episode use tsmlib.trajectory.initial_past"
        )
    predicted = []
    for segment_actions in actions.split(model.segment_len, dim=1):
        states = model.predict_segment(past.last(model.past_len), segment_actions, generator=generator)
        predicted.append(states)
        past = past.last(model.past_len).then(Segment(states, segment_actions))
    return torch.cat(predicted, dim=1)
