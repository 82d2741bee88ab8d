"""What must hold in the pymunk world, whatever the torques."""

import gymnasium
import numpy as np
import pytest

from tsmlib.envs.arm import ArmVectorEnv
from tsmlib.envs.geometry import (
    BLOCK_DECAY,
    BLOCK_MASS,
    BLOCK_RADIUS,
    DT,
    ELBOW_LIMIT,
    GEAR,
    LINK_LENGTHS,
    WALL,
    closest_gap,
    fingertip,
)
from tsmlib.envs.pymunk_arm import ARMATURE, DAMPING, ELBOW_MASS
from tsmlib.envs.spec import PYMUNK_IDS
from tsmlib.envs.unstable import SimulationUnstable

REACHER, OBSTACLE, PUSH = PYMUNK_IDS
N, T = 40, 100


def arms(env_id: str, n: int = N, seed: int | None = 0) -> tuple[ArmVectorEnv, np.ndarray]:
    """n episodes at their start, and their states (n, dx)."""
    env = gymnasium.make_vec(env_id, num_envs=n).unwrapped
    return env, env.reset(seed=seed)[0]


def smooth_torques(n: int = N, steps: int = T, rms: float = 0.1, seed: int = 0) -> np.ndarray:
    """Actions (n, steps, 2) below about 2 Hz."""
    noise = np.random.default_rng(seed).standard_normal((n, steps + 40, 2))
    kernel = np.convolve(np.exp(-np.arange(20) / 4), np.exp(-np.arange(20) / 4))
    smooth = np.apply_along_axis(np.convolve, 1, noise, kernel, mode="same")[:, 20:-20]
    return np.clip(rms * smooth / np.linalg.norm(kernel), -1, 1)


