"""What holds for all six environments, in both simulators."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tsmlib.envs.arm import ArmVectorEnv
from tsmlib.envs.geometry import (
    BLOCK_CLEARANCE,
    BLOCK_RING,
    DT,
    START_ANGLES,
    TARGET_RING,
    closest_gap,
    fingertip,
)
from tsmlib.envs.spec import ENV_IDS, EnvSpec

WITH_BLOCK = [env_id for env_id in ENV_IDS if not env_id.endswith("Reacher-v0")]
N, T = 12, 60

pytestmark = pytest.mark.parametrize("env_id", ENV_IDS)


def arms(env_id: str, n: int = N, **kwargs: Any) -> ArmVectorEnv:
    """n episodes."""
    env = gymnasium.make_vec(env_id, num_envs=n, **kwargs).unwrapped
    assert isinstance(env, ArmVectorEnv)
    return env


def torques(n: int = N, steps: int = T, seed: int = 0) -> np.ndarray:
    """Actions (n, steps, 2) that are held for five steps, strong enough to hit things."""
    return np.repeat(np.random.default_rng(seed).uniform(-0.3, 0.3, (n, steps // 5, 2)), 5, axis=1)


def test_gymnasium_finds_no_fault(env_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(
            "ignore", message=".*Box observation space (minimum|maximum) value is.*"
        )
        warnings.filterwarnings("ignore", message=".*MuJoCo cannot render here.*")
        check_env(gymnasium.make(env_id, render_mode="rgb_array").unwrapped)


def test_the_state_is_laid_out_as_its_names_say(env_id: str) -> None:
    env = arms(env_id)
    states, info = env.reset(seed=0)
    assert states.shape == (N, len(env.names)) == (N, len(env.units))
    assert len(env.names) == (10 if env_id in WITH_BLOCK else 6)
    assert info["target"].shape == (N, 2)
    assert np.linalg.norm(info["target"], axis=1).max() <= 0.2
    states = env.rollout(torques())
    np.testing.assert_allclose(states[..., 4:6], fingertip(states[..., :2]), atol=1e-12)


def test_the_block_starts_within_reach_and_clear_of_the_arm(env_id: str) -> None:
    states, _ = arms(env_id, 300).reset(seed=0)
    if env_id not in WITH_BLOCK:
        with pytest.raises(ValueError, match="no block"):
            closest_gap(states, env_id)
        return
    distance = np.linalg.norm(states[:, 6:8], axis=1)
    inner, outer = BLOCK_RING
    assert inner <= distance.min() < inner + 0.01 < outer - 0.01 < distance.max() <= outer
    assert closest_gap(states, env_id).min() > BLOCK_CLEARANCE
    np.testing.assert_array_equal(states[:, 8:], 0)


def test_arms_begin_stretched_out_along_x_but_in_every_direction_where_they_push(
    env_id: str,
) -> None:
    angles = arms(env_id, 300).reset(seed=0)[0][:, :2]
    for joint, most in zip(angles.T, START_ANGLES[EnvSpec.parse(env_id).task], strict=True):
        assert 0.95 * most < np.abs(joint).max() <= most
        assert (
            np.abs(np.histogram(joint, 6, (-most, most))[0] - 50).max() < 25
        )  # uniform: 50 each, give or take 6.5


def test_targets_lie_in_the_tasks_ring_uniformly_over_its_area(env_id: str) -> None:
    inner, outer = TARGET_RING[EnvSpec.parse(env_id).task]
    distance = np.linalg.norm(arms(env_id, 300).reset(seed=1)[1]["target"], axis=1)
    assert inner <= distance.min() <= distance.max() <= outer
    assert 0.4 < (distance < np.sqrt((inner**2 + outer**2) / 2)).mean() < 0.6
    given = arms(env_id, 300)
    _, info = given.reset(seed=1, options={"states": given.reset(seed=0)[0]})
    assert np.linalg.norm(info["target"], axis=1).min() >= inner


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(env_id: str) -> None:
    env = arms(env_id)
    first = env.reset(seed=7)[0], env.rollout(torques())
    again = env.reset()[0]
    assert not np.array_equal(first[0], again)
    same = env.reset(seed=7)[0], env.rollout(torques())
    for a, b in zip(first, same, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[0], env.reset(seed=8)[0])


def test_one_arm_and_many_agree_bit_for_bit(env_id: str) -> None:
    many, one = arms(env_id), gymnasium.make(env_id)
    start, info = many.reset(seed=2)
    states = many.rollout(torques())
    for episode in (0, N - 1):
        one.reset(options={"states": start[episode], "target": info["target"][episode]})
        stepped = np.stack([one.step(action)[0] for action in torques()[episode]])
        np.testing.assert_array_equal(stepped, states[episode])


def test_a_rollout_can_be_cut_anywhere(env_id: str) -> None:
    env = arms(env_id)
    env.reset(seed=3)
    whole = env.rollout(torques())
    env.reset(seed=3)
    parts = [env.rollout(torques()[:, a:b]) for a, b in ((0, 1), (1, 1), (1, 24), (24, T))]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)


def test_the_reward_is_distance_and_torque_after_the_step(env_id: str) -> None:
    env = arms(env_id)
    env.reset(seed=6, options={"target": np.array([0.1, 0.05])})
    actions = np.full((N, 2), 2.0)
    states, reward, terminated, truncated, _ = env.step(actions)
    moved = states[:, 6:8] if env_id.endswith("Push-v1") else states[:, 4:6]
    np.testing.assert_allclose(reward, -np.linalg.norm(moved - [0.1, 0.05], axis=1) - 2.0)
    assert not terminated.any()
    assert not truncated.any()
    env.rollout(np.zeros((N, 98, 2)))
    assert env.step(actions)[3].all()


def test_velocity_is_the_rate_of_change_of_the_angle(env_id: str) -> None:
    env = arms(env_id)
    start, _ = env.reset(seed=0)
    states = np.concatenate([start[:, None], env.rollout(np.full((N, 10, 2), 0.002))], axis=1)
    mean = (states[:, 1:, 2:4] + states[:, :-1, 2:4]) / 2
    np.testing.assert_allclose(np.diff(states[..., :2], axis=1) / DT, mean, atol=1e-2)


def test_bad_input_is_refused_by_name(env_id: str) -> None:
    env = arms(env_id)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.rollout(torques())
    start, _ = env.reset(seed=0)
    actions = torques()
    actions[3, 17, 1] = np.nan
    expected = env.rollout(torques())
    env.reset(options={"states": start})
    with pytest.raises(ValueError, match="episode 3, step 17"):
        env.rollout(actions)
    np.testing.assert_array_equal(
        env.rollout(torques()), expected
    )  # nothing was simulated in between
    with pytest.raises(ValueError, match=r"expected \(N=12, T, 2\)"):
        env.rollout(torques()[:5])
    with pytest.raises(ValueError, match="'states'.*expected"):
        env.reset(options={"states": start[:, :4]})
    start[2, 0] = np.inf
    with pytest.raises(ValueError, match="not finite in episode 2"):
        env.reset(options={"states": start})
    with pytest.raises(ValueError, match="unknown reset options"):
        env.reset(options={"state": start})
    with pytest.raises(ValueError, match="num_envs"):
        arms(env_id, 0)


def test_an_image_shows_the_scene(env_id: str) -> None:
    env = gymnasium.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(20):
        env.step(np.array([0.2, 0.2]))
    after = env.render()
    assert before.dtype == np.uint8
    assert before.shape == after.shape
    assert before.shape[2] == 3
    assert (before != after).any()
    env.close()
