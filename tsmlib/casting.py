"""Whatever holds numbers, as arrays of episodes in float32: cast and checked once."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import described
from tsmlib.robot import Robot, TrajectoryError

Arrays = np.ndarray | Tensor | Sequence[np.ndarray] | Sequence[Tensor]


def episodes(name: str, values: Arrays) -> list[np.ndarray]:
    """Each episode as an array (T, d) of numbers, d the same in all."""
    if isinstance(values, Tensor):
        values = _array(values)
    one = isinstance(values, str | Mapping) or getattr(values, "ndim", 1) == 0
    if one or not isinstance(values, Iterable):
        raise TrajectoryError(
            f"{name} is {described(values)}; expected an array (N, T, d), or a list of (T, d)"
        )
    parts = [numbers(f"{name} of episode {i}", part) for i, part in enumerate(values)]
    if not parts:
        raise TrajectoryError(f"there are no {name}; expected at least one episode")
    for i, part in enumerate(parts):
        if part.ndim != 2 or part.shape[1] != parts[0].shape[-1] or not part.shape[1]:
            raise TrajectoryError(
                f"{name} of episode {i} have shape {part.shape}, those of episode 0 "
                f"{parts[0].shape}; expected (N, T, d), or a list of (T, d) with the same d. "
                f"A single episode goes in a list: [{name}]"
            )
    return parts


def pairs(
    states: Arrays, actions: Arrays, lengths: Sequence[int] | None
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """States (T + 1, dx) and actions (T, du) of each episode, cut to ``lengths``."""
    x, u = episodes("states", states), episodes("actions", actions)
    if len(x) != len(u):
        raise TrajectoryError(f"{len(x)} episodes of states, but {len(u)} of actions")
    if lengths is not None:
        ends = one_each("lengths", lengths, len(u), np.integer)
        if any(not 1 <= n <= len(part) for n, part in zip(ends, u, strict=True)):
            raise TrajectoryError(
                f"lengths is {lengths!r:.80}; expected at least 1, and no more than the "
                f"{max(map(len, u))} steps of the arrays"
            )
        x = [part[: n + 1] for n, part in zip(ends, x, strict=True)]
        u = [part[:n] for n, part in zip(ends, u, strict=True)]
    for i, (a, b) in enumerate(zip(x, u, strict=True)):
        if len(a) != len(b) + 1 or not len(b):
            raise TrajectoryError(
                f"states {a.shape} and actions {b.shape} of episode {i} do not fit: expected "
                "(T + 1, dx) and (T, du), one state more than actions and at least one action"
            )
    return x, u


def _array(tensor: Tensor) -> np.ndarray:
    whole = tensor.detach().cpu().to_dense()
    return (whole.float() if whole.dtype == torch.bfloat16 else whole).numpy()


def numbers(what: str, values: object) -> np.ndarray:
    """An array of real numbers of any type; TrajectoryError for anything else."""
    if isinstance(values, Tensor):
        values = _array(values)
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TrajectoryError(f"{what} are uneven: {error}") from error
    if array.dtype.kind not in "fiub":
        raise TrajectoryError(f"{what} are of type {array.dtype}; expected real numbers")
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    return array


def one_each(field: str, values: Sequence[object], n: int, kind: type) -> list:
    """As many values of a kind as there are episodes."""
    array = np.asarray(values)
    if array.shape != (n,) or not np.issubdtype(array.dtype, kind):
        raise TrajectoryError(
            f"{field} is {values!r:.80}; expected {n} values of type {kind.__name__}, one each"
        )
    return array.tolist()


def unwrapped(states: np.ndarray, angles: tuple[int, ...]) -> np.ndarray:
    """States (T, dx) whose angles do not jump."""
    states = states.astype(np.float64)
    for d in angles:
        states[:, d] = unwrapped_angle(f"state {d}", states[:, d])
    return states


def unwrapped_angle(name: str, values: np.ndarray) -> np.ndarray:
    """An angle (T,) that does not jump; TrajectoryError where it jumps by more than a turn."""
    jumps = np.abs(np.diff(values))
    if (jumps > 3 * math.pi).any():
        raise TrajectoryError(
            f"the angle '{name}' jumps by {jumps.max():g}; expected radians, which jump by a turn "
            "of 2 pi where they are wrapped: convert degrees by np.radians(...)"
        )
    return np.unwrap(values)


def float32(name: str, episodes: list[np.ndarray], columns: tuple[str, ...]) -> np.ndarray:
    """All rows in float32, finite, and apart from each other where they are in ``episodes``."""
    exact = np.concatenate(episodes)
    with np.errstate(over="ignore"):
        flat = np.array(exact, np.float32, order="C")
    lengths = np.array([len(part) for part in episodes])
    begins = np.cumsum(lengths) - lengths
    bad = np.argwhere(~np.isfinite(flat))
    if len(bad):
        row, column = bad[0]
        episode = int(np.searchsorted(begins, row, side="right")) - 1
        raise TrajectoryError(
            f"{len(bad)} value(s) in {name} are not finite, the first in episode {episode}, "
            f"step {row - begins[episode]}, field '{columns[column]}': {exact[row, column]}. "
            "Expected finite numbers: mend or leave out what holds them"
        )
    whole = exact.dtype.kind in "iu"  # of floats, what varies by their own rounding is constant
    if exact.dtype.itemsize > 4 or (whole and exact.dtype.itemsize == 4):
        change = exact.astype(np.longdouble) - np.repeat(exact[begins], lengths, axis=0)
        spread = np.sqrt(np.square(change).mean(0).astype(np.float64))
        size = np.abs(exact.astype(np.float64)).max(0)
        rounding = np.sqrt(np.square(exact.astype(np.longdouble) - flat).mean(0)).astype(np.float64)
        lost = (rounding > 1e-3 * spread) & (spread > (0 if whole else 1e-12) * size)
        for column in np.flatnonzero(lost)[:1]:
            kept = np.spacing(np.float32(size[column]))
            raise TrajectoryError(
                f"'{columns[column]}' goes up to {size[column]:g}, and within an episode it varies "
                f"by {spread[column]:g}: float32 keeps steps of {kept:g} there. "
                f"Take an offset off it: {name} - {name}.mean()"
            )
    return flat


def require_bounds(actions: np.ndarray, env: str) -> None:
    """TrajectoryError where actions leave [-1, 1]."""
    most = np.abs(actions).max()
    if most > 1 + 1e-6:
        raise TrajectoryError(
            f"actions of {env} go up to {most:g}; expected them within [-1, 1]. Scale them by "
            "their bounds: 2 * (u - low) / (high - low) - 1, or bounds=(low, high) of from_table"
        )


def doubt_degrees(states: np.ndarray, robot: Robot) -> None:
    """Say aloud that an angle without a unit goes through more turns than a joint has."""
    for d in robot.angles:
        if not robot.units[d] and (most := np.abs(states[:, d]).max()) > 8 * math.pi:
            warnings.warn(
                f"the angle '{robot.names[d]}' goes up to {most:g}, which is {most / 6.2832:.0f} "
                "turns in radians; convert degrees by np.radians(...), or give its unit, 'rad'",
                stacklevel=4,
            )


def require_no_jumps(increments: np.ndarray, steps: np.ndarray, robot: Robot) -> None:
    """TrajectoryError where an angle changes by more than pi in a step."""
    jumps = np.abs(increments[:, list(robot.angles)]) > math.pi
    for row, column in np.argwhere(jumps)[:1]:
        ends = np.cumsum(steps)
        episode = int(np.searchsorted(ends, row, side="right"))
        raise TrajectoryError(
            f"the angle '{robot.names[robot.angles[column]]}' jumps by more than pi at "
            f"{jumps.sum()} step(s), the first in episode {episode} after step "
            f"{row - ends[episode] + steps[episode]}; expected an angle that goes on. unwrap=True "
            "takes the jumps out of one that was wrapped; jumps=True takes them as they are"
        )
