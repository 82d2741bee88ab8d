"""Environments as strangers write them: a cart that is pushed, each with one thing that used to go
wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.spaces import Box, Dict, Discrete, Tuple

WIDE = Box(-99, 99, (2,), np.float64)


class Cart(gymnasium.Env):
    """Place and speed; ``seen`` and ``push`` are what its variants change."""

    observation_space: gymnasium.Space = WIDE
    action_space: gymnasium.Space = Box(-1, 1, (1,), np.float32)
    dt: Any = 0.1

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 2)
        self.begin()
        return self.seen(), {}

    def step(self, u: np.ndarray) -> Any:
        self.x = self.x + 0.1 * np.array([self.x[1], self.push(u)])
        return self.seen(), self.reward(), *self.ends(), {}

    def begin(self) -> None:
        """More of a reset."""

    def push(self, u: np.ndarray) -> float:
        return float(np.sum(u))

    def seen(self) -> Any:
        return self.x.copy()

    def reward(self) -> Any:
        return -abs(self.x[0])

    def ends(self) -> tuple[Any, Any]:
        return False, False


class NoRenderMode(Cart):
    def __init__(self, mass: float = 1.0) -> None:
        self.mass = mass

    def push(self, u: np.ndarray) -> float:
        return float(u[0]) / self.mass


class HandsOutItsBuffer(Cart):
    buffer = None

    def seen(self) -> Any:
        self.buffer = np.zeros(2) if self.buffer is None else self.buffer
        self.buffer[:] = self.x
        return self.buffer


class Line:
    """Commands that arrive late."""

    def __init__(self) -> None:
        self.held = [0.0] * 5

    def later(self, u: float) -> float:
        self.held.append(u)
        return self.held.pop(0)


class DelayInAnObject(Cart):
    def begin(self) -> None:
        self.line = Line()

    def push(self, u: np.ndarray) -> float:
        return self.line.later(float(u[0]))


class LateObject(Cart):
    line, taken = None, 0

    def begin(self) -> None:
        self.line, self.taken = None, 0

    def push(self, u: np.ndarray) -> float:
        self.taken += 1
        if self.taken == 3:
            self.line = Line()
        return self.line.later(float(u[0])) if self.line else float(u[0])


class DelayInAClosure(Cart):
    def begin(self) -> None:
        held = [0.0] * 3
        self.later = lambda u: (held.append(u), held.pop(0))[1]

    def push(self, u: np.ndarray) -> float:
        return self.later(float(u[0]))


class DelayInASlot(Cart):
    __slots__ = ("last",)

    def begin(self) -> None:
        self.last = 0.0

    def push(self, u: np.ndarray) -> float:
        before, self.last = self.last, float(u[0])
        return before


class Views(Cart):
    """Two names for the same numbers, changed in place."""

    def begin(self) -> None:
        self.place = self.x[:1]

    def step(self, u: np.ndarray) -> Any:
        self.x[1] += 0.1 * float(u[0])
        self.place += 0.1 * self.x[1]
        return self.seen(), 0.0, False, False, {}


class DictObservation(Cart):
    observation_space = Dict(speed=Box(-9, 9, ()), position=Box(-9, 9, (1,)))

    def seen(self) -> Any:
        return {"position": self.x[:1].astype(np.float32), "speed": np.float32(self.x[1])}


class TupleObservation(Cart):
    observation_space = Tuple(
        (Box(-9, 9, (1,), np.float64), Dict(v=Box(-9, 9, (1, 1), np.float64)))
    )

    def seen(self) -> Any:
        return self.x[:1], {"v": self.x[1:, None]}


class Goal(Cart):
    observation_space = Dict(
        observation=WIDE, achieved_goal=Box(-9, 9, (1,)), desired_goal=Box(-9, 9, (1,))
    )

    def seen(self) -> Any:
        here = self.x[:1].astype(np.float32)
        return {"observation": self.x, "achieved_goal": here, "desired_goal": 0 * here + 0.5}


class MissingKey(DictObservation):
    def seen(self) -> Any:
        return {"position": self.x[:1]}


class Matrix(Cart):
    observation_space, action_space = Box(-9, 9, (2, 1), np.float64), Box(-1, 1, (2, 1), np.float64)

    def seen(self) -> Any:
        return self.x[:, None]


class RewardOfShape1(Cart):
    def reward(self) -> Any:
        return np.array([-1.0])

    def ends(self) -> tuple[Any, Any]:
        return np.array([self.x[0] > 0.9]), np.bool_(False)


class RewardOfShape2(Cart):
    def reward(self) -> Any:
        return np.zeros(2)


class IgnoresItsSeed(Cart):
    def begin(self) -> None:
        self.x = np.random.default_rng().uniform(-1, 1, 2)


class CountsItsResets(Cart):
    resets = 0

    def begin(self) -> None:
        self.resets += 1
        self.x = self.x + self.resets


class UnseededNoise(Cart):
    def __init__(self) -> None:
        self.noise = np.random.default_rng()

    def push(self, u: np.ndarray) -> float:
        return float(u[0]) + self.noise.normal()


class GlobalNoise(Cart):
    def push(self, u: np.ndarray) -> float:
        return float(u[0]) + np.random.normal()  # noqa: NPY002


class SeededNoise(Cart):
    def push(self, u: np.ndarray) -> float:
        return float(u[0]) + self.np_random.normal()


class UnequalBounds(Cart):
    action_space = Box(np.float32([0, -1]), np.float32([10, 3]))


class BoundsOfTheType(Cart):
    action_space = Box(-np.finfo(np.float32).max, np.finfo(np.float32).max, (1,))


class NoBounds(Cart):
    action_space = Box(-np.inf, np.inf, (1,))


class WholeActions(Cart):
    action_space = Box(0, 5, (1,), np.int64)


class DiscreteActions(Cart):
    action_space = Discrete(3)


class Images(Cart):
    observation_space = Box(0, 255, (8, 8, 3), np.uint8)


class DiscreteInADict(Cart):
    observation_space = Dict(x=WIDE, mode=Discrete(2))


class OtherMeanings(Cart):
    """Its names, units, angles and dt are something else."""

    names, units, dt = ("left", "middle", "right"), {"x": "m"}, np.array([0.1, 0.2])
    metadata = {"render_fps": 10}  # noqa: RUF012

    @property
    def angles(self) -> np.ndarray:
        return self.x


class OnTheClass(Cart):
    """Copies that share what is under way."""

    line: list[float] = []  # noqa: RUF012

    def begin(self) -> None:
        OnTheClass.line = [0.0]

    def push(self, u: np.ndarray) -> float:
        self.line.append(float(u[0]))
        return self.line[-2]


class Scalar(Cart):
    action_space = Box(-1, 1, (), np.float16)


class ResetWithoutOptions(Cart):
    def reset(self, seed: int | None = None) -> Any:  # type: ignore[override]
        return super().reset(seed=seed)


class OldStep(Cart):
    def step(self, u: np.ndarray) -> Any:
        return super().step(u)[:4]


class OldReset(Cart):
    def reset(self, **options: Any) -> Any:
        return super().reset(**options)[0]


class ChangesItsAction(Cart):
    def push(self, u: np.ndarray) -> float:
        u *= 2
        return float(u[0])


class ChangesItsSpace(Cart):
    def seen(self) -> Any:
        return self.x if abs(self.x[0]) < 1.1 else np.zeros(3)


class BlowsUp(Cart):
    def push(self, u: np.ndarray) -> float:
        return np.nan


class BeginsNowhere(Cart):
    def begin(self) -> None:
        self.x = np.full(2, np.nan)


class Far(Cart):
    """Numbers that float32 tells apart by a thousandth."""

    def seen(self) -> Any:
        return self.x + 1e4


class FallsSoon(Cart):
    def ends(self) -> tuple[Any, Any]:
        return bool(self.x[0] > 0.5), bool(self.x[0] < -0.5)


class Wrapped:
    """Made by a function that wraps."""

    @staticmethod
    def make() -> gymnasium.Env:
        return gymnasium.wrappers.RescaleAction(Cart(), -2.0, 2.0)


class OwnNormalisation(gymnasium.Wrapper):
    """Divides by the largest number that it has seen."""

    most = 1.0

    def _scaled(self, x: np.ndarray) -> np.ndarray:
        self.most = max(self.most, 2 * float(np.abs(x).max()))
        return x / self.most

    def reset(self, **options: Any) -> Any:
        x, info = self.env.reset(**options)
        return self._scaled(x), info

    def step(self, u: Any) -> Any:
        x, *rest = self.env.step(u)
        return self._scaled(x), *rest


class Domain(HalfCheetahEnv):
    """Another gravity in every episode."""

    def reset(self, **options: Any) -> Any:
        result = super().reset(**options)
        self.model.opt.gravity[2] = -5 - self.np_random.uniform(0, 5)
        return result


class LosesMass(HalfCheetahEnv):
    """Its model changes with every step."""

    def step(self, u: np.ndarray) -> Any:
        self.model.body_mass[1:] *= 0.9
        return super().step(u)


@dataclass(frozen=True)
class Hostile:
    """One environment, and what has to come of it.

    made: makes it. fails: the error of collecting, ''. warns: a warning of collecting. oracle: the
    refusal of the true simulator, '' where it predicts what is executed. names: of its state.
    """

    made: Callable[[], gymnasium.Env]
    fails: str = ""
    warns: str = ""
    oracle: str = ""
    names: tuple[str, ...] = ("x0", "x1")
    repeats: bool = True  # whether a task can begin where it was seen to begin


GOAL = ("observation[0]", "observation[1]", "achieved_goal[0]", "desired_goal[0]")
CHEETAH = tuple(f"x{i}" for i in range(17))
HOSTILE = {
    kind.__name__: Hostile(kind, **expected)  # type: ignore[arg-type]
    for kind, expected in {
        NoRenderMode: {},
        HandsOutItsBuffer: {},
        DelayInAnObject: {},
        LateObject: {},
        DelayInAClosure: {},
        DelayInASlot: {},
        Views: {},
        DictObservation: {"names": ("speed", "position[0]")},
        TupleObservation: {"names": ("item0[0]", "item1.v[0,0]")},
        Goal: {"names": GOAL},
        MissingKey: {"fails": r"with keys \{'position'\}, but says that they are"},
        Matrix: {},
        RewardOfShape1: {},
        RewardOfShape2: {"fails": r"reward of .* is array\(\[0., 0.\]\); expected one number"},
        IgnoresItsSeed: {
            "warns": "does not begin again where it began",
            "repeats": False,
        },
        CountsItsResets: {"warns": "two resets with seed 0 gave", "repeats": False},
        UnseededNoise: {"oracle": "the same seed and actions do not repeat it, x. of episode 0"},
        GlobalNoise: {"oracle": "the same seed and actions do not repeat it"},
        SeededNoise: {},
        UnequalBounds: {},
        BoundsOfTheType: {"fails": "have no bounds.*TransformAction"},
        NoBounds: {"fails": "have no bounds.*TransformAction"},
        WholeActions: {"fails": "actions of .* are of type int64"},
        DiscreteActions: {"fails": r"actions of .* are discrete, Discrete\(3\); supported are"},
        Images: {"fails": "observations of .* are images.*TransformObservation"},
        DiscreteInADict: {"fails": "are a Discrete, .*in 'mode'; supported are"},
        OtherMeanings: {},
        OnTheClass: {"fails": "copies of .* share a state"},
        Scalar: {},
        ResetWithoutOptions: {"fails": "reset of .* expected reset"},
        OldStep: {"fails": "step of .* Gymnasium expects"},
        OldReset: {"fails": r"reset of .* Gymnasium expects \(observation, info\)"},
        ChangesItsAction: {},
        ChangesItsSpace: {"fails": r"gave an observation of shape \(3,\), but says"},
        BlowsUp: {"fails": "became unstable in episode 0 at step 0: x1 is nan"},
        BeginsNowhere: {"fails": "became unstable in episode 0 at step 0: x0 is nan"},
        Far: {},
        FallsSoon: {},
        Domain: {"names": CHEETAH},
        LosesMass: {"names": CHEETAH, "oracle": "the same seed and actions do not repeat it"},
    }.items()
}
HOSTILE["Wrapped"] = Hostile(Wrapped.make)
HOSTILE["OwnNormalisation"] = Hostile(
    lambda: OwnNormalisation(Cart()), warns="does not begin again where it began", repeats=False
)
HOSTILE["NormalizeObservation"] = Hostile(
    lambda: gymnasium.wrappers.NormalizeObservation(Cart()), fails="whose units drift"
)
