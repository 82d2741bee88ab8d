"""Episodes of a policy inside a model (section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tsmlib.checks import require_count
from tsmlib.models.base import Model, as_dynamics, stepper
from tsmlib.models.layers import on_device_of
from tsmlib.policies.networks import Policy
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, initial_past


def imagine(
    policy: Policy,
    model: Model,
    start: Tensor | Segment,
    target: Tensor,
    *,
    horizon: int = 50,
    noise: float = 0.01,
    generator: Noise | None = None,
) -> Segment:
    """Predicted rollout of a policy, differentiable in its parameters.

    Args:
        policy: that acts.
        model: that predicts, on the policy's device.
        start: (R, dx), on any device; or the past, states (R, L, dx) and actions (R, L, du).
        target: (R, dg), on any device.
        horizon: T, steps (A.3).
        noise: standard deviation of the policy's output (A.3).
        generator: of the noise and the model's samples; none without, and the model's mode.

    Returns:
        States (R, T, dx) and actions (R, T, du), where ``target`` is.
    """
    horizon = require_count("horizon", horizon)
    home = target.device
    if not isinstance(start, Segment):
        start = initial_past(start, imagined_past(policy, model), policy.action_dim)
    *both, target = on_device_of(policy, *start, target)
    past = Segment(*both)
    drawn: Sequence[Tensor | None] = [None] * horizon
    if generator is not None:
        shape = (len(target), horizon, policy.output_dim)
        drawn = (noise * standard_normal(shape, generator, target)).unbind(1)
    act, step = policy.begin(past, target), stepper(model, past, generator=generator)
    x, u, states, actions = past.states[:, -1], past.actions[:, -1], [], []
    for disturbance in drawn:
        u = act(x, u, disturbance)
        x = step(u)
        states.append(x)
        actions.append(u)
    return Segment(torch.stack(states, dim=1).to(home), torch.stack(actions, dim=1).to(home))


def imagined_past(policy: Policy, model: Model) -> int:
    """Steps of past that a policy and a model read.

    Args:
        policy: that acts.
        model: that predicts.

    Returns:
        The longer of the two.
    """
    return max(policy.past_len, as_dynamics(model).past_len)
