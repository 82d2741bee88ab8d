"""Signs that a plan exploits its model: physical invariants that its dream breaks, torques unlike the training data's.

The paper describes both in words (sections 5.3.2 and 5.3.5: objects that move untouched, an arm that passes through
them, sharp torques) and gives no numbers; the thresholds here are ours. Arrays in, numbers out.

Letters in shapes: S samples, B plans, T steps, H segment length; leading dimensions ``...`` are free.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tsmlib.envs.base import BLOCK_DECAY, BLOCK_RADIUS, DT, WALL, closest_gap, task_of

NEAR = 0.005  # metres: closer than this the arm may be touching the object; deeper than this it is inside it
SUBSTEPS = 8  # between two states, along the straight line in state space, so that a fast touch is not missed


def broken(states: np.ndarray, env: str) -> dict[str, np.ndarray]:
    """Which steps of trajectories (..., T + 1, dx), from their true start on, break an invariant: (..., T) bool each.

    ``moves_untouched``: since some earlier state arm and walls have kept 5 mm away from the object, and yet the
    object is more than 5 mm further from where it was then than its speed at that time can carry it.
    ``penetrates``: the arm is more than 5 mm inside the object. ``broken``: one or both.

    An object that was pushed slides on: "moves by 5 mm in a step while the arm is away" is also true of the real
    world, in 3 % of the steps of random torques, and therefore no invariant.
    ValueError where there is no object that could move, or a state is not finite.
    """
    states = np.asarray(states, np.float64)
    if task_of(env) != "push":
        raise ValueError(f"no object moves in {env}; these invariants are those of a push environment")
    if states.ndim < 2 or states.shape[-2] < 2 or not np.isfinite(states).all():
        raise ValueError(f"states are {states.shape}; expected (..., T + 1, 10) with T of at least 1, all finite")
    position, speed = states[..., 6:8], np.linalg.norm(states[..., 8:10], axis=-1)
    apart = _gap_during_steps(states, env) > NEAR
    untouched = np.zeros_like(apart)
    for since in range(apart.shape[-1]):  # every state that the object may have been left alone since
        alone = np.logical_and.accumulate(apart[..., since:], axis=-1)
        seconds = DT * np.arange(1, alone.shape[-1] + 1)
        slides = speed[..., since, None] * BLOCK_DECAY * (1 - np.exp(-seconds / BLOCK_DECAY))
        moved = np.linalg.norm(position[..., since + 1 :, :] - position[..., since, None, :], axis=-1)
        untouched[..., since:] |= alone & (moved > slides + NEAR)
    penetrates = closest_gap(states[..., 1:, :], env) < -NEAR
    return {"moves_untouched": untouched, "penetrates": penetrates, "broken": untouched | penetrates}


def shares(start: np.ndarray, states: np.ndarray, env: str) -> dict[str, np.ndarray]:
    """Share of predicted steps that break each invariant (claims C30, C31), for each plan: (B,) each.

    start (B, dx); states (S, B, T, dx) that a model predicted for the plans.
    """
    first = np.broadcast_to(np.asarray(start)[:, None], (*states.shape[:2], 1, states.shape[-1]))
    found = broken(np.concatenate([first, states], axis=-2), env)
    return {name: steps.mean((0, 2)) for name, steps in found.items()}


def worst(error: np.ndarray) -> np.ndarray:
    """The tenth of plans, at least one, with the largest error (B,): predicted minus true return (claim C34)."""
    return np.argsort(-np.asarray(error), kind="stable")[: -(-len(error) // 10)]


def _gap_during_steps(states: np.ndarray, env: str) -> np.ndarray:
    """The object's smallest gap to arm or walls within each step (..., T).

    The arm moves evenly from state to state; the object does too, or stays until it is hit.
    """
    before, change = states[..., :-1, None, :], np.diff(states, axis=-2)[..., None, :]
    between = before + np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS * change  # (..., T, SUBSTEPS, dx)
    waiting = between.copy()
    waiting[..., 6:8] = before[..., 6:8]
    to_walls = WALL - BLOCK_RADIUS - np.abs(between[..., 6:8]).max(axis=-1)
    return np.minimum.reduce([closest_gap(between, env), closest_gap(waiting, env), to_walls]).min(axis=-1)


# Actions -------------------------------------------------------------------------------------------------------------


def roughness(actions: Tensor, dt: float = DT) -> dict[str, Tensor]:
    """How abrupt torques (B, T, du) are (claims C12, C51, C52), one number per plan: (B,) each.

    ``change``: mean |u_{t+1} - u_t|. ``centroid``: mean frequency in Hz, weighted by power. ``fast``: share of power
    above 5 Hz. ``autocorrelation``: of successive torques. Without any torque all are zero.
    """
    tiny = 1e-12
    power = torch.fft.rfft(actions.double(), dim=1).abs().square().sum(-1)  # (B, F)
    frequency = torch.fft.rfftfreq(actions.shape[1], dt).double()
    total = power.sum(1) + tiny
    successive = (actions[:, 1:] * actions[:, :-1]).sum((1, 2))
    return {
        "change": actions.diff(dim=1).abs().mean((1, 2)),
        "centroid": ((power @ frequency) / total).float(),
        "fast": (power[:, frequency > 5].sum(1) / total).float(),
        "autocorrelation": successive / (actions.square().sum((1, 2)) + tiny),
    }


def novelty(actions: Tensor, data: Tensor, *, segment_len: int = 10) -> Tensor:
    """Distance (B,) of plans (B, T, du) from the training torques (N, T', du): how far off the data a plan ventures.

    The root mean square difference between each segment of a plan and the nearest of all segments of the data, in
    standard deviations of the data's torques, averaged over the plan. Held-out torques give the value to compare with.
    """
    if min(actions.shape[1], data.shape[1]) < segment_len:
        raise ValueError(
            f"plans of {actions.shape[1]} and data of {data.shape[1]} steps hold no segment of {segment_len} steps"
        )
    std = data.flatten(0, 1).std(0)
    segments = (actions / std).unfold(1, segment_len, segment_len).flatten(2)  # (B, K, du H)
    nearest = segments.new_full(segments.shape[:2], torch.inf).flatten()
    for episodes in (data / std).split(200):
        known = episodes.unfold(1, segment_len, 1).flatten(0, 1).flatten(1)
        nearest = torch.minimum(nearest, torch.cdist(segments.flatten(0, 1), known).amin(1))
    return nearest.reshape(segments.shape[:2]).mean(1) / segments.shape[2] ** 0.5


def within(actions: Tensor, data: Tensor, *, share: float = 0.95) -> Tensor:
    """Share of the steps of plans (B, T, du) whose torques are no larger than the training data's: (B,) (claim C16).

    No larger means inside the box around zero that holds ``share`` of all steps of the data (N, T', du); its sides are
    as the standard deviations of the data's torques.
    """
    std = data.flatten(0, 1).std(0)
    size, known = ((torques / std).abs().amax(-1) for torques in (actions, data))
    return (size <= known.flatten().quantile(share)).float().mean(1)
