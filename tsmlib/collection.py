"""Collection of trajectories: any controller, in many episodes at once.

Random data, a running planner and a policy under test are the same call with another controller.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib.trajectory import Segment, Trajectories, initial_past

Controller = Callable[[Segment], Tensor]  # the past (N, L, .) -> the next K actions (N, K, du), then asked again


def collect(
    env: gymnasium.vector.VectorEnv,
    controller: Controller,
    *,
    horizon: int = 100,  # section 5.1
    past_len: int = 10,
    seed: int | None = None,
    states: np.ndarray | None = None,
) -> Trajectories:
    """Run one episode in each of ``env``'s N copies for ``horizon`` steps (dt 0.02 s).

    Episodes start from the environment's own distribution, drawn from ``seed``, or from ``states`` (N, dx).
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected a positive number of steps")
    start, _ = env.reset(seed=seed, options=None if states is None else {"states": states})
    arms: Any = env  # they have rollout
    arm: Any = env.unwrapped  # an ArmVectorEnv: it has dt, names, units and angles
    past = initial_past(torch.from_numpy(start).float(), past_len, arm.single_action_space.shape[0])
    seen, done, taken = [start[:, None]], [], 0
    while taken < horizon:
        actions = controller(past).detach().clamp(-1, 1)[:, : horizon - taken]
        if actions.shape[1] < 1:
            raise ValueError(f"the controller gave no actions when asked at step {taken} of {horizon}")
        reached = arms.rollout(actions.numpy())
        past = past.then(Segment(torch.from_numpy(reached).float(), actions)).last(past_len)
        seen.append(reached)
        done.append(actions.numpy())
        taken += actions.shape[1]
    return Trajectories(
        states=np.concatenate(seen, axis=1, dtype=np.float32),
        actions=np.concatenate(done, axis=1, dtype=np.float32),
        env=arm.spec.id,
        dt=arm.dt,
        names=tuple(arm.names),
        units=tuple(arm.units),
        angles=tuple(arm.angles),
    )


def smooth_torques(
    n: int,
    horizon: int,
    *,
    generator: torch.Generator,
    action_dim: int = 2,
    rms: float = 0.1,  # of full torque; at most 10 % of steps at the elbow stop, most objects met (01_collect)
    time_constant: float = 0.03,  # s, of each of the two poles: their power density halves at 3.4 Hz
    dt: float = 0.02,
) -> Tensor:
    """Smooth random torques (section 5.1): white noise through two poles, (n, horizon, action_dim).

    The filter starts at rest, so the first torques are small; they settle to a root mean square of ``rms``, clipped.
    """
    if n < 1 or horizon < 1:
        raise ValueError(f"n is {n}, horizon is {horizon}, expected a positive number of episodes and of steps")
    keep = np.exp(-dt / time_constant)
    noise = torch.randn(n, horizon, action_dim, generator=generator).numpy()
    once, twice, torques = np.zeros((n, action_dim)), np.zeros((n, action_dim)), np.empty_like(noise)
    for step in range(horizon):
        once = keep * once + (1 - keep) * noise[:, step]
        twice = keep * twice + (1 - keep) * once
        torques[:, step] = twice
    settled = (1 - keep) ** 2 * np.sqrt((1 + keep**2) / (1 - keep**2) ** 3)  # standard deviation of two equal poles
    return torch.from_numpy((torques * (rms / settled)).clip(-1, 1).astype(np.float32))


def open_loop(actions: Tensor) -> Controller:
    """The open-loop controller that plays ``actions`` (N, T, du) from the start of an episode."""
    return lambda past: actions
