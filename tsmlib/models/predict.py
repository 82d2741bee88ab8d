"""Predictions from whatever holds numbers, for one episode or many."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import LARGEST, as_tensor, require_count, require_seed
from tsmlib.models.base import Model, Numbers, as_dynamics, inputs, rollout
from tsmlib.trajectory import Segment, initial_past


@torch.no_grad()
def predict(
    model: Model,
    past: Segment | tuple[Numbers, Numbers] | Numbers,
    actions: Numbers,
    samples: int | None = None,
    *,
    seed: int = 0,
) -> Tensor:
    """Predict the states that follow ``past`` under ``actions``.

    Args:
        past: states (B, L, dx), physical units, and the actions (B, L, du) that led to them, as a
            Segment or a pair; or states (B, dx) in which episodes begin.
        actions: (B, T, du) in [-1, 1], for any number of steps. Without B, and the past as well,
            they are of one episode.
        samples: None for the mode; a number S for as many draws.
        seed: of the draws.

    Returns:
        States (B, T, dx) or samples (S, B, T, dx), physical units, without gradients; without B
        where the actions have none. ``tsmlib.rollout`` has gradients.

    Raises:
        TypeError: what is given holds no numbers.
        ValueError: shapes that do not fit, values that are not finite, or a past that is too short.
    """
    moves = _array("actions", actions)
    one = moves.ndim == 2
    if isinstance(past, tuple):
        given = tuple(_array("past", part) for part in past)
        seen = tuple(part[None] for part in given) if one else given
    else:
        dx = getattr(model, "state_dim", "dx")
        start = as_tensor("past", past, (dx,) if one else ("B", dx))
        du = moves.shape[-1] if moves.ndim else 1
        seen = initial_past(start[None] if one else start, as_dynamics(model).past_len, du)
    seen, moves, home = inputs(model, seen, moves[None] if one else moves)
    if samples is None:
        states = rollout(model, seen, moves).to(home)
    else:
        copies = require_count("samples", samples, most=LARGEST)
        repeated = Segment(*(part.repeat(copies, 1, 1) for part in seen))
        draw = torch.Generator().manual_seed(require_seed("seed", seed))
        states = rollout(model, repeated, moves.repeat(copies, 1, 1), generator=draw).to(home)
        states = states.unflatten(0, (copies, -1))  # (S, B, T, dx)
    return states.squeeze(-3) if one else states


def _array(name: str, value: Numbers) -> Tensor | np.ndarray:
    """A tensor as it is, all else as an array; TypeError for what is uneven."""
    try:
        return value if isinstance(value, Tensor) else np.asarray(value)
    except ValueError as error:
        raise TypeError(f"{name} is uneven; expected an array of numbers: {error}") from error
