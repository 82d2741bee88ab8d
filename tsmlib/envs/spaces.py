"""The border to environments that are not ours: what they are called, hand out, take, and say of
themselves.

An observation is copied and cast to float64 when it arrives, once; data sets hold float32
(`collect`). Observations that are Boxes, or Dicts and Tuples of them, are flattened into states
(dx,). Actions are (du,) in [-1, 1] here and scaled to the bounds of the action space when they
leave.
"""

from __future__ import annotations

import ast
import importlib
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec
from gymnasium.spaces import Box, Dict, Space, Tuple

from tsmlib.envs.pusht_field import pusht_physics
from tsmlib.envs.spec import CONTROL_IDS, EnvSpec, is_arm

SUPPORTED = (
    "supported are observations that are a Box of numbers, or a Dict or Tuple of these, and "
    "actions that are one Box with finite bounds"
)
FARTHEST = 1e9  # a bound of an action space beyond it says nothing
LONGEST = 300  # characters of arguments that an id can carry


class UnsupportedEnvironment(ValueError):
    """An environment that cannot do what was asked of it; the message says what it would take."""


# Names --------------------------------------------------------------------------------------------


def find_spec(env_id: str) -> GymnasiumSpec:
    """Gymnasium's record of an id, which may carry arguments.

    Args:
        env_id: for example ``"Pendulum-v1"``, ``"Pendulum-v1(g=1.0)"`` or ``"module:Name-v0"``.

    Raises:
        UnsupportedEnvironment: the id says that no id can say how its environment is made.
        gymnasium.error.Error: Gymnasium does not know it.
    """
    name, bracket, given = (*re.split(r"([(+])", env_id, maxsplit=1), "", "")[:3]
    module, colon, plain = name.partition(":")
    if colon:
        importlib.import_module(module)
        name = plain
    if name.startswith("tsm/PushT-") and not bracket:
        pusht_physics(name)  # registers a variant
    elif name.startswith("tsm/dmc-") and name not in CONTROL_IDS:
        raise gymnasium.error.NameNotFound(f"{name!r:.80} is none of {', '.join(CONTROL_IDS)}")
    elif is_arm(name) and not bracket:
        EnvSpec.parse(name)
    spec = gymnasium.spec(name)
    if not bracket:
        return spec
    try:
        call = ast.parse(f"f({given}", mode="eval").body
        assert isinstance(call, ast.Call)
        assert not call.args
        arguments = {str(word.arg): ast.literal_eval(word.value) for word in call.keywords}
    except (SyntaxError, ValueError, AssertionError) as error:
        raise UnsupportedEnvironment(
            f"{env_id!r} cannot be made from its id. An id carries numbers, texts, lists and the "
            "like by name, as 'Pendulum-v1(g=1.0)' does, and no wrappers, and data of copies made "
            "differently belong to none. Give the robot an id of its own: gymnasium.register("
            "'Mine-v0', entry_point, kwargs={...}, "
            "additional_wrappers=(Wrapper.wrapper_spec(...),))"
        ) from error
    return replace(spec, kwargs={**spec.kwargs, **arguments})


def environment_id(env: gymnasium.Env) -> str:
    """The id of an environment with the arguments and wrappers in which it differs from the
    registered one.

    UnsupportedEnvironment where an id cannot carry an argument.
    """
    spec = env.unwrapped.spec
    registered = gymnasium.registry.get(spec.id) if spec else None
    name = type(env.unwrapped).__name__
    known: list[str] = []
    if spec is not None and spec.namespace == "tsm":
        name = spec.id  # which says all of a variant
    elif spec is not None:
        usual = dict(registered.kwargs) if registered else {}
        known = [wrapper.name for wrapper in registered.additional_wrappers] if registered else []
        name = spec.id + _arguments(spec.id, spec.kwargs, usual)
    *wrappers, _ = layers(env)
    made = [i for i, layer in enumerate(wrappers) if type(layer).__name__ in _OF_MAKE]
    if spec is not None and made:  # those further inside are the entry point's own
        wrappers = wrappers[: made[-1]]
    for layer in wrappers:
        word = type(layer).__name__
        if word in known:
            known.remove(word)
        elif word not in HARMLESS:
            name += (
                f"+{word}{_arguments(name, getattr(layer, '_saved_kwargs', {}), {}, strict=False)}"
            )
    return name


