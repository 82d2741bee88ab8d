"""Swinging up Gymnasium's pendulum: the task, its episodes, and what is drawn of them in 10_explore."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import torch
from torch import Tensor

from tsmlib.collection import collect, collect_random, open_loop
from tsmlib.envs.stepping import make_simulation
from tsmlib.models.action_prior import ActionPrior
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.planning.tasks import Task
from reproduction.results.exploration import HORIZON, PENDULUM
from tsmlib.trajectory import Trajectories

TESTED = 1000  # seed of the starts that measure, of no episode that is learned from
BEGINNING = 50_000  # of the random episodes before round 1, by a training seed of 0; each next one has 1,000 more


def upright(states: Tensor, actions: Tensor) -> Tensor:
    """Height of the pendulum, from -1 to 1, less what its speed costs."""
    return states[..., 0] - 0.01 * states[..., 2].square()


def swing_up(n: int, seed: int) -> Task:
    """Swinging the pendulum up, from starts of the environment; success is to end within 18 degrees of upright."""
    return Task.from_env(
        PENDULUM,
        n=n,
        horizon=HORIZON,
        seed=seed,
        reward=upright,
        success=lambda x: x[:, -1, 0] > 0.95,
    )


def first_episodes(n: int, seed: int) -> Trajectories:
    """Random episodes of the pendulum that a loop begins with, by training seed."""
    return random_episodes(n, BEGINNING + 1000 * seed)


def random_episodes(n: int, seed: int) -> Trajectories:
    """Smooth random torques, which hardly ever swing the pendulum up."""
    return collect_random(PENDULUM, n, horizon=HORIZON, seed=seed, rms=0.6, time_constant=0.3)


def walks(prior: ActionPrior, n: int, *, seed: int = 0) -> Trajectories:
    """What random codes of a prior do, an episode of each, from the environment's own starts."""
    segments = HORIZON // prior.segment_len
    codes = torch.randn(
        n, segments, prior.latent_dim, generator=torch.Generator().manual_seed(seed)
    )
    with torch.no_grad():
        actions = LatentActions(prior, HORIZON).decode(codes[None])[0]
    with closing(make_simulation(PENDULUM, n)) as simulation:
        return collect(simulation, open_loop(actions), horizon=HORIZON, seed=seed)


def plane(data: Trajectories) -> np.ndarray:
    """Angle from upright (rad) and angular velocity (rad/s) of every state (n, 2)."""
    cos, sin, speed = np.concatenate(
        [x[: n + 1] for x, n in zip(data.states, data.steps, strict=True)]
    ).T
    return np.stack([np.arctan2(sin, cos), speed], axis=1)


def highest(data: Trajectories) -> float:
    """Mean over episodes of the greatest height, from -1 (hanging) to 1 (upright)."""
    return float(data.states[..., 0].max(1).mean())
