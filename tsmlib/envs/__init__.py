"""Two-link arms in two simulators behind one interface; importing this module registers them with
Gymnasium.

``gymnasium.make(id)`` gives one arm, ``gymnasium.make_vec(id, num_envs=N)`` gives N arms whose
``rollout`` simulates whole action sequences at once;
``gymnasium.make("tsmlib.envs:tsm/ReacherPush-v1")`` imports this module by itself. The state is the
observation, and its layout is the same in both simulators. ``imperfect`` names the same arms with
noisy sensors or delayed actions (section 5.3.3), ``variant`` arms with other physics, as
``gymnasium.make(id, mass=2.0)`` makes them. A simulator is imported when an arm in it is first
made.
"""

from dataclasses import replace
from importlib import import_module
from typing import Unpack

from gymnasium.envs.registration import register

from tsmlib.envs.geometry import DT, STATE_NAMES, STATE_UNITS
from tsmlib.envs.physics import STANDARD, Changes
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE, EnvSpec


def imperfect(env_id: str, *, noise: float = 0.0, delay: int = 0) -> str:
    """The id of the same arm behind `SensorNoise` and `ActionDelay`, registered where it is not
    yet.

    noise: sigma, in units of data scaled to [-1, 1] (``geometry.HALF_RANGE``). delay: tau in steps.
    Both of the paper's, ``NOISE`` and ``DELAY``, are registered for every arm. ValueError where
    they make no sense.
    """
    plain = _spec(env_id)
    if plain is None or plain != plain.arm:
        raise ValueError(
            f"{env_id!r} is none of {', '.join(ENV_IDS)}, nor a variant; noise and delay are added "
            "to one of these"
        )
    whole = isinstance(delay, int) and not isinstance(delay, bool)
    if not 0.0 <= noise <= 10.0 or round(noise, 4) != noise or not (whole and 0 <= delay <= 100):
        raise ValueError(
            f"noise is {noise}, delay is {delay}; expected a sigma from 0 to 10 with at most four "
            "decimals, and a "
            "whole number of steps from 0 to 100"
        )
    return _known(replace(plain, noise=noise, delay=delay))


def variant(env_id: str, **changes: Unpack[Changes]) -> str:
    """The id of the same arm with other physics (`Physics`), registered where it is not yet.

    ``gymnasium.make(env_id, **changes)`` makes the same environment. ValueError where a value makes
    no sense.
    """
    return _known(EnvSpec.parse(env_id).varied(**changes))


def fingerprint(env_id: str) -> dict[str, object]:
    """What data or a model of an environment belong to, as JSON values: anything that says
    otherwise does not fit.

    Of a variant, the values that it changes are fields of their own, and ``standard`` holds those
    of the standard arm.
    """
    spec = EnvSpec.parse(env_id)
    simulator = import_module(f"tsmlib.envs.{spec.simulator}_arm").physics_hash(spec.arm.id)
    names, units = (list(part[: spec.state_dim]) for part in (STATE_NAMES, STATE_UNITS))
    changed = spec.physics.changed
    varied = {**changed, "standard": {name: STANDARD[name] for name in changed}} if changed else {}
    return {
        "env": env_id,
        "dt": DT,
        "names": names,
        "units": units,
        "angles": [0, 1],
        "noise": spec.noise,
        "delay": spec.delay,
        **varied,
        "simulator": simulator,
    }


def _known(spec: EnvSpec) -> str:
    return EnvSpec.parse(spec.id).id


def _spec(env_id: str) -> EnvSpec | None:
    try:
        return EnvSpec.parse(env_id)
    except ValueError:
        return None


for _id in ENV_IDS:
    EnvSpec.parse(_id)
    imperfect(_id, noise=NOISE)
    imperfect(_id, delay=DELAY)

register(  # `pusht_field.pusht_variant` registers others; importing it here would load torch
    "tsm/PushT-v0",
    entry_point="tsmlib.envs.pusht:PushTEnv",
    vector_entry_point="tsmlib.envs.pusht:PushT",
    max_episode_steps=300,
)
