"""The physics of pushing commute with the symmetries by which its training data are multiplied."""

import gymnasium
import numpy as np
import pytest
import torch

from reproduction.symmetry import COPIES, mirrored, symmetric, turned
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.trajectory import Trajectories


def random_data(env_id: str, n: int, seed: int, horizon: int) -> Trajectories:
    torques = smooth_torques(n, horizon, generator=torch.Generator().manual_seed(seed))
    env = gymnasium.make_vec(env_id, num_envs=n)
    return collect(env, open_loop(torques), horizon=horizon, seed=seed)


PUSH = ("tsm/ReacherPush-v1", "tsm/PymunkPush-v1")


@pytest.mark.parametrize("env_id", PUSH)
def test_what_a_turned_or_mirrored_arm_does_is_the_turned_or_mirrored_episode(env_id: str) -> None:
    data = random_data(env_id, 24, seed=3, horizon=60)
    copies = symmetric(data)
    assert len(copies) == COPIES * len(data)
    arms = gymnasium.make_vec(env_id, num_envs=len(copies))
    arms.reset(seed=0, options={"states": copies.states[:, 0].astype(float)})
    found = arms.unwrapped.rollout(copies.actions)
    moved = np.abs(data.states[:, -1, 6:8] - data.states[:, 0, 6:8]).max(-1) > 0.01
    assert moved.sum() >= 6  # contacts are among them
    off = np.abs(found - copies.states[:, 1:])[..., [0, 1, 4, 5, 6, 7]].max((1, 2))
    assert (
        np.quantile(off, 0.9) < 1e-3
    )  # m or rad; from rounded starts, and a collision multiplies what is off
    assert np.median(off) < 1e-4


def test_turning_four_times_and_mirroring_twice_change_nothing() -> None:
    states = np.random.default_rng(0).normal(size=(5, 7, 10))
    actions = np.random.default_rng(1).normal(size=(5, 7, 2))
    twice = mirrored(*mirrored(states, actions))
    np.testing.assert_array_equal(twice[0], states)
    np.testing.assert_array_equal(twice[1], actions)
    around = turned(turned(turned(turned(states, 1), 1), 1), 1)
    a_whole_turn = np.broadcast_to(2 * np.pi * np.eye(10)[0], states.shape)  # of the shoulder
    np.testing.assert_allclose(around - states, a_whole_turn, atol=1e-12)


def test_data_of_arms_that_begin_along_x_stay_as_they_are() -> None:
    data = random_data("tsm/ReacherObstacle-v0", 3, seed=0, horizon=10)
    assert symmetric(data) is data
