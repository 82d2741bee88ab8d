"""Environment ids: which there are, and simulator, task, noise and delay of each."""

from __future__ import annotations

import re

MUJOCO_IDS = ("tsm/Reacher-v0", "tsm/ReacherObstacle-v0", "tsm/ReacherPush-v0")
PYMUNK_IDS = ("tsm/PymunkReacher-v0", "tsm/PymunkObstacle-v0", "tsm/PymunkPush-v0")
ENV_IDS = MUJOCO_IDS + PYMUNK_IDS
NOISE, DELAY = 0.25, 5  # section 5.3.3: sigma on data scaled to [-1, 1]; steps


def sim_of(env: str) -> str:
    """The simulator behind an environment id, as the tables name it."""
    return "pymunk" if "Pymunk" in env else "mujoco"


def task_of(env_id: str) -> str:
    """``"reacher"``, ``"obstacle"`` or ``"push"``, whichever the id of the environment ends in."""
    for task in ("push", "obstacle", "reacher"):
        if env_id.lower().partition("-")[0].endswith(task):
            return task
    raise ValueError(f"unknown environment id {env_id!r}: expected one of tsmlib.envs.ENV_IDS")


def imperfections(env_id: str) -> tuple[str, float, int]:
    """The plain arm behind an id, the noise of its sensors and the delay of its actions. ValueError for another id."""
    parts = re.fullmatch(r"(.*?)(?:-noise([0-9.]+))?(?:-delay([0-9]+))?-v0", env_id)
    arm, noise, delay = parts.groups() if parts else ("", None, None)
    if f"{arm}-v0" not in ENV_IDS:
        raise ValueError(f"{env_id!r} is none of {', '.join(ENV_IDS)}, nor what imperfect() calls one of them")
    return f"{arm}-v0", float(noise or 0.0), int(delay or 0)


def has_block(env: str) -> bool:
    """Whether there is an obstacle or object, and so something that the arm can touch."""
    return task_of(env) != "reacher"
