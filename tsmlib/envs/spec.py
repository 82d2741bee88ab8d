"""Environment ids, and what each says: simulator, task, noise and delay."""

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
        """The environment of an id. ValueError for another id."""
        parts = re.fullmatch(r"(.*?)(?:-noise([0-9.]+))?(?:-delay([0-9]+))?-v0", env_id)
        arm, noise, delay = parts.groups() if parts else ("", None, None)
        if f"{arm}-v0" not in _PLAIN:
            raise ValueError(f"{env_id!r} is none of {', '.join(ENV_IDS)}, nor what imperfect() calls one of them")
        return replace(_PLAIN[f"{arm}-v0"], noise=float(noise or 0.0), delay=int(delay or 0))

    @property
    def name(self) -> str:
        """Name in folders and titles: ``"ReacherPush"``, ``"Reacher-delay5"``."""
        noise, delay = f"-noise{self.noise:g}" if self.noise else "", f"-delay{self.delay}" if self.delay else ""
        return f"{_ARMS[self.simulator][self.task]}{noise}{delay}"

    @property
    def id(self) -> str:
        """Gymnasium's id: ``"tsm/ReacherPush-noise0.25-v0"``."""
        return f"tsm/{self.name}-v0"

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
