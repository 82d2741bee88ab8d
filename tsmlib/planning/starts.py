"""Starts and targets of a task: which there can be, and that they come back.

Letters in shapes: B starts, dx size of state.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib import rewards
from tsmlib.checks import require_count, require_type
from tsmlib.envs.geometry import hole, room
from tsmlib.envs.ids import UnsupportedEnvironment
from tsmlib.envs.spec import EnvSpec, is_arm
from tsmlib.envs.stepping import Simulation, make_simulation


def chosen_indices(chosen: int | Sequence[int], n: int, env: str) -> list[int]:
    """Indices below ``n`` that a number of first ones, or a list, means."""
    require_type("chosen", chosen, (int, np.integer, Iterable), "a number or indices")
    if isinstance(chosen, int | np.integer):
        count = require_count("the number of targets", chosen)
        if count > n:
            raise ValueError(f"{chosen} targets of {env} asked for; choose a number from 1 to {n}")
        chosen = range(count)
    indices = [require_count("an index of a target", i, least=0) for i in np.atleast_1d(chosen)]
    if not indices or max(indices) >= n:
        raise ValueError(f"targets {indices} of {env} asked for; choose some from 0 to {n - 1}")
    return indices


def require_within_limit(env: str, horizon: int) -> None:
    """ValueError where an environment ends its episodes before ``horizon`` steps."""
    base = env.partition("(")[0]
    spec = gymnasium.registry.get(base)
    if spec and (limit := spec.max_episode_steps) and horizon > limit:
        raise ValueError(
            f"horizon is {horizon}, but {env} ends episodes after {limit} steps; "
            f"give horizon={limit} or less, or register a longer one: gymnasium.register(id, "
            f"..., max_episode_steps={horizon})"
        )


def begin(env: str, n: int, seed: int) -> tuple[Simulation, np.ndarray]:
    """The simulation of ``n`` episodes, and their starts (n, dx), which are the same twice."""
    try:
        episodes = make_simulation(EnvSpec.parse(env).arm.id if is_arm(env) else env, n)
    except gymnasium.error.Error as error:
        raise ValueError(f"env is {env!r:.80}, which cannot be made: {error}") from error
    with closing(episodes) as begun:
        start, again = (begun.reset(seed=seed).astype(np.float32) for _ in range(2))
    differs = np.argwhere(start != again)
    if len(differs):
        i, d = differs[0]
        raise UnsupportedEnvironment(
            f"{env} does not repeat itself: the same seed gave {begun.names[d]} = "
            f"{start[i, d]:.6g} and then {again[i, d]:.6g} at start {i}. A task needs starts that "
            "come back: seed all "
            "random numbers by reset(seed=...), and leave out wrappers that normalise by what was "
            "seen before, such as gymnasium.wrappers.NormalizeObservation"
        )
    return begun, start


def require_same_starts(states: Tensor, start: Tensor, what: str, task: str) -> None:
    """ValueError unless ``states`` (B, dx) are the ``start`` (B, dx) of a task, up to rounding."""
    if states.shape != start.shape:
        raise ValueError(
            f"{what} begins in states {tuple(states.shape)}, {task} in "
            f"{tuple(start.shape)}; expected the same starts"
        )
    off = (states - start).abs()
    rounding = 1e-5 * torch.maximum(start.abs(), states.abs()).amax(0)
    if (off > rounding).any():
        i, d = (off > rounding).nonzero()[0].tolist()
        raise ValueError(
            f"{what} begins with {float(states[i, d]):.6g} in dimension {d} of target {i}, "
            f"{task} with {float(start[i, d]):.6g}; expected the same starts"
        )


def require_reachable(env: str, start: np.ndarray, target: Tensor, position: slice) -> None:
    """ValueError unless there is one target (B, 2) per start, in metres, where the arm gets."""
    if position.stop > start.shape[1]:
        raise ValueError(f"there is nothing to push in {env}; its task is 'reach'")
    if target.shape != (len(start), 2):
        raise ValueError(
            f"target is {tuple(target.shape)}; expected ({len(start)}, 2), one per start"
        )
    physics = EnvSpec.parse(env).physics
    if position == rewards.TIP:
        what, outer, inner = "fingertip", sum(physics.link_lengths), hole(physics)
        away = target.norm(dim=1)
        within = (away <= outer + 1e-6) & (away >= inner - 1e-6)
        limit = f"{outer:g} m from the shoulder"
        if inner:
            limit += f" and not into the hole around it, expected {inner:g} to {outer:g} m"
    else:
        what, outer = "object", room(physics)
        within = target.abs().amax(1) <= outer + 1e-6
        limit = f"{outer:g} m along x and y, where the walls are"
    if not within.all():
        i = int((~within).nonzero()[0])
        x, y = target[i].tolist()
        raise ValueError(
            f"target {i} at ({x:.3f}, {y:.3f}) m is out of reach: the {what} gets as far as {limit}"
        )
