"""Noise and delay do what they say to the signals, and nothing to the world."""

import itertools
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tsmlib.envs import imperfect
from tsmlib.envs.wrappers import ImperfectArms, imperfect_arms

ENV = "tsm/PymunkPush-v1"
SCALE = np.array([3.0, 2.0, 8.0, 6.0, 0.2, 0.2, 0.25, 0.25, 1.0, 1.0])
STEPS = 60


@pytest.mark.parametrize("seed", [0, 7])
def test_noise_of_many_arms_shares_no_random_numbers_with_starts(seed: int) -> None:
    arms = imperfect_arms(2, "tsm/Reacher-v0", noise=0.25, delay=0)
    noisy, info = arms.reset(seed=seed)
    drawn = (noisy - info["state"]) / (arms.sigma * arms.scale)
    for resets, number in itertools.product(range(4), range(2)):
        begun = np.random.default_rng((seed, resets, number)).standard_normal(drawn.shape[1])
        assert np.abs(drawn - begun).max(1).min() > 0.1


@pytest.mark.parametrize("how", [{"noise": 0.25}, {"delay": 3}])
def test_gymnasium_finds_no_fault_with_an_imperfect_arm(how: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(
            "ignore", message=".*Box observation space (minimum|maximum) value is.*"
        )
        check_env(gymnasium.make(imperfect(ENV, **how)).unwrapped, skip_render_check=True)


# Many arms at once --------------------------------------------------------------------------------

N, TAU = 3, 5
bulk = pytest.mark.parametrize("env_id", ["tsm/ReacherPush-v1", ENV])


def many(env_id: str = ENV, n: int = N, *, sigma: float = 0.0, tau: int = 0) -> ImperfectArms:
    return ImperfectArms(gymnasium.make_vec(env_id, num_envs=n), sigma=sigma, scale=SCALE, tau=tau)


def torques(n: int = N) -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.3, 0.3, (9, STEPS, 2))[:n]


def shifted(actions: np.ndarray, tau: int) -> np.ndarray:
    return np.concatenate([np.zeros((len(actions), tau, 2)), actions], axis=1)[:, :STEPS]


def plain(env_id: str, actions: np.ndarray) -> np.ndarray:
    """True states (N, T + 1, dx) of arms that nothing is wrong with, under ``actions``."""
    env: Any = gymnasium.make_vec(env_id, num_envs=len(actions))
    start, _ = env.reset(seed=7)
    return np.concatenate([start[:, None], env.rollout(actions)], axis=1)


def at_once(env: ImperfectArms, actions: np.ndarray) -> np.ndarray:
    start, _ = env.reset(seed=7)
    return np.concatenate([start[:, None], env.rollout(actions)], axis=1)


def in_pieces(env: ImperfectArms, actions: np.ndarray) -> np.ndarray:
    """Pieces shorter and longer than the delay, and an empty one."""
    start, _ = env.reset(seed=7)
    parts = [
        env.rollout(actions[:, a:b])
        for a, b in ((0, 1), (1, 1), (1, 4), (4, 9), (9, 40), (40, STEPS))
    ]
    return np.concatenate([start[:, None], *parts], axis=1)


def step_by_step(env: ImperfectArms, actions: np.ndarray) -> np.ndarray:
    seen = [env.reset(seed=7)[0], *(env.step(one)[0] for one in actions.swapaxes(0, 1))]
    return np.stack(seen, axis=1)


@bulk
@pytest.mark.parametrize("tau", [0, 1, TAU])
@pytest.mark.parametrize("played", [at_once, in_pieces, step_by_step])
def test_in_bulk_a_delay_shifts_the_actions_by_exactly_tau_steps(
    played: Any, tau: int, env_id: str
) -> None:
    env = many(env_id, tau=tau)
    expected = plain(env_id, shifted(torques(), tau))
    np.testing.assert_array_equal(played(env, torques()), expected)
    np.testing.assert_array_equal(env.truth, expected)


@bulk
@pytest.mark.parametrize("played", [in_pieces, step_by_step])
def test_noise_is_the_same_however_an_episode_is_cut(played: Any, env_id: str) -> None:
    env, other = many(env_id, sigma=0.25, tau=TAU), many(env_id, sigma=0.25, tau=TAU)
    np.testing.assert_array_equal(played(env, torques()), at_once(other, torques()))


@bulk
def test_the_truth_behind_noise_is_what_plain_arms_do(env_id: str) -> None:
    env = many(env_id, sigma=0.25, tau=TAU)
    seen = at_once(env, torques())
    truth = plain(env_id, shifted(torques(), TAU))
    np.testing.assert_array_equal(env.truth, truth)
    assert (seen != truth).all()
    _, info = env.reset(seed=7)
    np.testing.assert_array_equal(info["state"], truth[:, 0])
    for step in range(10):
        np.testing.assert_array_equal(env.step(torques()[:, step])[4]["state"], truth[:, step + 1])


def test_in_bulk_too_noise_has_mean_zero_and_the_given_size_in_every_dimension() -> None:
    env = many(n=9, sigma=0.25)
    error = (at_once(env, torques(9)) - env.truth) / (0.25 * SCALE)  # (9, T + 1, 10)
    n = error[..., 0].size
    assert np.abs(error.mean((0, 1))).max() < 3 / np.sqrt(n)
    assert np.abs(error.std((0, 1)) - 1).max() < 3 / np.sqrt(2 * n)
    for one, other in (
        (error[1:], error[:-1]),
        (error[:, 1:], error[:, :-1]),
        (error[..., 1:], error[..., :-1]),
    ):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 3 / np.sqrt(
            one.size
        )  # one draw for each number


def test_the_noise_of_an_episode_does_not_depend_on_how_many_there_are() -> None:
    np.testing.assert_array_equal(
        at_once(many(n=2, sigma=0.25), torques(2)), at_once(many(n=9, sigma=0.25), torques(9))[:2]
    )


def test_a_reset_forgets_torques_and_states_and_draws_other_noise() -> None:
    env = many(sigma=0.25, tau=TAU)
    first = at_once(env, torques())
    np.testing.assert_array_equal(at_once(env, torques()), first)
    assert env.truth.shape == (N, STEPS + 1, 10)
    again, info = env.reset(options={"states": env.truth[:, 0]})
    np.testing.assert_array_equal(info["state"], env.truth[:, 0])
    assert env.truth.shape == (N, 1, 10)
    assert (again != first[:, 0]).all()


def test_torques_that_cannot_be_simulated_are_refused_when_they_are_sent() -> None:
    env = many(tau=TAU)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.rollout(torques())
    env.reset(seed=7)
    bad = torques()
    bad[1, STEPS - 2, 0] = np.nan
    with pytest.raises(
        ValueError, match=f"episode 1, step {STEPS - 2}, joint 0: nan. Nothing was simulated"
    ):
        env.rollout(bad)
    with pytest.raises(
        ValueError, match=rf"actions are \(2, {STEPS}, 2\); {ENV} expected \(N=3, T, 2\)"
    ):
        env.rollout(torques(2))
    with pytest.raises(ValueError, match=r"expected \(N=3, T, 2\)"):
        env.step(torques()[:2, 0])
    np.testing.assert_array_equal(
        env.rollout(torques()), plain(ENV, shifted(torques(), TAU))[:, 1:]
    )
