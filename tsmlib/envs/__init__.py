"""Two-link arms in two simulators behind one interface; importing this module registers them with Gymnasium.

``gymnasium.make(id)`` gives one arm, ``gymnasium.make_vec(id, num_envs=N)`` gives N arms whose ``rollout`` simulates
whole action sequences at once. The state is the observation, and its layout is the same in both simulators.
"""

from typing import Any

import gymnasium

from tsmlib.envs.base import (
    DT,
    STATE_NAMES,
    STATE_UNITS,
    ArmEnv,
    ArmVectorEnv,
    SimulationUnstable,
    closest_gap,
)

MUJOCO_IDS = ("tsm/Reacher-v0", "tsm/ReacherObstacle-v0", "tsm/ReacherPush-v0")
PYMUNK_IDS = ("tsm/PymunkReacher-v0", "tsm/PymunkObstacle-v0", "tsm/PymunkPush-v0")
ENV_IDS = MUJOCO_IDS + PYMUNK_IDS

for _id in ENV_IDS:
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="tsmlib.envs.base:ArmEnv",
            vector_entry_point="tsmlib.envs.mujoco_arm:MujocoArm"
            if _id in MUJOCO_IDS
            else "tsmlib.envs.pymunk_arm:PymunkArm",
            kwargs={"env_id": _id},
            max_episode_steps=100,
        )


def has_block(env: str) -> bool:
    """Whether there is an obstacle or object, and so something that the arm can touch."""
    return "Reacher-v0" not in env


def fingerprint(env_id: str, *, noise: float = 0.0, delay: int = 0) -> dict[str, Any]:
    """What data or a model of an environment belong to, as JSON values: anything that says otherwise does not fit.

    noise: sigma of `SensorNoise`; delay: tau of `ActionDelay`, steps.
    """
    if env_id in PYMUNK_IDS:
        from tsmlib.envs.pymunk_arm import physics_hash
    else:
        from tsmlib.envs.mujoco_arm import physics_hash
    dx = 10 if has_block(env_id) else 6
    return {
        "env": env_id, "dt": DT, "names": list(STATE_NAMES[:dx]), "units": list(STATE_UNITS[:dx]), "angles": [0, 1],
        "noise": noise, "delay": delay, "simulator": physics_hash(env_id),
    }  # fmt: skip


__all__ = [
    "ENV_IDS",
    "MUJOCO_IDS",
    "PYMUNK_IDS",
    "ArmEnv",
    "ArmVectorEnv",
    "SimulationUnstable",
    "closest_gap",
    "fingerprint",
    "has_block",
]
