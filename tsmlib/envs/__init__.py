"""Two-link arms in two simulators behind one interface; importing this module registers them with Gymnasium.

``gymnasium.make(id)`` gives one arm, ``gymnasium.make_vec(id, num_envs=N)`` gives N arms whose ``rollout`` simulates
whole action sequences at once. The state is the observation, and its layout is the same in both simulators.
"""

import gymnasium

from tsmlib.envs.base import ArmEnv, ArmVectorEnv, SimulationUnstable, closest_gap

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


__all__ = ["ENV_IDS", "MUJOCO_IDS", "PYMUNK_IDS", "ArmEnv", "ArmVectorEnv", "SimulationUnstable", "closest_gap",
           "has_block"]  # fmt: skip
