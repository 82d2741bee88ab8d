"""Environment ids, and what each says: simulator, task, physics, noise and delay. The version is
the task's.

Gymnasium knows the six standard arms, and each with the paper's noise or delay. Another one is
registered when its id is first parsed, so that data and models bring their environment with them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal, Unpack, get_args

from gymnasium.envs.registration import register, registry

from tsmlib.envs import physics
from tsmlib.envs.physics import STANDARD, Changes, Physics

Simulator = Literal["mujoco", "pymunk"]
TaskName = Literal["reach", "obstacle", "push"]
NOISE, DELAY = 0.25, 5  # section 5.3.3: sigma on data scaled to [-1, 1]; steps

_ARMS = {
    "mujoco": {"reach": "Reacher", "obstacle": "ReacherObstacle", "push": "ReacherPush"},
    "pymunk": {"reach": "PymunkReacher", "obstacle": "PymunkObstacle", "push": "PymunkPush"},
}
_VERSION = {"reach": 0, "obstacle": 0, "push": 1}
_NOTHING_TO_CHANGE: dict[TaskName, dict[str, str]] = {
    "reach": {"mass": "it has no object", "object_radius": "it has no object"},
    "obstacle": {"mass": "its obstacle does not move"},
    "push": {},
}


@dataclass(frozen=True)
class EnvSpec:
    """One environment: an arm in a simulator, with a task, noisy sensors (sigma) and delayed
    actions (steps).
    """

    simulator: Simulator
    task: TaskName
    noise: float = 0.0
    delay: int = 0
    physics: Physics = field(default_factory=Physics)

    @staticmethod
    @cache
    def parse(env_id: str) -> EnvSpec:
        """The environment of an id, which Gymnasium knows from then on.

        ValueError for another id.
        """
        arm, changed, noise, delay, version = _parts(env_id)
        if f"{arm}-v{version}" not in _PLAIN:
            raise ValueError(
                f"{env_id!r} is none of {', '.join(ENV_IDS)}, nor what imperfect() calls one of "
                "them, nor a variant()"
            )
        spec = replace(
            _PLAIN[f"{arm}-v{version}"], noise=float(noise or 0.0), delay=int(delay or 0)
        )
        spec = spec.varied(**physics.parse(changed))
        if any(changed) and spec.id != env_id:
            raise ValueError(f"{env_id} is written {spec.id}")
        return spec.registered()

    def varied(self, **changes: Unpack[Changes]) -> EnvSpec:
        """The same environment with other physics. ValueError where a value, or it in this task,
        makes no sense.
        """
        allowed = [name for name in STANDARD if name not in _NOTHING_TO_CHANGE[self.task]]
        if refused := [name for name in changes if name not in allowed]:
            why = _NOTHING_TO_CHANGE[self.task].get(refused[0], "there is no such quantity")
            raise ValueError(
                f"{refused[0]} of {self.id} cannot be chosen: {why}. It takes {', '.join(allowed)}"
            )
        return replace(self, physics=replace(self.physics, **changes))

    def registered(self) -> EnvSpec:
        """The same environment, which Gymnasium knows from now on."""
        _register(self)
        return self

    @property
    def name(self) -> str:
        """Name in folders and titles: ``"ReacherPush"``, ``"ReacherPush-mass2"``,
        ``"Reacher-delay5"``.
        """
        noise = f"-noise{self.noise:g}" if self.noise else ""
        delay = f"-delay{self.delay}" if self.delay else ""
        return f"{_ARMS[self.simulator][self.task]}{self.physics.word}{noise}{delay}"

    @property
    def id(self) -> str:
        """Gymnasium's id: ``"tsm/ReacherPush-noise0.25-v0"``."""
        return f"tsm/{self.name}-v{_VERSION[self.task]}"

    @property
    def arm(self) -> EnvSpec:
        """The same arm without noise and delay."""
        return replace(self, noise=0.0, delay=0)

    @property
    def standard(self) -> EnvSpec:
        """The standard arm with this task, without noise and delay."""
        return EnvSpec(self.simulator, self.task)

    @property
    def has_block(self) -> bool:
        """Whether there is an obstacle or object, and so something that the arm can touch."""
        return self.task != "reach"

    @property
    def state_dim(self) -> int:
        """Size of the state."""
        return 10 if self.has_block else 6


CONTROL = ("reacher-easy", "reacher-hard", "cartpole-swingup", "pendulum-swingup", "cup-catch")
CONTROL_IDS = tuple(f"tsm/dmc-{name}-v0" for name in CONTROL)  # see ``dmc``


def is_arm(env_id: str) -> bool:
    """Whether an id is of an arm, or is meant to be, as opposed to what else is ours or foreign."""
    return env_id.startswith("tsm/") and not env_id.startswith(
        ("tsm/PushT-", "tsm/dmc-", "tsm/dmc/")
    )


_VECTOR_ARMS = {
    "mujoco": "tsmlib.envs.mujoco_arm:MujocoArm",
    "pymunk": "tsmlib.envs.pymunk_arm:PymunkArm",
}


def _register(spec: EnvSpec) -> None:
    """Make an environment known to Gymnasium. A simulator is imported when an arm in it is first
    made.
    """
    if spec.id in registry:
        return
    many, kwargs = _VECTOR_ARMS[spec.simulator], dict[str, object](env_id=spec.arm.id)
    if spec != spec.arm:
        many = "tsmlib.envs.wrappers:imperfect_arms"
        kwargs |= {"noise": spec.noise, "delay": spec.delay}
    register(
        spec.id,
        entry_point="tsmlib.envs.arm:ArmEnv",
        vector_entry_point=many,
        kwargs=kwargs,
        max_episode_steps=100,
    )


_PLAIN = {
    spec.id: spec
    for sim in get_args(Simulator)
    for task in get_args(TaskName)
    for spec in [EnvSpec(sim, task)]
}
ENV_IDS = tuple(_PLAIN)
MUJOCO_IDS, PYMUNK_IDS = ENV_IDS[:3], ENV_IDS[3:]


def _parts(env_id: str) -> tuple[str, tuple[str | None, ...], str | None, str | None, str]:
    """Arm, changed physics, noise, delay and version as they stand in an id; empty where it is
    none.
    """
    parts = re.fullmatch(
        rf"(.*?){physics.PATTERN}(?:-noise([0-9.]+))?(?:-delay([0-9]+))?-v([0-9]+)", env_id
    )
    if not parts:
        return "", (None,) * len(STANDARD), None, None, ""
    arm, *changed, noise, delay, version = parts.groups()
    return arm, tuple(changed), noise, delay, version
