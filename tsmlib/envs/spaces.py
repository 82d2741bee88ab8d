"""The border to environments that are not ours: what they hand out, take, and say of themselves.

An observation is copied and cast to float64 when it arrives, once; data sets hold float32
(`collect`). Observations that are Boxes, or Dicts and Tuples of them, are flattened into states
(dx,). Actions are (du,) in [-1, 1] here and scaled to the bounds of the action space when they
leave.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Space, Tuple

from tsmlib.envs.ids import UnsupportedEnvironment, layers
from tsmlib.robot import TrajectoryError, columns_of

SUPPORTED = (
    "supported are observations that are a Box of numbers, or a Dict or Tuple of these, and "
    "actions that are one Box with finite bounds"
)
FARTHEST = 1e9  # a bound of an action space beyond it says nothing

# Observations -------------------------------------------------------------------------------------


def state_names(env_id: str, space: Space) -> tuple[str, ...]:
    """One name per number of an observation: ``x0``, of a Dict ``position[0]``, ``arm.angle[1]``.

    UnsupportedEnvironment where the space holds anything but Boxes of numbers.
    """
    names = tuple(_names(env_id, space, ""))
    if not names:
        raise UnsupportedEnvironment(f"observations of {env_id} are empty, {space}; {SUPPORTED}")
    return names


def _names(env_id: str, space: Space, name: str) -> Iterator[str]:
    if isinstance(space, Dict):
        for key, part in space.spaces.items():
            yield from _names(env_id, part, f"{name}.{key}" if name else str(key))
    elif isinstance(space, Tuple):
        for i, part in enumerate(space.spaces):
            yield from _names(env_id, part, f"{name}[{i}]" if name else f"item{i}")
    elif not isinstance(space, Box) or (space.dtype == np.uint8 and len(space.shape) > 1):
        kind = "images" if isinstance(space, Box) else f"a {type(space).__name__}"
        raise UnsupportedEnvironment(
            f"observations of {env_id} are {kind}, {space!s:.100}{name and f', in {name!r}'}; "
            f"{SUPPORTED}. Wrap it "
            "in gymnasium.wrappers.TransformObservation, or FilterObservation, that gives its "
            "features"
        )
    elif not name:
        yield from (f"x{i}" for i in range(int(np.prod(space.shape))))
    elif not space.shape:
        yield name
    else:
        for index in np.ndindex(space.shape):
            yield f"{name}[{','.join(map(str, index))}]"


def flat(env_id: str, space: Space, observation: Any) -> np.ndarray:
    """A copy (dx,) of an observation as float64. UnsupportedEnvironment where it is not of its
    space.
    """
    values = np.concatenate(list(_values(env_id, space, observation, "")))
    return values.astype(np.float64)


def _values(env_id: str, space: Any, value: Any, name: str) -> Iterator[np.ndarray]:
    if isinstance(space, Dict):
        keys = set(value) if isinstance(value, Mapping) else type(value).__name__
        if keys != set(space.spaces):
            raise _changed(env_id, name, f"with keys {keys}", f"{set(space.spaces)}")
        for key, part in space.spaces.items():
            yield from _values(env_id, part, value[key], f"{name}.{key}" if name else str(key))
    elif isinstance(space, Tuple):
        if not isinstance(value, tuple | list) or len(value) != len(space.spaces):
            raise _changed(env_id, name, f"{value!r:.60}", f"a tuple of {len(space.spaces)}")
        for i, part in enumerate(space.spaces):
            yield from _values(env_id, part, value[i], f"{name}[{i}]")
    else:
        value = value.detach().cpu().numpy() if hasattr(value, "detach") else value
        masked = np.ma.is_masked(value)
        array = np.ma.filled(value.astype(np.float64), np.nan) if masked else np.asarray(value)
        if array.shape != space.shape:
            raise _changed(env_id, name, f"of shape {array.shape}", str(space.shape))
        if array.dtype.kind not in "fiub":
            raise _changed(env_id, name, f"of type {array.dtype}", "numbers")
        yield array.reshape(-1)


def _changed(env_id: str, name: str, found: str, expected: str) -> UnsupportedEnvironment:
    return UnsupportedEnvironment(
        f"{env_id} gave an observation{name and f' {name!r}'} {found}, but says that they are "
        f"{expected}: correct its "
        "observation_space, or what its reset and step return"
    )


# Actions ------------------------------------------------------------------------------------------


def require_actions(env_id: str, space: Space) -> Box:
    """The action space where it is a Box with bounds; UnsupportedEnvironment that says what to do
    otherwise.
    """
    if not isinstance(space, Box) or space.dtype is None or space.dtype.kind != "f":
        kind = f"of type {space.dtype}" if isinstance(space, Box) else f"a {type(space).__name__}"
        kind = "discrete" if "Discrete" in kind or "Binary" in kind else kind
        raise UnsupportedEnvironment(f"actions of {env_id} are {kind}, {space!s:.100}; {SUPPORTED}")
    bounds = np.abs([space.low, space.high]).astype(np.float64)
    if not bounds.size or not (bounds <= FARTHEST).all():
        raise UnsupportedEnvironment(
            f"actions of {env_id} have no bounds, {space!s:.100}; {SUPPORTED}. Give it those that "
            "you mean: "
            "gymnasium.wrappers.TransformAction(env, lambda u: u, gymnasium.spaces.Box(low, high))"
        )
    return space


def within_bounds(actions: np.ndarray, space: Box) -> np.ndarray:
    """Actions (..., du) in [-1, 1], scaled to the bounds of ``space``: (..., *space.shape) in its
    type.
    """
    low, high = (side.astype(np.float64).reshape(-1) for side in (space.low, space.high))
    scaled = (low + high) / 2 + (high - low) / 2 * np.clip(np.asarray(actions, np.float64), -1, 1)
    scaled = scaled.astype(space.dtype).reshape((*scaled.shape[:-1], *space.shape))
    return np.clip(scaled, space.low, space.high)


def idle_action(space: Box) -> np.ndarray:
    """The action (du,) in [-1, 1] that is zero in the environment's own units, or its bound nearest
    to zero.
    """
    low, high = (side.astype(np.float64).reshape(-1) for side in (space.low, space.high))
    half = (high - low) / 2
    idle = np.divide(-(low + high) / 2, half, out=np.zeros_like(half), where=half > 0)
    return (np.clip(idle, -1, 1) + 0.0).astype(np.float32)  # and not -0


# What an environment says of itself ---------------------------------------------------------------


@dataclass(frozen=True)
class Description:
    """A robot: its id with arguments, seconds per step, and one name and unit per dimension of its
    state.

    angles: dimensions that are angles in radians. observations, actions: its spaces. idle (du,): no
    action.
    """

    id: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    observations: Space
    actions: Box
    idle: np.ndarray


def said(env: Any, name: str) -> Any:
    """An attribute of an environment, that of its outermost layer that has one; None without."""
    for layer in layers(env):
        try:
            return getattr(layer, name)
        except AttributeError:
            continue
        except Exception as error:  # of a property, which may fail in any way
            raise UnsupportedEnvironment(
                f"{name} of {type(layer).__name__} raises {error!r:.100}; expected a value, or no "
                f"attribute of this name"
            ) from error
    return None


def describe(env_id: str, env: Any, observations: Space, actions: Space) -> Description:
    """The robot of ``env``, an environment with its wrappers.

    names, units, angles and dt are taken from attributes of these names, the outermost layer first,
    where they are what they are called: texts, one per dimension; whole numbers below dx; seconds.
    """
    names = state_names(env_id, observations)
    box = require_actions(env_id, actions)

    def words(name: str) -> tuple[str, ...] | None:
        value = said(env, name)
        texts = isinstance(value, tuple | list) and all(isinstance(word, str) for word in value)
        if texts and len(value) == len(names):
            return tuple(value)
        _not_taken(env_id, name, value, f"{len(names)} texts, one for each number of a state")
        return None

    known, angles = words("names") or names, said(env, "angles")
    try:
        columns = columns_of(angles if isinstance(angles, tuple | list) else (), known)
    except TrajectoryError:
        columns = ()
    if not columns:
        _not_taken(env_id, "angles", angles, f"some of 0 to {len(names) - 1}, or names of states")
    return Description(
        env_id,
        _dt(env_id, said(env, "dt"), (getattr(env, "metadata", None) or {}).get("render_fps")),
        known,
        words("units") or ("",) * len(names),
        columns,
        observations,
        box,
        idle_action(box),
    )


def _not_taken(env_id: str, name: str, value: Any, expected: str) -> None:
    if isinstance(value, tuple | list | np.ndarray) and len(value):
        warnings.warn(
            f"attribute {name} of {env_id} is {value!r:.80} and not taken; expected a list of "
            f"{expected}",
            stacklevel=6,
        )


def _dt(env_id: str, dt: Any, fps: Any) -> float:
    """Seconds per step, as the environment says."""
    for value, inverse in ((dt, False), (fps, True)):
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if number and 0 < value < np.inf:
            return float(1 / value if inverse else value)
    warnings.warn(
        f"{env_id} does not say how long a step is; one step counts as one second. Give it an "
        "attribute dt",
        stacklevel=5,
    )
    return 1.0
