"""Rewards of section 5.3.2: one pure torch function per task, (states, actions) -> reward per step.

The same function scores model rollouts and true trajectories. Time is the last but one dimension;
any leading dimensions broadcast against the targets', so a batch of B targets is the last dimension
before time. A person's own reward is another such function, which ``rewarded`` checks.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import as_tensor, described, require_callable, require_number
from tsmlib.envs.spaces import said
from tsmlib.envs.stepping import make

# states (..., B, T, dx), actions (..., B, T, du) -> (..., B, T)
Reward = Callable[[Tensor, Tensor], Tensor]

TIP = slice(4, 6)  # fingertip x, y in the state, metres
BLOCK = slice(6, 8)  # block x, y in the state, metres


def reach(target: Tensor, *, torque_weight: float = 1.0) -> Reward:
    """Minus the distance of the fingertip from its target, minus a quadratic torque penalty.

    Args:
        target: (B, 2), metres.
        torque_weight: metres per squared torque, zero or above.

    Returns:
        The reward, one number per step.
    """
    return _approach(TIP, target, torque_weight)


def push(target: Tensor, *, torque_weight: float = 1.0) -> Reward:
    """Minus the distance of the object from its target, minus a quadratic torque penalty.

    Args:
        target: (B, 2), metres.
        torque_weight: metres per squared torque, zero or above.

    Returns:
        The reward, one number per step.
    """
    return _approach(BLOCK, target, torque_weight)


def _approach(position: slice, target: Tensor, torque_weight: float) -> Reward:
    goal = as_tensor("target", target, ("B", 2))
    weight = require_number("torque_weight", torque_weight, 0)

    def reward(states: Tensor, actions: Tensor) -> Tensor:
        # The tiny constant keeps the gradient finite where the distance is zero.
        distance = ((states[..., position] - goal[:, None]).square().sum(-1) + 1e-12).sqrt()
        return -distance - weight * actions.square().sum(-1)

    return reward


def reward_of(env: str, *, guided: bool = False) -> Reward:
    """The reward that an environment offers as a torch function.

    Args:
        env: id of an environment with an attribute ``reward_function``, as those of ``tsm/dmc-``.
        guided: the one to plan by, ``guided_reward``, which adds a smooth guide where the task's
            own is zero nearly everywhere; the same where there is none.

    Returns:
        The reward, one number per step of the state that it leads to.

    Raises:
        ValueError: the environment offers none; says how one is given.
    """
    made = make(env)
    names = ("guided_reward", "reward_function") if guided else ("reward_function",)
    offered = (said(made, name) for name in names)
    reward = next((one for one in offered if one is not None), None)
    made.close()
    if reward is None:
        raise ValueError(
            f"{env} offers no reward as a torch function, which plans need; expected "
            "reward=function, of states (..., B, T, dx) and actions (..., B, T, du), one number "
            "per step, or an attribute reward_function of the environment"
        )
    require_reward(reward)
    return reward


def until(ended: Callable[[Tensor], Tensor], reward: Reward) -> Reward:
    """A reward that counts until the episode is over, the step that ends it included.

    To ``reward`` the last step that counts repeats from there on, as in episodes that ended.

    Args:
        ended: states (..., T, dx) -> (..., T) bool, what the environment ends an episode by; a
            model does not know.
        reward: of states and actions, one number per step.

    Returns:
        The reward, zero after the end.
    """
    require_reward(reward)
    require_callable("ended", ended, "a function of states")

    def counted(states: Tensor, actions: Tensor) -> Tensor:
        over = ended(states)
        if not isinstance(over, Tensor) or over.dtype != torch.bool:
            kind = f" of {over.dtype}" if isinstance(over, Tensor) else ""
            raise ValueError(f"ended gave {described(over)}{kind}; expected bool, one per step")
        if over.shape != states.shape[:-1]:
            raise ValueError(
                f"ended gave {described(over)} for states {tuple(states.shape)}; expected "
                f"{tuple(states.shape[:-1])}, one per step"
            )
        counts = over.cumsum(-1) - over.int() < 1
        return torch.where(counts, reward(_held(states, counts), _held(actions, counts)), 0.0)

    return counted


def _held(part: Tensor, counts: Tensor) -> Tensor:
    """States or actions (..., T, d), which stay from the last step that ``counts`` (..., T) on.

    A reward that is infinite beyond the end would have a slope that is NaN, counted or not.
    """
    shape = np.broadcast_shapes(part.shape[:-1], counts.shape)
    part, counts = part.expand(*shape, -1), counts.expand(shape)
    last = counts.sum(-1)[..., None, None] - 1  # (..., 1, 1)
    return torch.where(counts[..., None], part, part.detach().take_along_dim(last, -2))


def final_distance(states: Tensor, target: Tensor, position: slice) -> Tensor:
    """Distance between what has to arrive and its target in the last state.

    Args:
        states: (..., B, T, dx).
        target: (B, 2), metres.
        position: of it in the state, TIP or BLOCK.

    Returns:
        (..., B), metres.
    """
    return (states[..., -1, position] - as_tensor("target", target, ("B", 2))).norm(dim=-1)


def require_reward(reward: object) -> None:
    """TypeError unless ``reward`` can be called."""
    hint = "a function of states (..., B, T, dx) and actions (..., B, T, du), as task.reward"
    require_callable("reward", reward, hint)


def rewarded(reward: Reward, states: Tensor, actions: Tensor) -> Tensor:
    """``reward(states, actions)``, checked.

    Args:
        reward: one number per step.
        states: (..., B, T, dx).
        actions: (..., B, T, du).

    Returns:
        (..., B, T).

    Raises:
        ValueError: the reward fails, or gives something else.
        FloatingPointError: it is NaN or plus infinity although the states are finite.
    """
    asked = f"states {tuple(states.shape)} and actions {tuple(actions.shape)}"
    try:
        rewards = reward(states, actions)
    except (RuntimeError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(
            f"the reward fails on {asked}: {error}. Count dimensions from the right: time is -2, "
            "targets are -3"
        ) from error
    expected = np.broadcast_shapes(states.shape[:-1], actions.shape[:-1])
    if not isinstance(rewards, Tensor) or rewards.shape != expected:
        raise ValueError(
            f"the reward of {asked} is {described(rewards)}; expected a tensor {tuple(expected)}, "
            "one number per step"
        )
    if not rewards.is_floating_point():
        raise ValueError(
            f"the reward of {asked} is of {rewards.dtype}; expected floating-point numbers: "
            "reward.float()"
        )
    impossible = rewards.isnan() | rewards.isposinf()
    unexplained = impossible & torch.isfinite(states).all(-1)
    if unexplained.any():
        where = unexplained.nonzero()[0].tolist()
        raise FloatingPointError(
            f"the reward is {rewards[tuple(where)].item()} for target {where[-2]} at step "
            f"{where[-1]}, although the state there is finite; look for a division, a logarithm or "
            "a root in it"
        )
    return rewards


@torch.no_grad()
def fingerprint(
    reward: Reward, start: Tensor, horizon: int, action_dim: int
) -> tuple[float, float]:
    """Mean and deviation of a reward on random states and actions: what it is, by values.

    Args:
        reward: one number per step.
        start: (B, dx), around which the states wander.
        horizon: T, steps.
        action_dim: du.

    Returns:
        Two numbers, the same on every machine up to rounding.
    """
    generator = torch.Generator().manual_seed(0)
    wander = torch.randn(len(start), horizon, start.shape[1], generator=generator).cumsum(1)
    scale = 0.1 * (start.std(0, unbiased=False) + start.abs().mean(0))
    actions = 2 * torch.rand(len(start), horizon, action_dim, generator=generator) - 1
    rewards = rewarded(reward, start[:, None] + scale * wander, actions).double()
    return float(rewards.mean()), float(rewards.std(unbiased=False))
