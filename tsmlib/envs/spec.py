"""Environment ids, and what each says: simulator, task, noise and delay. The version is the task's."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, get_args

Simulator = Literal["mujoco", "pymunk"]
TaskName = Literal["reach", "obstacle", "push"]
NOISE, DELAY = 0.25, 5  # section 5.3.3: sigma on data scaled to [-1, 1]; steps

_ARMS = {
    "mujoco": {"reach": "Reacher", "obstacle": "ReacherObstacle", "push": "ReacherPush"},
    "pymunk": {"reach": "PymunkReacher", "obstacle": "PymunkObstacle", "push": "PymunkPush"},
}
_VERSION = {"reach": 0, "obstacle": 0, "push": 1}
_CHANGED = {
    "push": "the physics of pushing changed (a free object slows down by e in 0.05 s, before in 0.2 s; walls at 0.24 m "
    "from the shoulder, before at 0.28 m; first poses in every direction; T = 100 steps, before 50)"
}  # fmt: skip


@dataclass(frozen=True)
class EnvSpec:
    """One environment: an arm in a simulator, with a task, noisy sensors (sigma) and delayed actions (steps)."""

    simulator: Simulator
    task: TaskName
    noise: float = 0.0
    delay: int = 0

    @staticmethod
    @cache
    def parse(env_id: str) -> EnvSpec:
        """The environment of an id. ValueError for another id; of one that is gone, why, and what took its place."""
        arm, noise, delay, version = _parts(env_id)
        if f"{arm}-v{version}" not in _PLAIN:
            raise ValueError(
                gone(env_id) or f"{env_id!r} is none of {', '.join(ENV_IDS)}, nor what imperfect() calls one of them"
            )
        return replace(_PLAIN[f"{arm}-v{version}"], noise=float(noise or 0.0), delay=int(delay or 0))

    @property
    def name(self) -> str:
        """Name in folders and titles: ``"ReacherPush"``, ``"Reacher-delay5"``."""
        noise, delay = f"-noise{self.noise:g}" if self.noise else "", f"-delay{self.delay}" if self.delay else ""
        return f"{_ARMS[self.simulator][self.task]}{noise}{delay}"

    @property
    def id(self) -> str:
        """Gymnasium's id: ``"tsm/ReacherPush-noise0.25-v0"``."""
        return f"tsm/{self.name}-v{_VERSION[self.task]}"

    @property
    def arm(self) -> EnvSpec:
        """The same arm without noise and delay."""
        return replace(self, noise=0.0, delay=0)

    @property
    def has_block(self) -> bool:
        """Whether there is an obstacle or object, and so something that the arm can touch."""
        return self.task != "reach"

    @property
    def state_dim(self) -> int:
        """Size of the state."""
        return 10 if self.has_block else 6


_PLAIN = {spec.id: spec for sim in get_args(Simulator) for task in get_args(TaskName) for spec in [EnvSpec(sim, task)]}
ENV_IDS = tuple(_PLAIN)
MUJOCO_IDS, PYMUNK_IDS = ENV_IDS[:3], ENV_IDS[3:]


def gone(env_id: str) -> str:
    """Why an id of an older version is refused, and which took its place; '' for any other text."""
    arm, noise, delay, version = _parts(env_id)
    for spec in _PLAIN.values():
        if arm == f"tsm/{spec.name}" and int(version) < _VERSION[spec.task]:
            present = replace(spec, noise=float(noise or 0.0), delay=int(delay or 0)).id
            return f"{env_id} is gone: {_CHANGED[spec.task]}. {present} took its place"
    return ""


def _parts(env_id: str) -> tuple[str, str | None, str | None, str]:
    """Arm, noise, delay and version as they stand in an id; empty where it is none."""
    parts = re.fullmatch(r"(.*?)(?:-noise([0-9.]+))?(?:-delay([0-9]+))?-v([0-9]+)", env_id)
    return (parts[1], parts[2], parts[3], parts[4]) if parts else ("", None, None, "")
