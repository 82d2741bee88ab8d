"""The variables of an environment, saved and brought back; and what it can do, found by trying.

An environment's state is taken to be the plain values among its attributes and its wrappers' (numbers, arrays, lists,
random generators), and of one of MuJoCo's the state of the physics with all that the integrator starts from. Whether
that is all is not known but tried, once for every id (`abilities`).
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from tsmlib.envs.mujoco_bulk import Bulk, Mismatch, arrays, is_mujoco

_FIXED = (bool, int, float, complex, str, bytes, type(None), np.generic)  # need no copy
_PLAIN = (*_FIXED, np.ndarray, np.random.Generator, tuple, list, dict, set, deque)
_STEPS = 25  # of a trial of the bulk path: to the ground, for most robots


class Snapshot(NamedTuple):
    """Plain attributes, layer by layer of wrappers; MuJoCo's state, where there is one, and what it had made of it."""

    layers: tuple[dict[str, Any], ...]
    physics: np.ndarray | None
    derived: dict[str, np.ndarray]


class _Drawn(NamedTuple):
    """A random generator as it was, which is a tenth of the work of a copy."""

    kind: type[np.random.BitGenerator]
    state: Mapping[str, Any]

    def again(self) -> np.random.Generator:
        generator = np.random.Generator(self.kind())
        generator.bit_generator.state = self.state
        return generator


class Step(NamedTuple):
    """What one step gave."""

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool


def save(env: gymnasium.Env, *, derived: bool = True) -> Snapshot:
    """Everything plain that ``env`` and its wrappers hold. derived: also what MuJoCo has made of its state."""
    layers = tuple(
        {name: _copied(value) for name, value in vars(layer).items() if isinstance(value, _PLAIN)}
        for layer in _layers(env)
    )
    if not is_mujoco(env):
        return Snapshot(layers, None, {})
    simulated: Any = env.unwrapped
    kept = {name: array.copy() for name, array in arrays(simulated.data).items()} if derived else {}
    return Snapshot(layers, _integration_state(simulated), kept)


def restore(env: gymnasium.Env, snapshot: Snapshot) -> None:
    """``env`` as it was when ``snapshot`` was taken; bit for bit where its `abilities` say so."""
    for layer, values in zip(_layers(env), snapshot.layers, strict=True):
        for name, value in values.items():
            own = vars(layer).get(name)
            if not isinstance(value, _Drawn):
                vars(layer)[name] = _copied(value)
            elif isinstance(own, np.random.Generator) and type(own.bit_generator) is value.kind:
                own.bit_generator.state = value.state
            else:
                vars(layer)[name] = value.again()
    if snapshot.physics is not None:
        import mujoco

        simulated: Any = env.unwrapped
        mujoco.mj_setState(
            simulated.model, simulated.data, snapshot.physics, mujoco.mjtState.mjSTATE_INTEGRATION
        )
        for name, value in snapshot.derived.items():
            present = getattr(simulated.data, name)
            if present.shape == value.shape:  # others are as long as there are contacts
                present[...] = value


@dataclass(frozen=True)
class Abilities:
    """What an environment can do, as far as a trial of a few steps says.

    repeats: the same seed and actions give the same episode, bit for bit. restores: it goes on from a snapshot as it
    went on before; derived: from one that holds what MuJoCo has made of its state. bulk: how MuJoCo's bulk simulation
    takes the place of its own; None: it does not, and ``why``.
    """

    repeats: bool
    restores: bool
    derived: bool
    bulk: Bulk | None
    why: str = ""


_known: dict[str, Abilities] = {}


def abilities(env: gymnasium.Env) -> Abilities:
    """What environments of this id and these arguments can do, tried on ``env`` the first time, which is reset."""
    spec = env.spec
    if spec is None:  # nothing says which arguments it was made with
        return _tried(env)
    key = repr(
        (spec.id, spec.kwargs, spec.additional_wrappers, [type(layer) for layer in _layers(env)])
    )
    if key not in _known:
        _known[key] = _tried(env)
    return _known[key]


