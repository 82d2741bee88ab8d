"""SensorNoise and ActionDelay do what they say to the signals, and nothing to the world."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tsmlib.envs.wrappers import ActionDelay, SensorNoise

ENV = "tsm/PymunkPush-v0"
SCALE = np.array([3.0, 2.0, 8.0, 6.0, 0.2, 0.2, 0.25, 0.25, 1.0, 1.0])
STEPS = 60


def episode(env: gymnasium.Env, actions: np.ndarray, seed: int = 7) -> tuple[np.ndarray, np.ndarray, list[dict]]:
    """States (T + 1, dx), rewards (T,) and infos (T + 1) of one episode."""
    state, info = env.reset(seed=seed)
    states, rewards, infos = [state], [], [info]
    for action in actions:
        state, reward, _, _, info = env.step(action)
        states.append(state)
        rewards.append(reward)
        infos.append(info)
    return np.stack(states), np.array(rewards), infos


@pytest.fixture
def actions() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.3, 0.3, (STEPS, 2)).astype(np.float32)


@pytest.mark.parametrize("tau", [0, 1, 5])
def test_a_delay_shifts_the_actions_by_exactly_tau_steps(actions: np.ndarray, tau: int) -> None:
    late_states, late_rewards, _ = episode(ActionDelay(gymnasium.make(ENV), tau), actions)
    shifted = np.concatenate([np.zeros((tau, 2), np.float32), actions])[:STEPS]
    states, rewards, _ = episode(gymnasium.make(ENV), shifted)
    np.testing.assert_array_equal(late_states, states)
    np.testing.assert_array_equal(late_rewards, rewards)


def test_a_reset_forgets_the_actions_still_on_the_way(actions: np.ndarray) -> None:
    env = ActionDelay(gymnasium.make(ENV), 4)
    first, _, _ = episode(env, actions)
    second, _, _ = episode(env, actions)
    np.testing.assert_array_equal(first, second)


def test_an_array_changed_after_it_was_sent_does_not_change_the_action() -> None:
    buffer = np.full(2, 0.3, np.float32)
    env = ActionDelay(gymnasium.make(ENV), 1)
    env.reset(seed=0)
    env.step(buffer)
    buffer[:] = -0.3
    state = env.step(buffer)[0]
    assert state[2] != 0
    base = gymnasium.make(ENV)
    base.reset(seed=0)
    base.step(np.zeros(2, np.float32))
    np.testing.assert_array_equal(state, base.step(np.full(2, 0.3, np.float32))[0])


def test_noise_does_not_alter_the_world(actions: np.ndarray) -> None:
    noisy_states, noisy_rewards, infos = episode(SensorNoise(gymnasium.make(ENV), 0.25, SCALE), actions)
    states, rewards, _ = episode(gymnasium.make(ENV), actions)
    np.testing.assert_array_equal([info["state"] for info in infos], states)
    np.testing.assert_array_equal(noisy_rewards, rewards)
    assert (noisy_states != states).all()


def test_noise_has_mean_zero_and_the_given_size() -> None:
    env = SensorNoise(gymnasium.make(ENV, max_episode_steps=10_000), 0.25, SCALE)
    noisy, _, infos = episode(env, np.zeros((1_500, 2), np.float32))
    error = ((noisy - [info["state"] for info in infos]) / (0.25 * SCALE)).ravel()
    n = error.size
    assert abs(error.mean()) < 3 / np.sqrt(n)
    assert abs(error.std() - 1) < 3 / np.sqrt(2 * n)
    assert abs(np.corrcoef(error[:-1], error[1:])[0, 1]) < 3 / np.sqrt(n)


def test_noise_repeats_with_the_seed_and_differs_between_episodes(actions: np.ndarray) -> None:
    env = SensorNoise(gymnasium.make(ENV), 0.25, SCALE)
    first, _, _ = episode(env, actions, seed=1)
    same, _, _ = episode(env, actions, seed=1)
    other, _, _ = episode(env, actions, seed=2)
    np.testing.assert_array_equal(first, same)
    assert (first != other).all()
    env.reset(seed=1)
    assert (env.reset()[0] != first[0]).any()


def test_no_noise_is_no_change(actions: np.ndarray) -> None:
    np.testing.assert_array_equal(
        episode(SensorNoise(gymnasium.make(ENV), 0.0, SCALE), actions)[0], episode(gymnasium.make(ENV), actions)[0]
    )


@pytest.mark.parametrize("wrap", [lambda env: SensorNoise(env, 0.25, SCALE), lambda env: ActionDelay(env, 3)])
def test_gymnasium_finds_no_fault_with_a_wrapped_environment(wrap) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Said of every wrapped environment, and of every unbounded one.
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is.*")
        check_env(wrap(gymnasium.make(ENV)), skip_render_check=True)


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda env: SensorNoise(env, -0.1, SCALE), "sigma is -0.1"),
        (lambda env: SensorNoise(env, float("nan"), SCALE), "sigma is nan"),
        (lambda env: SensorNoise(env, 0.1, SCALE[:6]), r"expected \(10,\)"),
        (lambda env: SensorNoise(env, 0.1, -SCALE), "at least 0"),
        (lambda env: ActionDelay(env, -1), "tau is -1"),
        (lambda env: ActionDelay(env, 1.5), "tau is 1.5"),
    ],
)
def test_a_senseless_wrapper_is_refused(wrap, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrap(gymnasium.make(ENV))
