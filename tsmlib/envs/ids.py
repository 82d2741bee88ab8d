"""Ids of environments that are not ours, with the arguments and wrappers that made them."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec

from tsmlib.envs.pusht_field import pusht_physics
from tsmlib.envs.spec import CONTROL_IDS, EnvSpec, is_arm

LONGEST = 300  # characters of arguments that an id can carry


class UnsupportedEnvironment(ValueError):
    """An environment that cannot do what was asked of it; the message says what it would take."""


def find_spec(env_id: str) -> GymnasiumSpec:
    """Gymnasium's record of an id, which may carry arguments.

    Args:
        env_id: for example ``"Pendulum-v1"``, ``"Pendulum-v1(g=1.0)"`` or ``"module:Name-v0"``;
            ``"tsm/dmc/..."`` stands for ``"tsm/dmc-..."``, since Gymnasium allows one slash.

    Raises:
        UnsupportedEnvironment: the id says that no id can say how its environment is made.
        gymnasium.error.Error: Gymnasium does not know it.
    """
    name, bracket, given = (*re.split(r"([(+])", env_id, maxsplit=1), "", "")[:3]
    module, colon, plain = name.partition(":")
    if colon:
        importlib.import_module(module)
        name = plain
    name = re.sub(r"^tsm/dmc/", "tsm/dmc-", name)
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
