"""Two-link arms in two simulators behind one interface; importing this module registers them with Gymnasium.

``gymnasium.make(id)`` gives one arm, ``gymnasium.make_vec(id, num_envs=N)`` gives N arms whose ``rollout`` simulates
whole action sequences at once. The state is the observation, and its layout is the same in both simulators.
``imperfect`` names the same arms with noisy sensors or delayed actions (section 5.3.3).
"""

from __future__ import annotations

from typing import Any

import gymnasium

from tsmlib.envs.geometry import DT, STATE_NAMES, STATE_UNITS
from tsmlib.envs.spec import DELAY, ENV_IDS, MUJOCO_IDS, NOISE, PYMUNK_IDS, has_block, imperfections
from tsmlib.envs.wrappers import ActionDelay, ImperfectArms, SensorNoise, _half_range

for _id in ENV_IDS:
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="tsmlib.envs.arm:ArmEnv",
            vector_entry_point="tsmlib.envs.mujoco_arm:MujocoArm"
            if _id in MUJOCO_IDS
            else "tsmlib.envs.pymunk_arm:PymunkArm",
            kwargs={"env_id": _id},
            max_episode_steps=100,
        )


def imperfect(env_id: str, *, noise: float = 0.0, delay: int = 0) -> str:
    """The id of the same arm behind `SensorNoise` and `ActionDelay`, registered where it is not yet.

    noise: sigma, in units of data scaled to [-1, 1] (``geometry.HALF_RANGE``). delay: tau in steps. Both of the
    paper's, ``NOISE`` and ``DELAY``, are registered for every arm. ValueError where they make no sense.
    """
    if env_id not in ENV_IDS:
        raise ValueError(f"{env_id!r} is none of {', '.join(ENV_IDS)}; noise and delay are added to one of these")
    whole = isinstance(delay, int) and not isinstance(delay, bool)
    if not 0.0 <= noise <= 10.0 or round(noise, 4) != noise or not (whole and 0 <= delay <= 100):
        raise ValueError(
            f"noise is {noise}, delay is {delay}; expected a sigma from 0 to 10 with at most four decimals, and a "
            "whole number of steps from 0 to 100"
        )
    if not noise and not delay:
        return env_id
    words = f"{f'-noise{noise:g}' if noise else ''}{f'-delay{delay}' if delay else ''}"
    name = f"{env_id.removesuffix('-v0')}{words}-v0"
    if name not in gymnasium.registry:
        gymnasium.register(
            name, entry_point="tsmlib.envs:_imperfect_arm", vector_entry_point="tsmlib.envs:_imperfect_arms",
            kwargs={"env_id": env_id, "noise": noise, "delay": delay}, max_episode_steps=100,
        )  # fmt: skip
    return name


def fingerprint(env_id: str) -> dict[str, Any]:
    """What data or a model of an environment belong to, as JSON values: anything that says otherwise does not fit."""
    arm, noise, delay = imperfections(env_id)
    if arm in PYMUNK_IDS:
        from tsmlib.envs.pymunk_arm import physics_hash
    else:
        from tsmlib.envs.mujoco_arm import physics_hash
    dx = 10 if has_block(env_id) else 6
    return {
        "env": env_id, "dt": DT, "names": list(STATE_NAMES[:dx]), "units": list(STATE_UNITS[:dx]), "angles": [0, 1],
        "noise": noise, "delay": delay, "simulator": physics_hash(arm),
    }  # fmt: skip


def _imperfect_arm(env_id: str, noise: float, delay: int, **kwargs: Any) -> gymnasium.Env:
    arm = gymnasium.make(env_id, disable_env_checker=True, **kwargs).unwrapped
    return ActionDelay(SensorNoise(arm, noise, _half_range(env_id)), delay)


def _imperfect_arms(num_envs: int, env_id: str, noise: float, delay: int, **kwargs: Any) -> ImperfectArms:
    arms = gymnasium.make_vec(env_id, num_envs=num_envs, **kwargs)
    return ImperfectArms(arms, sigma=noise, scale=_half_range(env_id), tau=delay)


for _id in ENV_IDS:
    imperfect(_id, noise=NOISE)
    imperfect(_id, delay=DELAY)
