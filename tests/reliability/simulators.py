"""R17-R19: instabilities of the simulators, and their states restored bit for bit."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np

from reliability.world import Outcome, rng
from tsmlib.envs.arm import ArmVectorEnv
from tsmlib.envs.geometry import DT, closest_gap
from tsmlib.envs.spec import MUJOCO_IDS, PYMUNK_IDS
from tsmlib.envs.unstable import SimulationUnstable

PUSH, PYMUNK_PUSH = "tsm/ReacherPush-v1", "tsm/PymunkPush-v1"


def arms(env_id: str, n: int, seed: int = 0) -> ArmVectorEnv:
    """n episodes at their start."""
    env = gymnasium.make_vec(env_id, num_envs=n).unwrapped
    assert isinstance(env, ArmVectorEnv)
    env.reset(seed=seed)
    return env


def torques(n: int, steps: int, seed: int = 0, size: float = 0.4) -> np.ndarray:
    """Actions (n, steps, 2) that change slowly, and meet the block."""
    noise = np.random.default_rng(seed).standard_normal((n, steps // 5 + 1, 2))
    return np.clip(size * np.repeat(noise, 5, axis=1)[:, :steps], -1, 1)


def faults_in_mujoco(trials: int) -> Outcome:
    """R17: NaN and huge positions, speeds, torques, and overlaps, at a random step: each raises
    there, by name.
    """
    found = Outcome()
    for trial in range(trials):
        draw, env_id = rng(17, trial), MUJOCO_IDS[trial % 3]
        env: Any = arms(env_id, 6)
        episode, step = draw.randrange(6), draw.randrange(1, 20)
        env.rollout(torques(6, step, trial))
        what = ("position", "speed", "torque", "overlap")[trial // 3 % 4]
        value = draw.choice([math.nan, math.inf, 1e11, -1e300])
        try:
            if what == "torque":
                actions = torques(6, 10)
                actions[episode, 0, 1] = draw.choice([math.nan, math.inf, -math.inf])
                env.rollout(actions)
            elif what == "overlap" and env.task != "reach":
                states = env.reset(seed=trial)[0]
                reach = states[episode, 4:6]
                states[episode, 6:8] = draw.uniform(0.0, 0.9) * reach
                step = 0
                env.reset(options={"states": states})
            else:
                column = 1 if what == "position" else 1 + env.model.nq
                env._physics[episode, column + draw.randrange(2)] = value
                env.rollout(torques(6, 10))
            found.count(False, f"{env_id}, {what} {value} at step {step}: nothing was said")
        except SimulationUnstable as error:
            good = (error.env, error.episode, error.step) == (env_id, episode, step)
            words = (env_id, f"episode {episode}", f"step {step}")
            found.count(good and all(word in str(error) for word in words), str(error))
        except ValueError as error:  # a torque that is no number: nothing was simulated
            good = (
                what == "torque"
                and f"episode {episode}, step 0" in str(error)
                and env_id in str(error)
            )
            found.count(good, str(error))
        env.close()
    return found


def faults_in_pymunk(trials: int) -> Outcome:
    """R18: NaN, infinite and huge angles, speeds, forces and velocities: each raises at the same
    step.
    """
    found = Outcome()
    for trial in range(trials):
        draw, env_id = rng(18, trial), PYMUNK_IDS[trial % 3]
        env: Any = arms(env_id, 3)
        episode, step = draw.randrange(3), draw.randrange(1, 12)
        env.rollout(torques(3, step, trial))
        live = env._live[episode]
        value = draw.choice([math.nan, math.inf, -math.inf, 1e300])
        match draw.choice(["angle", "speed", "force", "velocity", "block"]):
            case "angle":
                live.link1.angle = value
            case "speed":
                live.link2.angular_velocity = value
            case "force":
                live.link2.force = (value, value)
            case "velocity":
                live.link2.velocity = (value, 0.0)
            case _ if env.task == "push":
                live.block.velocity = (value, value)
            case _:
                live.link2.angle = value
        try:
            states = env.rollout(torques(3, 5))
            found.count(False, f"trial {trial} in {env_id}: nothing was said, {states[episode, 0]}")
        except SimulationUnstable as error:
            found.count(
                (error.env, error.episode, error.step) == (env_id, episode, step), str(error)
            )
    return found


def restores(trials: int) -> Outcome:
    """R19: an episode that is replayed to a random step, contacts among them, goes on with the
    same bits.
    """
    found, n, steps = Outcome(), 8, 60
    contacts = 0
    for env_id in (PUSH, PYMUNK_PUSH):
        actions = torques(n, steps, 3, size=0.25)
        whole = arms(env_id, n).rollout(actions)
        close = (closest_gap(whole, env_id) < 1e-4).any(axis=0)
        contacts += int(close.sum())
        for trial in range(trials):
            draw = rng(19, trial)
            touching = trial % 2 and close.any()
            at = (
                draw.choice(np.flatnonzero(close).tolist()) + 1
                if touching
                else draw.randrange(1, steps)
            )
            at = min(at, steps - 1)
            other = arms(env_id, n, seed=99)
            other.reset(seed=0)
            other.rollout(actions[:, :at])
            found.count(
                np.array_equal(other.rollout(actions[:, at:]), whole[:, at:]),
                f"{env_id} from step {at}",
            )
    found.note = f"{contacts} of {2 * steps} steps with contacts"
    return found


def large_sets(trials: int) -> Outcome:
    """R17: sets of ``trials`` episodes hold no warning, no jump, nothing that is not finite."""
    from reproduction.episodes import random_data

    found = Outcome()
    for env_id in (*MUJOCO_IDS, *PYMUNK_IDS):
        n = trials if env_id in MUJOCO_IDS else max(10, trials // 10)
        states = random_data(env_id, n, seed=17).states.astype(float)
        change, speed = np.abs(np.diff(states[..., :2], axis=1)), np.abs(states[..., 2:4])
        fastest = np.maximum(speed[:, 1:], speed[:, :-1])
        # Within a step a joint may bounce off its stop or the block: then speeds before and after
        # say less
        found.count(
            (change <= 1.5 * fastest.max() * DT).all(), f"{env_id}: a jump of {change.max()} rad"
        )
        found.count(np.isfinite(states).all(), env_id)
    return found
