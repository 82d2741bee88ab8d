"""Arms with noisy sensors or delayed actions have names of their own, and are no other arms."""

from __future__ import annotations

import itertools
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs import imperfect
from tsmlib.envs.geometry import HALF_RANGE
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE, EnvSpec
from tsmlib.envs.stepping import UnsupportedEnvironment
from tsmlib.planning.predictors import simulator_predictor
from tsmlib.storage.artifacts import load_trajectories, save_trajectories
from tsmlib.trajectory import Trajectories, TrajectoryError

REACHER, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_name_says_what_is_imperfect_and_nothing_else(env_id: str) -> None:
    names = set()
    for noise, delay in itertools.product(
        [0.0, 0.0001, 0.1, NOISE, 1.0, 9.8765, 10.0], [0, 1, DELAY, 100]
    ):
        name = imperfect(env_id, noise=noise, delay=delay)
        found = EnvSpec.parse(name)
        assert (found.id, found.arm.id, found.noise, found.delay) == (name, env_id, noise, delay)
        names.add(name)
    assert len(names) == 28
    assert imperfect(env_id) == env_id
    assert imperfect(env_id, noise=0.25, delay=5) == env_id.replace("-v", "-noise0.25-delay5-v")


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_one_arm_and_many_are_made_by_name(env_id: str) -> None:
    name = imperfect(env_id, noise=NOISE, delay=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one, many = gymnasium.make(name), gymnasium.make_vec(name, num_envs=2)
    assert one.spec is not None
    assert many.unwrapped.spec is not None
    assert one.spec.id == many.unwrapped.spec.id == name
    for env, state, push in (
        (one, ..., np.ones(2, np.float32)),
        (many, 0, np.ones((2, 2), np.float32)),
    ):
        env.reset(seed=1)
        moved: list[Any] = []
        for _ in range(4):
            seen, _, _, _, info = env.step(push)
            assert (seen != info["state"])[..., :8].all()
            moved.append(info["state"][state][2:4])
        assert (
            abs(moved[0]).max() < 1 < abs(moved[3]).max()
        )  # rad/s: full torque arrives with the third step
    for _ in range(96):
        _, _, _, late, _ = one.step(np.zeros(2, np.float32))
    assert late
    one.close()
    many.close()


@pytest.mark.parametrize("noise", [-0.1, float("nan"), float("inf"), 10.5, 0.00001])
def test_a_noise_that_makes_no_sense_is_refused(noise: float) -> None:
    with pytest.raises(
        ValueError, match=rf"noise is {noise}.*expected a sigma from 0 to 10 with at most four"
    ):
        imperfect(REACHER, noise=noise)


@pytest.mark.parametrize("delay", [-1, 1.5, 101, True, "5"])
def test_a_delay_that_makes_no_sense_is_refused(delay: Any) -> None:
    with pytest.raises(
        ValueError, match=rf"delay is {delay}; expected .*whole number of steps from 0 to 100"
    ):
        imperfect(REACHER, delay=delay)


def test_only_a_plain_arm_is_made_imperfect() -> None:
    for env_id in ("tsm/Nothing-v0", imperfect(REACHER, noise=NOISE), ""):
        with pytest.raises(
            ValueError, match=rf"'{env_id}' is none of tsm/Reacher-v0.*added to one of these"
        ):
            imperfect(env_id, delay=DELAY)


@pytest.mark.parametrize("env_id", [REACHER, PUSH])
def test_half_ranges_are_those_of_random_data(env_id: str) -> None:
    torques = smooth_torques(500, 100, generator=torch.Generator().manual_seed(4))
    env = gymnasium.make_vec(env_id, num_envs=500)
    states = collect(env, open_loop(torques), horizon=100, seed=4).states
    share = (states.max((0, 1)) - states.min((0, 1)))[2:] / (
        2 * np.array(HALF_RANGE[2 : states.shape[-1]])
    )
    assert np.abs(share[:6] - 1).max() < 0.25
    assert (
        (share[6:] > 0.5) & (share[6:] < 1.25)
    ).all()  # an object is rarely hit hard, in 5,000 episodes once


def test_an_obstacle_is_not_seen_to_move() -> None:
    env: Any = gymnasium.make_vec(imperfect("tsm/ReacherObstacle-v0", noise=0.5), num_envs=2)
    env.reset(seed=0)
    off = env.rollout(np.zeros((2, 5, 2))) - env.truth[:, 1:]
    assert not off[..., 8:].any()
    assert off[..., :8].all()


def test_noise_is_in_half_ranges() -> None:
    env: Any = gymnasium.make_vec(imperfect(PUSH, noise=0.5), num_envs=20)
    env.reset(seed=0)
    off = env.rollout(np.zeros((20, 50, 2))) - env.truth[:, 1:]
    np.testing.assert_allclose(
        off.std((0, 1)), 0.5 * np.array(HALF_RANGE), rtol=0.08
    )  # 3 standard errors are 0.067


def test_gymnasium_finds_the_arms_by_themselves_and_imports_a_simulator_when_one_is_made() -> None:
    program = """import sys, gymnasium, tsmlib.envs
assert not {"mujoco", "pymunk", "torch", "matplotlib"} & set(sys.modules)
gymnasium.make("tsm/PymunkPush-v1").reset()
assert "mujoco" not in sys.modules"""
    for text in (
        'import gymnasium; gymnasium.make("tsmlib.envs:tsm/ReacherPush-delay5-v1").reset()',
        program,
    ):
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", text], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("hidden", [{"noise": 0.25}, {"delay": 2}])
def test_the_true_simulator_of_an_arm_that_hides_its_state_is_no_predictor(
    hidden: dict[str, Any],
) -> None:
    with pytest.raises(
        UnsupportedEnvironment, match="the true simulator of tsm/Reacher-v0 can be asked"
    ):
        simulator_predictor(imperfect("tsm/Reacher-v0", **hidden))


def test_angles_behind_noise_may_jump_and_those_of_a_log_may_not(tmp_path: Path) -> None:
    env, rest = gymnasium.make_vec(imperfect(REACHER, noise=10.0), num_envs=2), torch.zeros(2, 9, 2)
    data = collect(env, open_loop(rest), horizon=9, seed=0)
    assert np.abs(np.diff(data.states[..., 0])).max() > np.pi
    save_trajectories(tmp_path / "noisy.safetensors", data.take([1, 0]).joined(data))
    assert load_trajectories(tmp_path / "noisy.safetensors").take([2, 3]) == data
    about = (data.names, data.units, data.angles)
    with pytest.raises(TrajectoryError, match="'joint0' jumps by more than pi"):
        Trajectories(data.states, data.actions, "log", data.dt, *about)
