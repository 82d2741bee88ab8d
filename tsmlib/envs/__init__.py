"""Two-link arms in two simulators behind one interface; importing this module registers them with Gymnasium.

``gymnasium.make(id)`` gives one arm, ``gymnasium.make_vec(id, num_envs=N)`` gives N arms whose ``rollout`` simulates
whole action sequences at once; ``gymnasium.make("tsmlib.envs:tsm/ReacherPush-v1")`` imports this module by itself.
The state is the observation, and its layout is the same in both simulators. ``imperfect`` names the same arms with
noisy sensors or delayed actions (section 5.3.3). A simulator is imported when an arm in it is first made.
"""

from dataclasses import replace
from importlib import import_module

from gymnasium.envs.registration import register, registry

from tsmlib.envs.geometry import DT, STATE_NAMES, STATE_UNITS
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE, EnvSpec

_VECTOR_ARMS = {"mujoco": "tsmlib.envs.mujoco_arm:MujocoArm", "pymunk": "tsmlib.envs.pymunk_arm:PymunkArm"}


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
    name = replace(EnvSpec.parse(env_id), noise=noise, delay=delay).id
    if name not in registry:
        register(
            name, entry_point="tsmlib.envs.wrappers:imperfect_arm",
            vector_entry_point="tsmlib.envs.wrappers:imperfect_arms",
            kwargs={"env_id": env_id, "noise": noise, "delay": delay}, max_episode_steps=100,
        )  # fmt: skip
    return name


def fingerprint(env_id: str) -> dict[str, object]:
    """What data or a model of an environment belong to, as JSON values: anything that says otherwise does not fit."""
    spec = EnvSpec.parse(env_id)
    physics = import_module(_VECTOR_ARMS[spec.simulator].partition(":")[0])
    names, units = (list(part[: spec.state_dim]) for part in (STATE_NAMES, STATE_UNITS))
    return {
        "env": env_id, "dt": DT, "names": names, "units": units, "angles": [0, 1],
        "noise": spec.noise, "delay": spec.delay, "simulator": physics.physics_hash(spec.arm.id),
    }  # fmt: skip


for _id in ENV_IDS:
    if _id not in registry:
        register(
            _id, entry_point="tsmlib.envs.arm:ArmEnv", vector_entry_point=_VECTOR_ARMS[EnvSpec.parse(_id).simulator],
            kwargs={"env_id": _id}, max_episode_steps=100,
        )  # fmt: skip
    imperfect(_id, noise=NOISE)
    imperfect(_id, delay=DELAY)