def canonical(env_id: str) -> str:
    """An id as data carry it: its arguments sorted, without those that are registered with it."""
    spec = find_spec(env_id)
    return spec.id + _arguments(spec.id, spec.kwargs, gymnasium.registry[spec.id].kwargs)


def stated_id(record: Mapping[str, Any]) -> str:
    """The id in a record of how Gymnasium made an environment, as JSON, which is not made."""
    env_id = str(record["id"])
    registered = gymnasium.registry.get(env_id)
    known = [wrapper.name for wrapper in registered.additional_wrappers] if registered else []
    usual = registered.kwargs if registered else {}
    name = env_id + _arguments(env_id, record.get("kwargs") or {}, usual, strict=False)
    words = [wrapper["name"] for wrapper in record.get("additional_wrappers") or ()]
    return name + "".join(f"+{word}" for word in words if word not in {*known, *HARMLESS})


_OF_MAKE = ("OrderEnforcing", "PassiveEnvChecker", "TimeLimit")
HARMLESS = {  # wrappers that change neither observations nor what an action does
    *_OF_MAKE,
    "RecordEpisodeStatistics",
    "RecordVideo",
    "HumanRendering",
    "RenderCollection",
    "ClipReward",
    "NormalizeReward",
    "TransformReward",
    "DictInfoToList",
}


def _arguments(
    env_id: str, given: Mapping[str, Any], usual: Mapping[str, Any], *, strict: bool = True
) -> str:
    """Those of the arguments ``given`` that are not ``usual``, as an id carries them."""
    words = []
    for name, value in sorted(given.items()):
        if name in ("render_mode", "num_envs", "vectorization_mode", "vector_kwargs", "wrappers"):
            continue
        if name in usual and _equal(value, usual[name]):
            continue
        word = _literal(value)
        if word is None and strict:
            raise UnsupportedEnvironment(
                f"argument {name} of {env_id} is {value!r:.80}, which no id can carry, so its data "
                "could not be "
                "told from another robot's; register it by itself: gymnasium.register('Mine-v0', "
                "entry_point, "
                f"kwargs={{{name!r}: ...}})"
            )
        words.append(f"{name}={word or type(value).__name__}")
    text = ", ".join(words)
    if len(text) > LONGEST and strict:
        raise UnsupportedEnvironment(
            f"the arguments of {env_id} are longer than an id can carry, {text:.80}...; register "
            "it by itself: "
            "gymnasium.register('Mine-v0', entry_point, kwargs={...})"
        )
    return f"({text})" if text else ""


def _literal(value: Any) -> str | None:
    value = value.item() if isinstance(value, np.generic) else value
    try:
        return repr(value) if ast.literal_eval(repr(value)) == value else None
    except (SyntaxError, ValueError):
        return None


def _equal(one: Any, other: Any) -> bool:
    """Whether two arguments are the same; Gymnasium hands out deep copies of them."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    own, others = getattr(one, "__dict__", None), getattr(other, "__dict__", None)
    return bool(one == other) or (own is not None and repr(own) == repr(others))


def layers(env: Any) -> Iterator[Any]:
    """An environment's wrappers, the outermost first, and itself."""
    while isinstance(env, gymnasium.Wrapper | gymnasium.vector.VectorWrapper):
        yield env
        env = env.env
    yield env


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
        array = np.asarray(value)
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
    return next((getattr(layer, name) for layer in layers(env) if hasattr(layer, name)), None)


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
        return tuple(value) if texts and len(value) == len(names) else None

    angles = said(env, "angles")
    whole = isinstance(angles, tuple | list) and all(type(d) is int for d in angles)
    if not whole or not all(0 <= d < len(names) for d in angles) or len(set(angles)) < len(angles):
        angles = ()
    return Description(
        env_id,
        _dt(env_id, said(env, "dt"), (getattr(env, "metadata", None) or {}).get("render_fps")),
        words("names") or names,
        words("units") or ("",) * len(names),
        tuple(angles),
        observations,
        box,
        idle_action(box),
    )


def _dt(env_id: str, dt: Any, fps: Any) -> float:
    """Seconds per step, as the environment says."""
    for seconds in (dt, fps and 1.0 / fps):
        number = isinstance(seconds, int | float | np.number) and not isinstance(seconds, bool)
        if number and 0 < seconds < np.inf:
            return float(seconds)
    warnings.warn(
        f"{env_id} does not say how long a step is; one step counts as one second. Give it an "
        "attribute dt",
        stacklevel=5,
    )
    return 1.0
