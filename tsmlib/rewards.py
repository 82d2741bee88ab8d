"""Tasks of section 5.3.2: one pure torch function per task, (states, actions) -> reward per step.

The same function scores model rollouts and true trajectories. Time is the last but one dimension; any leading
dimensions broadcast against the targets', so a batch of B targets is the last dimension before time.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Reward = Callable[[Tensor, Tensor], Tensor]  # states (..., B, T, dx), actions (..., B, T, du) -> (..., B, T)

TIP = slice(4, 6)  # fingertip x, y in the state, metres
BLOCK = slice(6, 8)  # block x, y in the state, metres


def reach(target: Tensor, *, torque_weight: float = 1.0) -> Reward:
    """Minus the distance (m) of the fingertip from ``target`` (B, 2), minus a quadratic torque penalty."""
    return _approach(TIP, target, torque_weight)


def push(target: Tensor, *, torque_weight: float = 1.0) -> Reward:
    """Minus the distance (m) of the object from ``target`` (B, 2), minus a quadratic torque penalty."""
    return _approach(BLOCK, target, torque_weight)


def _approach(position: slice, target: Tensor, torque_weight: float) -> Reward:
    def reward(states: Tensor, actions: Tensor) -> Tensor:
        # The tiny constant keeps the gradient finite where the distance is zero.
        distance = ((states[..., position] - target[:, None]).square().sum(-1) + 1e-12).sqrt()
        return -distance - torque_weight * actions.square().sum(-1)

    return reward


def final_distance(states: Tensor, target: Tensor, position: slice) -> Tensor:
    """Metres between ``position`` (TIP or BLOCK) and ``target`` (B, 2) in the last state of (..., B, T, dx)."""
    return (states[..., -1, position] - target).norm(dim=-1)
