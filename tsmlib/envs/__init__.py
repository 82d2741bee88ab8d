"""Two-link arms in two simulators behind one interface, PushT, and five tasks with the figures of
the DeepMind Control Suite, registered with Gymnasium.

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
from tsmlib.envs.spec import CONTROL, CONTROL_IDS, DELAY, ENV_IDS, NOISE, EnvSpec


def imperfect(env_id: str, *, noise: float = 0.0, delay: int = 0) -> str:
    """Name the same arm with noisy sensors or late actions, and register it (section 5.3.3).

    Args:
        env_id: of a plain arm or a variant.
        noise: sigma, in units of data scaled to [-1, 1] (``geometry.HALF_RANGE``); at most four
            decimals. The paper's is ``NOISE``.
        delay: tau, steps. The paper's is ``DELAY``.

    Returns:
        The id.

    Raises:
        ValueError: another environment, or a noise or delay that makes no sense.
    """
    try:
        plain = EnvSpec.parse(env_id)
    except ValueError:
        plain = None
    if plain is None or plain != plain.arm:
        raise ValueError(
            f"{env_id!r} is none of {', '.join(ENV_IDS)}, nor a variant; noise and delay are added "
            "to one of these"
        )
    whole = isinstance(delay, int) and not isinstance(delay, bool)
    if not 0.0 <= noise <= 10.0 or round(noise, 4) != noise or not (whole and 0 <= delay <= 100):
        raise ValueError(
            f"noise is {noise}, delay is {delay}; expected a sigma from 0 to 10 with at most four "
            "decimals, and a whole number of steps from 0 to 100"
        )
    return replace(plain, noise=noise, delay=delay).registered().id


def variant(env_id: str, **changes: Unpack[Changes]) -> str:
    """Name the same arm with other physics, and register it.

    ``gymnasium.make(env_id, **changes)`` makes the same environment.

    Args:
        env_id: of an arm.
        **changes: of `Physics`: mass (kg), damping (N m s/rad), link_lengths (m), object_radius (m)
            and torque_gain.

    Returns:
        The id.

    Raises:
        ValueError: a value, or it in this task, makes no sense.
    """
    return EnvSpec.parse(env_id).varied(**changes).registered().id


def fingerprint(env_id: str) -> dict[str, object]:
    """Say what data or a model of an arm belong to; what says otherwise does not fit.

    Args:
        env_id: of an arm.

    Returns:
        JSON values. Of a variant, the values that it changes are fields of their own, and
        ``standard`` holds those of the standard arm.
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

for _id, _task in zip(CONTROL_IDS, CONTROL, strict=True):
    register(
        _id, entry_point="tsmlib.envs.dmc:ControlEnv", kwargs={"task": _task}, max_episode_steps=500
    )
