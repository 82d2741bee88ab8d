"""What must hold in the MuJoCo world, whatever the torques."""

import os
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from tsmlib.envs.geometry import (
    ARM_RADIUS,
    BLOCK_DECAY,
    BLOCK_RADIUS,
    DT,
    ELBOW_LIMIT,
    GEAR,
    LINK1_CAPSULE,
    LINK_LENGTHS,
    RESTITUTION,
    WALL,
    closest_gap,
    fingertip,
)
from tsmlib.envs.mujoco_arm import MujocoArm, load_model
from tsmlib.envs.spec import MUJOCO_IDS
from tsmlib.envs.unstable import SimulationUnstable

REACHER, OBSTACLE, PUSH = MUJOCO_IDS
DATA_RMS = 0.05  # rms of the torques that data are collected with
ROOM = WALL - BLOCK_RADIUS  # m; the block's centre stays within


def arms(env_id: str, n: int, seed: int | None = 0) -> tuple[MujocoArm, np.ndarray]:
    """n episodes at their start, and their states (n, dx)."""
    env = gymnasium.make_vec(env_id, num_envs=n).unwrapped
    assert isinstance(env, MujocoArm)
    return env, env.reset(seed=seed)[0]


def smooth_torques(n: int, rms: float, steps: int = 100, seed: int = 0) -> np.ndarray:
    """Actions (n, steps, 2) below about 2 Hz."""
    noise = np.random.default_rng(seed).standard_normal((n, steps + 40, 2))
    kernel = np.convolve(np.exp(-np.arange(20) / 4), np.exp(-np.arange(20) / 4))
    smooth = np.apply_along_axis(np.convolve, 1, noise, kernel, mode="same")[:, 20:-20]
    return np.clip(rms * smooth / np.linalg.norm(kernel), -1, 1)


