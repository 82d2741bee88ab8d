"""What would follow in a foreign environment: snapshots of its state, where these are the whole of
it.

They are where every attribute is a plain value (numbers, texts, arrays, random generators, and
lists of these) or MuJoCo's own data, or where the environment offers two methods of its own:

    save_state() -> object           everything that the future depends on
    restore_state(object) -> None    the environment as it was then

Elsewhere the refusal names the attribute. What is played from a snapshot is held against a copy
that was stepped from its seed, and refused where it differs.
"""

from __future__ import annotations

import copy
import enum
import hashlib
import random
from collections import deque
from collections.abc import Sequence
from contextlib import closing
from inspect import signature
from pathlib import PurePath
from types import BuiltinFunctionType, FunctionType
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec

from tsmlib.envs.ids import UnsupportedEnvironment, layers
from tsmlib.envs.stepping import Stepping, canonical, copies

_PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic, enum.Enum, PurePath)
_COPIED = (np.random.Generator, np.random.BitGenerator, np.random.RandomState, random.Random)
_CONSTANT = ("env", "_saved_kwargs", "_ezpickle_args", "_ezpickle_kwargs")
_FIXED = ("MjModel", "MujocoRenderer")  # MuJoCo's; the model is looked at, see ``Oracle``
_MODEL_KEPT = "its steps change its MuJoCo model, which is no part of its state"


def refusal(env: gymnasium.Env) -> str:
    """Why the state of an environment cannot be saved, naming the attribute; '' where it can be."""
    arrays: list[tuple[str, np.ndarray]] = []
    for layer in layers(env):
        name = type(layer).__name__
        if _offers(layer):
            continue
        if any(vars(kind).get("__slots__") for kind in type(layer).__mro__):
            return f"{name} keeps its state in __slots__"
        for attribute, value in vars(layer).items():
            kept = attribute in _CONSTANT or _fixed(value)
            if not kept and (what := _odd(value, arrays, attribute)):
                return f"its state is not all plain: {name}.{attribute} {what}"
    for i, (one, array) in enumerate(arrays):
        for other, another in arrays[:i]:
            if array is not another and np.may_share_memory(array, another):
                return f"its attributes {other} and {one} are views of the same numbers"
    return ""


def _offers(layer: Any) -> bool:
    """Whether a layer has both methods, which take what they should."""
    try:
        signature(layer.save_state).bind()
        signature(layer.restore_state).bind(None)
    except (AttributeError, TypeError, ValueError):
        return False
    return True


def _fixed(value: Any) -> bool:
    """Whether a value never changes, or is MuJoCo's data, which are copied by MuJoCo."""
    if isinstance(value, FunctionType):
        own = value.__closure__ is None and not vars(value)
        return own or value.__module__.startswith("gymnasium.")
    known = isinstance(value, BuiltinFunctionType | gymnasium.Space | GymnasiumSpec | type)
    return known or type(value).__name__ in (*_FIXED, "MjData")


def _odd(value: Any, arrays: list[tuple[str, np.ndarray]], attribute: str) -> str:
    """What keeps a value from being plain, or ''; the arrays in it are added to ``arrays``."""
    if type(value) is np.ndarray and value.dtype != object:
        owner = value
        while isinstance(owner, np.ndarray):
            owner = owner.base  # type: ignore[assignment]
        arrays.append((attribute, value))
        return "" if owner is None else f"is a view of a {type(owner).__name__}"
    if isinstance(value, (*_PLAIN, *_COPIED)):
        return ""
    if type(value) is dict:
        value = [*value, *value.values()]
    if isinstance(value, list | tuple | set | frozenset | deque):
        return next((odd for part in value if (odd := _odd(part, arrays, attribute))), "")
    return f"is or holds a {type(value).__name__}"


class _Data(NamedTuple):
    """MuJoCo's data, and all that they held."""

    live: Any
    copy: Any


def save(env: gymnasium.Env) -> list[Any]:
    """The state of an environment of which ``refusal`` says nothing, layer by layer."""
    state: list[Any] = []
    for layer in layers(env):
        if _offers(layer):
            state.append(layer.save_state())
        else:
            own = vars(layer)
            state.append({name: own[name] for name in own if name not in _CONSTANT})
    return _copied(state)


