"""Tasks of section 5.3.2: one pure torch function per task, (states, actions) -> reward per step.

The same function scores model rollouts and true trajectories. Time is the last but one dimension; any leading
dimensions broadcast against the targets', so a batch of B targets is the last dimension before time. A person's own
task is another such function; ``rewarded`` says what is wrong with one.
"""

from collections.abc import Callable

import torch
from torch import Tensor

Reward = Callable[
    [Tensor, Tensor], Tensor
]  # states (..., B, T, dx), actions (..., B, T, du) -> (..., B, T)

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


def until(ended: Callable[[Tensor], Tensor], reward: Reward) -> Reward:
    """``reward`` up to and with the first step after which the episode is over, and nothing from there on.

    ended: states (..., T, dx) -> (..., T) bool, what the environment ends an episode by: a model does not know. To
    ``reward`` the last step that counts repeats from there on, as it does in episodes that ended.
    """

    def counted(states: Tensor, actions: Tensor) -> Tensor:
        over = ended(states).int()
        counts = over.cumsum(-1) - over < 1
        return torch.where(counts, reward(_held(states, counts), _held(actions, counts)), 0.0)

    return counted


def _held(part: Tensor, counts: Tensor) -> Tensor:
    """States or actions (..., T, d), from the last step that ``counts`` (..., T) on as they are there.

    A reward that is infinite beyond the end would have a slope that is NaN, whether it is counted or not.
    """
    shape = torch.broadcast_shapes(part.shape[:-1], counts.shape)
    part, counts = part.expand(*shape, -1), counts.expand(shape)
    last = counts.sum(-1)[..., None, None] - 1  # (..., 1, 1)
    return torch.where(counts[..., None], part, part.detach().take_along_dim(last, -2))


def final_distance(states: Tensor, target: Tensor, position: slice) -> Tensor:
    """Metres between ``position`` (TIP or BLOCK) and ``target`` (B, 2) in the last state of (..., B, T, dx)."""
    return (states[..., -1, position] - target).norm(dim=-1)


def rewarded(reward: Reward, states: Tensor, actions: Tensor) -> Tensor:
    """``reward(states, actions)``, checked: one number per step, (..., B, T) for states (..., B, T, dx).

    ValueError where it is something else; FloatingPointError where it is NaN although the states are finite.
    """
    given = f"states {tuple(states.shape)} and actions {tuple(actions.shape)}"
    try:
        found = reward(states, actions)
    except (RuntimeError, IndexError) as error:
        raise ValueError(
            f"the reward fails on {given}: {error}. Count dimensions from the right: time is -2, targets are -3"
        ) from error
    expected = torch.broadcast_shapes(states.shape[:-1], actions.shape[:-1])
    if not isinstance(found, Tensor) or found.shape != expected:
        what = (
            f"a tensor {tuple(found.shape)}"
            if isinstance(found, Tensor)
            else f"a {type(found).__name__}"
        )
        raise ValueError(
            f"the reward of {given} is {what}; expected a tensor {tuple(expected)}, one number per step"
        )
    unexplained = found.isnan() & torch.isfinite(states).all(-1)
    if unexplained.any():
        where = unexplained.nonzero()[0].tolist()
        raise FloatingPointError(
            f"the reward is nan for target {where[-2]} at step {where[-1]}, although the state there is finite; look "
            "for a division, a logarithm or a root in it"
        )
    return found