def _tried(env: gymnasium.Env) -> Abilities:
    rng = np.random.default_rng(0)
    space: Any = env.action_space
    actions = rng.uniform(space.low, space.high, (_STEPS, *space.shape)).astype(space.dtype)
    repeats = same(_played(env, 3, actions[:8]), _played(env, 3, actions[:8]))
    ways = [derived for derived in (False, True) if repeats and _restores(env, actions, derived)]
    bulk, why = _bulk(env, actions) if ways else (None, "its state cannot be set")
    return Abilities(repeats, bool(ways), not ways or ways[0], bulk, why)


def play(env: gymnasium.Env, actions: np.ndarray) -> list[Step]:
    """The steps of ``actions`` (T, du), up to and with the one that ends the episode."""
    steps = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        steps.append(Step(observation, float(reward), bool(terminated), bool(truncated)))
        if terminated or truncated:
            break
    return steps


def same(one: list[Step], other: list[Step], tolerance: float = 0.0) -> bool:
    """Whether two episodes agree in everything, up to ``tolerance`` (absolute and relative)."""
    return len(one) == len(other) and all(
        a[2:] == b[2:]
        and np.allclose(a.observation, b.observation, rtol=tolerance, atol=tolerance)
        and np.isclose(a.reward, b.reward, rtol=tolerance, atol=tolerance)
        for a, b in zip(one, other, strict=True)
    )


def _played(env: gymnasium.Env, seed: int, actions: np.ndarray) -> list[Step]:
    env.reset(seed=seed)
    return play(env, actions)


def _restores(env: gymnasium.Env, actions: np.ndarray, derived: bool) -> bool:
    """Whether a snapshot brings back what other steps and another reset have changed."""
    try:
        _played(env, 3, actions[:2])
        taken = save(env, derived=derived)
        before = play(env, actions[2:8])
        _played(env, 4, actions[8:12])
        restore(env, taken)
        return same(before, play(env, actions[2:8]))
    except Exception:  # an environment that is not made to be copied may fail in any way
        return False


def _bulk(env: gymnasium.Env, actions: np.ndarray) -> tuple[Bulk | None, str]:
    """The first way of bulk simulation that gives what stepping gives, or why there is none."""
    if not is_mujoco(env):
        return None, "it is not one of MuJoCo's"
    if why := Bulk.refused(env):
        return None, why
    stepped = [_played(env, seed, actions) for seed in (3, 4)]
    for last_substep in (False, True):
        bulk = Bulk(env.unwrapped, last_substep=last_substep)
        # A way that leaves out what follows from the state is right where that can be anything.
        for fill in (None,) if last_substep else (1e9, -1e9):
            try:
                found = [_in_bulk(env, bulk, seed, actions, fill) for seed in (3, 4)]
            except Mismatch as mismatch:
                return None, str(mismatch)
            if not all(same(*pair, tolerance=1e-9) for pair in zip(stepped, found, strict=True)):
                break
        else:
            env.reset(seed=3)
            seen = bulk.observed(env, bulk.physics(bulk.start(env)[None], actions[None])[0])
            bulk.only_observes &= np.array_equal(
                seen[: len(stepped[0])], [step.observation for step in stepped[0]]
            )
            return bulk, ""
    return None, "its observations, rewards or ends differ from those of stepping"


def _in_bulk(
    env: gymnasium.Env, bulk: Bulk, seed: int, actions: np.ndarray, fill: float | None = None
) -> list[Step]:
    env.reset(seed=seed)
    physics = bulk.physics(bulk.start(env)[None], actions[None])
    with bulk.playing(env, physics[0], actions, fill=fill):
        return play(env, actions)


def _layers(env: gymnasium.Env) -> Iterator[Any]:
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = env.env
    yield env


def _copied(value: object) -> object:
    """A deep copy; of what most environments hold, faster than ``copy.deepcopy``."""
    if isinstance(value, _FIXED):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value.copy()
    if isinstance(value, np.random.Generator):
        return _Drawn(type(value.bit_generator), value.bit_generator.state)
    if type(value) is dict and all(
        isinstance(part, (*_FIXED, np.ndarray)) for part in value.values()
    ):
        return {name: _copied(part) for name, part in value.items()}
    if type(value) in (list, tuple) and all(isinstance(part, _FIXED) for part in value):  # type: ignore[attr-defined]
        return value[:]  # type: ignore[index]
    return copy.deepcopy(value)


def _integration_state(env: Any) -> np.ndarray:
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, state, kind)
    return state