def full_torques(n: int = N, steps: int = T, seed: int = 0) -> np.ndarray:
    """Actions (n, steps, 2) of -1 or 1 that jump at random; in a third of the episodes they never
    jump.
    """
    actions = np.random.default_rng(seed).choice([-1.0, 1.0], (n, steps, 2))
    actions[: n // 3] = actions[: n // 3, :1]
    return actions


def at_rest(
    q: tuple[float, float], block: tuple[float, float], velocity: tuple[float, float] = (0, 0)
) -> np.ndarray:
    """A state (1, 10)."""
    return np.array([[*q, 0.0, 0.0, *fingertip(np.array(q)), *block, *velocity]])


@pytest.mark.parametrize("env_id", [OBSTACLE, PUSH])
def test_an_untouched_object_does_not_move(env_id: str) -> None:
    env, start = arms(env_id, n=200)
    states = env.rollout(smooth_torques(200))
    untouched = (closest_gap(states, env_id) > 0.02).all(
        axis=1
    )  # further away than the arm moves in a substep
    assert untouched.sum() > 20
    moved = np.abs(states[untouched, :, 6:] - start[untouched, None, 6:])
    assert moved.max() < 1e-9


def test_an_obstacle_never_moves_and_stops_the_arm() -> None:
    env, _ = arms(OBSTACLE, n=1)
    env.reset(options={"states": at_rest((0.0, 0.0), (0.0, 0.1))})
    states = env.rollout(np.tile([0.1, 0.0], (1, T, 1)))
    assert states[0, :, 0].max() < np.pi / 2
    np.testing.assert_array_equal(states[0, :, 6:], np.tile([0.0, 0.1, 0.0, 0.0], (T, 1)))
    reacher, _ = arms(REACHER, n=1)
    free = reacher.rollout(np.tile([0.1, 0.0], (1, T, 1)))
    assert free[0, :, 0].max() > np.pi


def test_energy_without_torque_only_falls() -> None:
    """It goes into the joint dampers, the drag, the elbow's limit and the impacts, and nothing
    comes back.
    """
    env, states = arms(PUSH)
    rng = np.random.default_rng(0)
    states[:, 2:4] = rng.uniform(-5, 5, (N, 2))
    states[:, 8:] = rng.uniform(-0.5, 0.5, (N, 2))
    env.reset(options={"states": states})
    states = np.concatenate([states[:, None], env.rollout(np.zeros((N, T, 2)))], axis=1)
    shoulder, elbow = states[..., 2], states[..., 2] + states[..., 3]
    energy = (
        ARMATURE + ELBOW_MASS * LINK_LENGTHS[0] ** 2
    ) * shoulder**2 / 2 + ARMATURE * elbow**2 / 2
    energy += BLOCK_MASS * np.sum(states[..., 8:] ** 2, axis=-1) / 2
    assert (np.diff(energy, axis=1) < 0).all()
    assert (energy[:, -1] < 0.3 * energy[:, 0]).all()


def test_the_free_arm_obeys_its_equation_of_motion() -> None:
    env, _ = arms(REACHER, n=1)
    env.reset(options={"states": np.zeros((1, 6))})
    actions = 0.02 * np.ones((1, 20, 2)) * [1.0, 0.5]
    states = env.rollout(actions)[0]
    w, q = np.zeros(2), np.zeros(2)  # world speeds, world angles
    for shoulder, elbow in np.repeat(GEAR * actions[0], 200, axis=0):
        joint = np.array([w[0], w[1] - w[0]])
        w = w + DT / 200 * np.array(
            [
                (shoulder - elbow - DAMPING * (joint[0] - joint[1]))
                / (ARMATURE + ELBOW_MASS * LINK_LENGTHS[0] ** 2),
                (elbow - DAMPING * joint[1]) / ARMATURE,
            ]
        )
        q = q + DT / 200 * w
    np.testing.assert_allclose(
        states[-1, :4], [q[0], q[1] - q[0], w[0], w[1] - w[0]], rtol=0.02, atol=1e-3
    )


def test_drag_slows_a_free_object_at_the_given_rate() -> None:
    env, _ = arms(PUSH, n=1)
    env.reset(options={"states": at_rest((0.0, 0.0), (-0.1, 0.0), (0.0, 0.3))})
    speed = env.rollout(np.zeros((1, 20, 2)))[0, :, 9]
    np.testing.assert_allclose(speed, 0.3 * np.exp(-DT * np.arange(1, 21) / BLOCK_DECAY), rtol=1e-3)


@pytest.mark.parametrize("torques", [smooth_torques, full_torques])
@pytest.mark.parametrize("env_id", [OBSTACLE, PUSH])
def test_bodies_overlap_at_most_in_the_instant_of_impact(env_id: str, torques) -> None:
    env, _ = arms(env_id, n=100)
    states = env.rollout(torques(100))
    overlap = np.maximum(
        -closest_gap(states, env_id), np.abs(states[..., 6:8]).max(axis=-1) - (WALL - BLOCK_RADIUS)
    )
    assert np.mean(overlap > 1e-3) < (1e-3 if torques is smooth_torques else 1e-2)
    assert overlap.max() < BLOCK_RADIUS  # never past the middle: nothing passes through anything


@pytest.mark.parametrize("env_id", PYMUNK_IDS)
def test_the_same_numbers_whatever_the_chunking_and_the_number_of_arms(env_id: str) -> None:
    env, start = arms(env_id, n=12)
    actions = smooth_torques(12, rms=0.15)
    whole = env.rollout(actions)
    again, _ = arms(env_id, n=12)
    np.testing.assert_array_equal(again.rollout(actions), whole)
    env.reset(seed=0)
    parts = [env.rollout(part) for part in np.split(actions, [1, 7, 60], axis=1)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)
    few, few_start = arms(env_id, n=5)
    np.testing.assert_array_equal(few_start, start[:5])
    np.testing.assert_array_equal(few.rollout(actions[:5]), whole[:5])
    single = gymnasium.make(env_id)
    single.reset(seed=0)
    np.testing.assert_array_equal([single.step(action)[0] for action in actions[0]], whole[0])


def test_an_episode_goes_on_past_its_time_limit_as_if_there_were_none() -> None:
    actions = smooth_torques(5, 150)
    env, _ = arms(PUSH, n=5)
    whole = env.rollout(actions)
    env.reset(seed=0)
    parts = [env.rollout(part) for part in np.split(actions, [100, 101, 120], axis=1)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        (0, 1e300),
        (1, 1e300),
        (2, 1e11),
        (2, 1e200),
        (3, 1e308),
        (6, 5.0),
        (7, 1e300),
        (8, 1e5),
        (9, 1e300),
    ],
)
def test_a_blow_up_raises_at_its_own_step(column: int, value: float) -> None:
    env, states = arms(PUSH, n=3)
    states[1, column] = value
    with np.errstate(all="ignore"), pytest.raises(SimulationUnstable) as caught:
        env.reset(options={"states": states})
        env.rollout(np.zeros((3, 5, 2)))
    assert (caught.value.env, caught.value.episode, caught.value.step) == (PUSH, 1, 0)


def test_after_a_fault_the_sound_part_of_the_episode_can_be_continued() -> None:
    env, _ = arms(PUSH, n=2)
    actions = smooth_torques(2, 20)
    whole = env.rollout(actions)
    env.reset(seed=0)
    env.rollout(actions[:, :10])
    env._live[0].link1.angular_velocity = float("nan")
    with pytest.raises(SimulationUnstable, match="episode 0 at step 10"):
        env.rollout(actions[:, 10:])
    np.testing.assert_array_equal(env.rollout(actions[:, 10:]), whole[:, 10:])


def test_nothing_escapes_under_full_random_torque() -> None:
    env, _ = arms(PUSH, n=100)
    states = env.rollout(full_torques(100, 150, seed=1))
    assert np.isfinite(states).all()
    assert np.abs(states[..., 6:8]).max() < WALL - BLOCK_RADIUS / 2
    assert np.abs(states[..., 1]).max() < ELBOW_LIMIT + 0.2


def test_a_pushed_object_moves_ahead_of_the_arm() -> None:
    env, _ = arms(PUSH, n=1)
    env.reset(options={"states": at_rest((0.0, 0.0), (0.18, 0.06))})
    states = env.rollout(np.tile([0.05, 0.0], (1, 40, 1)))
    assert states[0, -1, 7] > 0.1
