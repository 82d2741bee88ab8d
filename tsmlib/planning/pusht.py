"""PushT as a task: the measures of success that the field uses, costs, and pairs (start, goal).

Protocols are never mixed; ``docs/explanation/pusht.md`` says where each comes from. States are
(..., 7) in pixels and radians, goals (..., 7) broadcast against them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tsmlib.envs.pusht_field import SHAPES

COVERED = 0.95  # A: share of the goal's area
NEAR, TURNED = 20.0, math.pi / 9  # B: px of (pusher, T) as one vector of four, rad
STRICT, STRICTLY_TURNED, HELD = 10.0, math.radians(10), 3  # C: px and rad of the T alone; steps


def turned_by(states: Tensor, goal: Tensor) -> Tensor:
    """Angle between T and goal, the shorter way: (...), rad."""
    difference = states[..., 4] - goal[..., 4]
    return torch.atan2(difference.sin(), difference.cos()).abs()


def coverage(states: Tensor, goal: Tensor, *, scale: float = 30.0, points: int = 16) -> Tensor:
    """Share of the goal's area that the T covers, by a grid of ``points`` to a scale: (...)."""
    cell = (torch.arange(4 * points) + 0.5) / points - 2.0
    x, y = torch.meshgrid(cell, cell + 2.0, indexing="ij")
    grid = torch.stack([x.flatten(), y.flatten()], dim=-1)
    grid = grid[_inside(grid)] * scale
    world = _placed(grid, goal)
    cosine, sine = states[..., 4, None].cos(), states[..., 4, None].sin()
    x, y = (world - states[..., None, 2:4]).unbind(-1)
    own = torch.stack([cosine * x + sine * y, cosine * y - sine * x], dim=-1) / scale
    return _inside(own).float().mean(-1)


def success_a(states: Tensor, goal: Tensor) -> Tensor:
    """Protocol A, Diffusion Policy: 95 % of the goal covered once. (..., T, 7) -> (...) bool."""
    return (coverage(states, goal[..., None, :]) >= COVERED).any(-1)


def solved_b(states: Tensor, goal: Tensor) -> Tensor:
    """Protocol B in each state: pusher and T within 20 px and pi / 9. (..., 7) -> (...) bool."""
    away = (states[..., :4] - goal[..., :4]).norm(dim=-1)
    return (away < NEAR) & (turned_by(states, goal) < TURNED)


def success_b(states: Tensor, goal: Tensor) -> Tensor:
    """Protocol B, DINO-WM and stable-worldmodel: solved in any state. (..., T, 7) -> (...) bool."""
    return solved_b(states, goal[..., None, :]).any(-1)


def solved_c(states: Tensor, goal: Tensor) -> Tensor:
    """Protocol C in each state: the T within 10 px and 10 degrees. (..., 7) -> (...) bool."""
    away = (states[..., 2:4] - goal[..., 2:4]).norm(dim=-1)
    return (away < STRICT) & (turned_by(states, goal) < STRICTLY_TURNED)


def success_c(states: Tensor, goal: Tensor) -> Tensor:
    """Protocol C, CLEAR-LeWM Strict: solved in three states in a row. (..., T, 7) -> (...) bool."""
    return solved_c(states, goal[..., None, :]).unfold(-1, HELD, 1).all(-1).any(-1)


def _inside(points: Tensor) -> Tensor:
    """Whether points (..., 2) in units of the scale lie in the T."""
    return torch.stack(
        [
            (points[..., 0] >= left)
            & (points[..., 0] < right)
            & (points[..., 1] >= top)
            & (points[..., 1] < bottom)
            for left, top, right, bottom in SHAPES["T"]
        ]
    ).any(0)


def _placed(points: Tensor, states: Tensor) -> Tensor:
    """Points (P, 2) of the T's frame where it is in states (..., 7): (..., P, 2)."""
    cosine, sine = states[..., 4, None].cos(), states[..., 4, None].sin()
    x, y = points.unbind(-1)
    turned = torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)
    return turned + states[..., None, 2:4]