def restore(env: gymnasium.Env, state: list[Any]) -> None:
    """Bring back what ``save`` gave, which can be brought back again."""
    for layer, values in zip(layers(env), _copied(state), strict=True):
        if _offers(layer):
            layer.restore_state(values)
            continue
        own = vars(layer)
        for name in [name for name in own if name not in _CONSTANT and name not in values]:
            del own[name]
        for name, value in values.items():
            own[name] = value
            if isinstance(value, _Data):
                import mujoco

                own[name] = value.live
                mujoco.mj_copyData(value.live, value.live.model, value.copy)


def _copied(state: list[Any]) -> list[Any]:
    """A copy in which the same object stays the same; what never changes, and copies of data, are
    kept.
    """
    memo: dict[int, Any] = {}
    for values in state:
        for value in values.values() if isinstance(values, dict) else ():
            if type(value).__name__ == "MjData":
                import mujoco

                data = mujoco.MjData(value.model)
                mujoco.mj_copyData(data, value.model, value)
                memo[id(value)] = _Data(value, data)
            elif _fixed(value) or isinstance(value, _Data):
                memo[id(value)] = value
    return copy.deepcopy(state, memo)


class Oracle:
    """Episodes that began by resets and went on by actions, and what would follow in them."""

    def __init__(self, env_id: str, seeds: Sequence[int], actions: np.ndarray) -> None:
        """Begin, each episode in a copy of its own.

        Args:
            env_id: of a foreign environment.
            seeds: (B,), of the resets.
            actions: (B, t, du) in [-1, 1], taken since.

        Raises:
            UnsupportedEnvironment: the environment's state cannot be saved; names the attribute.
        """
        self.id, self.seeds, self.actions, self.checked = canonical(env_id), seeds, actions, False
        self.run = self._begun()
        self.last, self.ended = self.run.last.copy(), self.run.ended.copy()
        for env in self.run.envs:
            if why := refusal(env):
                self.run.close()
                raise _no_oracle(self.id, why)
        self.saved = [save(env) for env in self.run.envs]
        self.models = [_models(env) for env in self.run.envs]

    def outcomes(self, candidates: np.ndarray) -> np.ndarray:
        """What would follow under each candidate; the episodes stay.

        Args:
            candidates: (C, B, T, du) in [-1, 1].

        Returns:
            States (C, B, T, dx); of an episode that ended, the last one repeats.

        Raises:
            UnsupportedEnvironment: the same seed and actions do not repeat an episode.
        """
        states = np.stack([self._played(actions) for actions in candidates])
        if [_models(env) for env in self.run.envs] != self.models:
            raise _no_oracle(self.id, _MODEL_KEPT)
        if not self.checked:
            with closing(self._begun()) as other:
                for again in (other.rollout(candidates[-1]), self._played(candidates[-1])):
                    if (apart := again != states[-1]).any():
                        i, t, d = np.argwhere(apart)[0]
                        raise _no_oracle(
                            self.id,
                            f"the same seed and actions do not repeat it: {self.run.names[d]} of "
                            f"episode {i} after "
                            f"{t + 1} steps is {states[-1, i, t, d]:g} from its snapshot, and "
                            f"{again[i, t, d]:g}",
                        )
            self.checked = bool(candidates[-1].any())  # doing nothing may repeat itself alone
        return states

    def _begun(self) -> Stepping:
        run = Stepping(copies(self.id, len(self.seeds)), env_id=self.id)
        run.reset(seed=self.seeds)
        run.rollout(self.actions)
        return run

    def _played(self, actions: np.ndarray) -> np.ndarray:
        for env, state in zip(self.run.envs, self.saved, strict=True):
            restore(env, state)
        self.run.last, self.run.ended = self.last.copy(), self.ended.copy()
        return self.run.rollout(actions)


def _models(env: gymnasium.Env) -> list[bytes]:
    """Digests of the MuJoCo models among an environment's attributes."""
    found = []
    for layer in layers(env):
        for value in vars(layer).values():
            if type(value).__name__ == "MjModel":
                import mujoco

                held = np.empty(mujoco.mj_sizeModel(value), np.uint8)
                mujoco.mj_saveModel(value, None, held)
                found.append(hashlib.sha256(held.tobytes()).digest())
    return found


def _no_oracle(env_id: str, why: str) -> UnsupportedEnvironment:
    return UnsupportedEnvironment(
        f"{env_id} has no oracle and no replay: {why}. Plan through a model instead, "
        "tsmlib.model_predictor; or give "
        "the environment the methods save_state() and restore_state(state), which hold all that "
        "its future depends on"
    )