def full_torques(n: int, steps: int = 100, seed: int = 0) -> np.ndarray:
    """Actions (n, steps, 2) of -1 or 1 that jump every tenth step; in a third of the episodes they
    never jump.
    """
    actions = np.repeat(
        np.random.default_rng(seed).choice([-1.0, 1.0], (n, steps // 10, 2)), 10, axis=1
    )
    actions[: n // 3] = actions[: n // 3, :1]
    return actions


def at_rest(
    q: tuple[float, float], block: tuple[float, float], velocity: tuple[float, float] = (0, 0)
) -> np.ndarray:
    """A state (1, 10)."""
    return np.array([[*q, 0.0, 0.0, *fingertip(np.array(q)), *block, *velocity]])


def longest_runs(where: np.ndarray) -> np.ndarray:
    """The longest run of true steps in each row of (n, T)."""
    run = longest = np.zeros(len(where), int)
    for column in where.T:
        run = np.where(column, run + 1, 0)
        longest = np.maximum(longest, run)
    return longest


def depth(states: np.ndarray, env_id: str) -> np.ndarray:
    """How deep the block is in the arm or in a wall, in metres (...)."""
    into_arm = -closest_gap(states, env_id)
    into_wall = np.abs(states[..., 6:8]).max(axis=-1) - ROOM
    return np.maximum(into_arm, into_wall) if env_id == PUSH else into_arm


def test_the_basic_arm_is_gymnasiums_reacher() -> None:
    env, start = arms(REACHER, 5)
    actions = np.random.default_rng(1).uniform(-1, 1, (5, 50, 2))
    states = env.rollout(actions)
    reacher = gymnasium.make("Reacher-v5").unwrapped
    for episode in range(5):
        reacher.reset()
        target = env.target[episode]
        reacher.set_state(np.r_[start[episode, :2], target], np.r_[start[episode, 2:4], 0, 0])
        for step, action in enumerate(actions[episode]):
            reacher.step(action)
            theirs = np.r_[reacher.data.qpos[:2], reacher.data.qvel[:2]]
            np.testing.assert_allclose(states[episode, step, :4], theirs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("env_id", MUJOCO_IDS)
def test_the_geometry_is_that_of_the_model(env_id: str) -> None:
    model = load_model(env_id)
    assert model.opt.timestep * round(DT / model.opt.timestep) == pytest.approx(DT)
    assert model.body("body1").pos[0] == LINK_LENGTHS[0]
    assert model.body("fingertip").pos[0] == LINK_LENGTHS[1]
    assert 2 * model.geom("link1").size[1] == pytest.approx(LINK1_CAPSULE)
    assert {model.geom(name).size[0] for name in ("link0", "link1", "fingertip")} == {ARM_RADIUS}
    assert model.joint("joint1").range[1] == ELBOW_LIMIT
    assert set(model.actuator_gear[:, 0]) == {GEAR}
    data = mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(-3, 3, (20, 2)):
        data.qpos[:2] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.body("fingertip").xpos[:2], fingertip(q), atol=1e-12)


@pytest.mark.parametrize("env_id", [OBSTACLE, PUSH])
def test_the_closest_gap_is_the_distance_that_mujoco_measures(env_id: str) -> None:
    env, states = arms(env_id, 50)
    states[:, :2] = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    model, data = env.model, mujoco.MjData(env.model)
    for state, gap in zip(states, closest_gap(states, env_id), strict=True):
        data.qpos[:2] = state[:2]
        if env_id == PUSH:
            data.qpos[2:] = state[6:8]
        else:
            data.mocap_pos[0, :2] = state[6:8]
        mujoco.mj_kinematics(model, data)
        links = [model.geom(name).id for name in ("link0", "link1", "fingertip")]
        distance = min(
            mujoco.mj_geomDistance(model, data, link, model.geom("block").id, 1.0, None)
            for link in links
        )
        assert gap == pytest.approx(distance, abs=1e-9)


def test_an_untouched_object_does_not_move() -> None:
    env, start = arms(PUSH, 200)
    states = env.rollout(smooth_torques(200, DATA_RMS))
    untouched = (closest_gap(states, PUSH) > 0.02).all(
        axis=1
    )  # further away than the arm moves in a step
    assert untouched.sum() > 40
    np.testing.assert_array_equal(
        states[untouched, :, 6:], np.repeat(start[untouched, None, 6:], 100, axis=1)
    )


def test_an_obstacle_never_moves_and_stops_the_arm() -> None:
    env, start = arms(OBSTACLE, 100)
    states = env.rollout(full_torques(100))
    np.testing.assert_array_equal(states[..., 6:], np.repeat(start[:, None, 6:], 100, axis=1))
    press = np.tile([[[0.1, 0.0]], [[1.0, 0.0]]], (1, 100, 1))
    env, _ = arms(OBSTACLE, 2)
    env.reset(options={"states": np.repeat(at_rest((1.0, 0.0), (0.0, 0.1)), 2, axis=0)})
    states = env.rollout(press)
    assert (states[:, -1, 0] < np.pi / 2).all()  # it would have turned several times
    assert np.abs(states[:, -20:, 2]).max() < 0.05
    assert (
        np.abs(closest_gap(states[:, -20:], OBSTACLE)).max() < 1e-4
    )  # even 200 N m do not press it in


def test_the_object_bounces_off_the_walls_and_slows_down() -> None:
    for block, velocity in (
        ((0.2, 0.1), (1.5, 0.0)),
        ((0.1, -0.2), (0.0, -1.5)),
        ((-0.2, 0.1), (-1.5, 0)),
    ):
        env, _ = arms(PUSH, 1)
        env.reset(options={"states": at_rest((1.0, 2.0), block, velocity)})
        states = env.rollout(np.zeros((1, 100, 2)))[0]
        axis = int(np.argmax(np.abs(velocity)))
        position, speed = np.abs(states[:, 6 + axis]), states[:, 8 + axis] / velocity[axis]
        assert (closest_gap(states, PUSH) > 0.01).all()
        hit = (
            1.5 - (ROOM - abs(block[axis])) / BLOCK_DECAY
        )  # m/s; a free object loses its travel / decay time
        step = 3  # the bounce is over
        left = (
            1.5 * -speed[step] * np.exp((step + 1) * DT / BLOCK_DECAY) * np.exp(-np.log(1.5 / hit))
        )
        assert RESTITUTION - 0.05 < left / hit < RESTITUTION + 0.15
        assert position.max() < ROOM + 3e-3
        assert np.abs(speed[-1]) < 1e-3
        ratio = speed[step + 10] / speed[step + 5]
        assert ratio == pytest.approx(
            np.exp(-5 * DT / BLOCK_DECAY), rel=0.03
        )  # implicit steps: 1.2 % slower


@pytest.mark.parametrize("env_id", [OBSTACLE, PUSH])
def test_nothing_penetrates_except_in_the_instant_of_impact(env_id: str) -> None:
    """Deeper than 1 mm for no two steps in a row, and even the deepest impact of collected data
    stays below 3 mm.
    """
    env, _ = arms(env_id, 300)
    deep = depth(env.rollout(smooth_torques(300, DATA_RMS)), env_id)
    assert longest_runs(deep > 1e-3).max() <= 1
    assert deep.max() < 3e-3
    assert (deep > 1e-3).mean() < 1e-3


@pytest.mark.parametrize("env_id", [OBSTACLE, PUSH])
def test_nothing_tunnels_or_escapes_at_full_torque(env_id: str) -> None:
    env, _ = arms(env_id, 300)
    states = env.rollout(full_torques(300))
    assert -closest_gap(states, env_id).min() < BLOCK_RADIUS + ARM_RADIUS  # the centres never cross
    assert (
        np.abs(states[..., 6:8]).max() < WALL + 2 * BLOCK_RADIUS
    )  # hit that hard, it dents a wall for an instant
    assert longest_runs(depth(states, env_id) > 5e-3).max() <= 3
    assert (
        np.abs(states[..., 2:4]).max() < GEAR
    )  # no contact adds speed: torque over damping is the limit


def test_a_free_object_slows_down_by_e_in_its_decay_time() -> None:
    env, _ = arms(PUSH, 1)
    env.reset(options={"states": at_rest((0.0, 0.0), (-0.1, 0.0), (0.0, 0.3))})
    speed = env.rollout(np.zeros((1, 10, 2)))[0, :, 9]
    np.testing.assert_allclose(
        speed, 0.3 * np.exp(-DT * np.arange(1, 11) / BLOCK_DECAY), rtol=0.06
    )  # implicit steps
    decay = -DT * 9 / np.log(speed[-1] / speed[0])
    assert decay == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize("env_id", MUJOCO_IDS)
def test_energy_does_not_grow_without_torque(env_id: str) -> None:
    env, start = arms(env_id, 150)
    rng = np.random.default_rng(0)
    start[:, :4] = np.concatenate(
        [rng.uniform(-2.5, 2.5, (150, 2)), rng.uniform(-10, 10, (150, 2))], axis=1
    )
    if env_id != REACHER:
        start = start[closest_gap(start, env_id) > 0]  # the others begin inside the block
        env, _ = arms(env_id, len(start))
    env.reset(options={"states": start})
    states = np.concatenate([start[:, None], env.rollout(np.zeros((len(start), 200, 2)))], axis=1)
    energy = 0.5 * (states[..., 2:4] ** 2).sum(
        axis=-1
    )  # 1 kg m^2 in each joint; the links add a thousandth
    if env_id == PUSH:
        energy += 0.5 * (states[..., 8:] ** 2).sum(axis=-1)
    assert (energy <= 1.001 * energy[:, :1]).all()
    assert (energy[:, -1] < 1e-3 * energy[:, 0]).all()


@pytest.mark.parametrize("env_id", MUJOCO_IDS)
@pytest.mark.parametrize("value", [1e11, np.nan])
def test_a_blow_up_is_raised_with_episode_and_step(
    env_id: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    env, _ = arms(env_id, 300)
    env.rollout(np.zeros((300, 3, 2)))
    env._physics[277, 1 + env.model.nq] = value  # the shoulder's velocity, as if by itself
    with pytest.raises(SimulationUnstable) as caught:
        env.rollout(np.zeros((300, 4, 2)))
    assert (caught.value.env, caught.value.episode, caught.value.step) == (
        env_id,
        277,
        3,
    )  # steps since reset
    assert "QVEL" in caught.value.reason
    assert not os.listdir(tmp_path)  # MuJoCo would leave a log file here


def test_threads_change_nothing_but_time() -> None:
    actions = smooth_torques(40, 0.1)
    results = []
    for threads in (1, 3):
        env = gymnasium.make_vec(PUSH, num_envs=40, threads=threads)
        env.reset(seed=0)
        results.append(env.unwrapped.rollout(actions))
        env.close()
    np.testing.assert_array_equal(*results)


def test_random_torques_push_the_object_no_deeper_than_a_centimetre_into_a_wall() -> None:
    env, _ = arms(PUSH, 300)
    states = env.rollout(smooth_torques(300, 0.1))
    room = WALL - BLOCK_RADIUS
    assert room - 0.002 < np.abs(states[..., 6:8]).max() < room + 0.01  # walls are met
