"""PushT as a task: the measures of success that the field uses, costs, and pairs (start, goal).

Protocols are never mixed; ``docs/explanation/pusht.md`` says where each comes from. States are
(..., 7) in pixels and radians, goals (..., 7) broadcast against them.
"""

from __future__ import annotations

import math
from contextlib import closing
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from tsmlib.checks import require_choice, require_count
from tsmlib.collection import collect
from tsmlib.envs.pusht import weak_policy
from tsmlib.envs.pusht_field import (
    ENV_ID,
    SHAPES,
    SIZE,
    PushTPhysics,
    placed,
    pusht_physics,
    require_in_field,
    require_states,
    symmetric_copies,
)
from tsmlib.envs.stepping import make_simulation
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward
from tsmlib.trajectory import Trajectories

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
    solved = F.pad(solved_c(states, goal[..., None, :]), (HELD - 1, 0))  # held by no shorter one
    return solved.unfold(-1, HELD, 1).all(-1).any(-1)


def distance(states: Tensor, goal: Tensor, corners: Tensor | None = None) -> Tensor:
    """Mean distance of the T's corners from the goal's: (..., 7) twice -> (...), px."""
    corners = corners_of(PushTPhysics()) if corners is None else corners
    return (_placed(corners, states) - _placed(corners, goal)).norm(dim=-1).mean(-1)


def corners_of(physics: PushTPhysics) -> Tensor:
    """The corners (P, 2) of the T's boxes in its own frame, px."""
    return torch.from_numpy(physics.boxes).float().flatten(0, 1)


def closest(
    goal: Tensor, *, pusher: bool, held: int = 1, physics: PushTPhysics | None = None
) -> Reward:
    """Reward of coming close to a goal once: minus the least distance in an episode, in px.

    The distance of a state is the mean over the corners of the T, with ``pusher`` together with the
    pusher's by Pythagoras. What counts is the best of all moments, since the first hit is a
    success; a tenth of the mean over time is added, so that plans that get there sooner are better.

    Args:
        goal: (B, 7).
        pusher: whether the pusher has a goal too.
        held: steps in a row of which the worst counts.
        physics: of the field; the standard one's without.

    Returns:
        A reward of states (..., B, T, 7), given in the last step, but for the mean.
    """
    corners = corners_of(physics or PushTPhysics())

    def reward(states: Tensor, actions: Tensor) -> Tensor:
        away = distance(states, goal[:, None], corners)  # (..., B, T)
        if pusher:
            away = (away.square() + (states[..., :2] - goal[:, None, :2]).square().sum(-1)).sqrt()
        steps = away.shape[-1]
        best = away.unfold(-1, min(held, steps), 1).amax(-1).amin(-1)
        last = torch.arange(steps) == steps - 1
        return -torch.where(last, best[..., None], 0.0) - 0.1 * away / steps

    return reward


def random_play(
    episodes: int, *, horizon: int = 100, seed: int = 0, symmetries: bool = True, env: str = ENV_ID
) -> Trajectories:
    """Collect episodes of random play (``weak_policy``), as training data.

    An episode ends where the T leaves the picture, squeezed out by pusher and wall; those that are
    then shorter than 30 steps are left out.

    Args:
        episodes: simulated.
        horizon: steps of each.
        seed: of starts and actions.
        symmetries: whether to add the quarter turns and mirror images, eight copies in all; of
            shapes that differ from their mirror image four.
        env: id of the field.

    Returns:
        Episodes of up to ``horizon`` steps.
    """
    physics, states, actions = pusht_physics(env), [], []
    with closing(make_simulation(env, require_count("episodes", episodes))) as fields:
        policy = weak_policy(torch.Generator().manual_seed(seed))
        played = collect(fields, policy, horizon=horizon, past_len=1, seed=seed)
    corners = placed(physics.boxes.reshape(-1, 2), played.states)
    outside = np.asarray(((corners < 0) | (corners > SIZE)).any((-2, -1)))
    ends = np.where(outside.any(1), outside.argmax(1) - 1, horizon)
    pairs = [(played.states, played.actions)]
    if symmetries:
        pairs = symmetric_copies(played.states, played.actions, physics.shape)
    for x, u in pairs:
        kept = [i for i, end in enumerate(ends) if end >= min(30, horizon)]
        states += [x[i, : ends[i] + 1] for i in kept]
        actions += [u[i, : ends[i]] for i in kept]
    robot = played.robot
    return Trajectories(states, actions, env, robot.dt, robot.names, robot.units, robot.angles)


PROTOCOLS = {  # success, steps, whether the pusher has a goal, and steps to hold
    "A": (success_a, 300, False, 1),
    "B": (success_b, 50, True, 1),
    "C": (success_c, 50, False, HELD),
}


def pusht_task(
    start: np.ndarray, goal: np.ndarray, protocol: str = "B", *, env: str = ENV_ID
) -> Task:
    """Pairs (start, goal) as a task under one of the protocols.

    Args:
        start: (B, 7), px and rad.
        goal: (B, 7); the pusher's part means something in protocol B alone.
        protocol: "A", "B" or "C".
        env: id of the field.

    Raises:
        ValueError: a goal outside the field, or a pair that is solved at the start; it is named.
    """
    success, horizon, pusher, held = PROTOCOLS[require_choice("protocol", protocol, PROTOCOLS)]
    physics = pusht_physics(env)
    start = require_states("start", start, len(np.atleast_2d(start))).astype(np.float32)
    goal = require_states("goal", goal, len(start)).astype(np.float32)
    require_in_field("goal", goal, physics)
    target = torch.from_numpy(goal)
    solved = success(torch.from_numpy(start)[:, None].expand(-1, HELD, -1), target)
    if solved.any():
        i = int(solved.nonzero()[0])
        raise ValueError(
            f"pair {i} is solved at the start by protocol {protocol}: T at {start[i, 2:4]}, goal "
            f"at {goal[i, 2:4]}; expected pairs in which something is left to do"
        )
    return Task(
        f"pusht {protocol}",
        env,
        start,
        target,
        partial(closest, pusher=pusher, held=held, physics=physics),
        horizon=horizon,
        success_for=lambda goal: partial(success, goal=goal),
    )


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
