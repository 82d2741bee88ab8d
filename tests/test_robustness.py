"""Errors are to the true state, filters do what textbooks say, and tables say what the rows say."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from reproduction.measures import filtering
from reproduction.measures.filtering import KalmanFilter, errors, rmse
from tsmlib.collection import collect_random
from tsmlib.envs import imperfect
from tsmlib.envs.geometry import HALF_RANGE, fingertip
from tsmlib.envs.spec import NOISE
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Trajectories

REACHER = "tsm/Reacher-v0"
NOISY, LATE = imperfect(REACHER, noise=NOISE), imperfect(REACHER, delay=5)
UNIT = np.array(HALF_RANGE[:6])
Pair = tuple[Trajectories, Trajectories]


def episodes(states: np.ndarray, actions: np.ndarray, env: str = REACHER) -> Trajectories:
    dims = states.shape[-1]
    return Trajectories(
        states.astype(np.float32),
        actions.astype(np.float32),
        env,
        0.02,
        [f"x{d}" for d in range(dims)],
        ("m",) * dims,
    )


def drawn(n: int, seed: int) -> Pair:
    """The same episodes with and without noise."""
    return collect_random(NOISY, n, seed=seed, rms=0.1), collect_random(
        REACHER, n, seed=seed, rms=0.1
    )


@pytest.fixture(scope="module")
def held_out() -> Pair:
    return drawn(20, seed=1)


@pytest.fixture(scope="module")
def test_data() -> Pair:
    return drawn(40, seed=2)


@pytest.fixture(scope="module")
def kalman() -> KalmanFilter:
    return KalmanFilter.fitted(collect_random(REACHER, 60, seed=0, rms=0.1), NOISE)


# Errors


def test_angles_are_compared_on_the_circle_and_nothing_else_is() -> None:
    clean = np.array([math.pi - 0.1, -3.0, 1.0, 2.0, 0.1, 0.2])
    found = errors(clean + np.array([0.3, 0.0, 2 * math.pi, 0.0, 0.0, 0.0]), clean)
    np.testing.assert_allclose(found * UNIT, [0.3, 0, 2 * math.pi, 0, 0, 0], atol=1e-12)
    turned = errors(
        np.array([-math.pi + 0.1, 3.1, 0, 0, 0, 0]),
        np.array([math.pi - 0.1, 3.1 - 6 * math.pi] + [0] * 4),
    )
    np.testing.assert_allclose(turned, [0.2, 0, 0, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("dims", [6, 10])
def test_errors_count_in_half_ranges(dims: int) -> None:
    clean = np.random.default_rng(0).normal(size=(2, 3, dims))
    off = 0.25 * np.array(HALF_RANGE[:dims])
    before = clean.copy()
    np.testing.assert_allclose(errors(clean + off, clean), 0.25)
    assert rmse(errors(clean - off, clean)) == pytest.approx(0.25)
    np.testing.assert_array_equal(clean, before)


def test_the_raw_observation_is_off_by_the_noise(test_data: Pair) -> None:
    noisy, clean = test_data
    assert rmse(errors(noisy.states, clean.states)) == pytest.approx(NOISE, rel=0.02)


# Words


# Past actions


# Kalman filter


def linear_arm(
    n: int = 4, steps: int = 30, noise: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, Trajectories]:
    """Episodes of s' = A [s, u, 1] + N(0, noise^2), without the kinematics of any arm, and that A
    (7, 4).
    """
    draw = np.random.default_rng(seed)
    transition = np.concatenate(
        [0.9 * np.linalg.qr(draw.normal(size=(4, 4)))[0], draw.normal(size=(3, 4))]
    )
    states, actions = np.zeros((n, steps + 1, 6)), draw.uniform(-1, 1, (n, steps, 2))
    states[:, 0, :4] = draw.normal(size=(n, 4))
    for t in range(steps):
        told = np.concatenate([states[:, t, :4], actions[:, t], np.ones((n, 1))], 1)
        states[:, t + 1, :4] = told @ transition + noise * draw.normal(size=(n, 4))
    return transition, episodes(states, actions)


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_without_a_fingertip_the_filter_is_the_textbooks(
    monkeypatch: pytest.MonkeyPatch, weight: float
) -> None:
    scale = np.array([1.0, 2.0, 3.0, 4.0])
    monkeypatch.setattr(
        filtering, "HALF_RANGE", (*scale, 1e5, 1e5)
    )  # of the fingertip nothing is learned
    transition, clean = linear_arm()
    spread = np.random.default_rng(1).normal(size=(4, 4))
    process, sigma = 0.1 * spread @ spread.T, 0.3
    noise = (
        sigma
        * np.array([*scale, 0.0, 0.0])
        * np.random.default_rng(2).normal(size=clean.states.shape)
    )
    noisy = episodes(clean.states + noise, clean.actions)
    found = KalmanFilter(transition, process, sigma, weight).means(noisy)

    a, b, c = transition[:4].T, transition[4:6].T, transition[6]
    seen = np.linalg.inv(np.diag((sigma * scale) ** 2))  # information of one observation
    for observed, actions, means in zip(
        noisy.states[..., :4].astype(float), noisy.actions, found, strict=True
    ):
        x, covariance = observed[0], np.linalg.inv(seen)
        for t, u in enumerate(actions):
            np.testing.assert_allclose(means[t], x, rtol=1e-5, atol=1e-5)
            x, covariance = a @ x + b @ u + c, a @ covariance @ a.T + weight * process
            prior = np.linalg.inv(covariance)
            covariance = np.linalg.inv(prior + seen)
            x = covariance @ (prior @ x + seen @ observed[t + 1])
        np.testing.assert_allclose(means[-1], x, rtol=1e-5, atol=1e-5)


def test_with_a_fingertip_the_filter_is_the_extended_one(
    kalman: KalmanFilter, test_data: Pair
) -> None:
    noisy = test_data[0].take(slice(2))
    kalman = dataclasses.replace(kalman, weight=3.0)
    found = kalman.means(noisy)

    def told(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, fingertip(x[:2])])

    noise = np.diag((NOISE * UNIT) ** 2)
    for observed, actions, means in zip(
        noisy.states.astype(float), noisy.actions, found, strict=True
    ):
        x, covariance = observed[0, :4], noise[:4, :4]
        for t, u in enumerate(actions):
            x = np.array([*x, *u, 1.0]) @ kalman.transition
            a = kalman.transition[:4].T
            covariance = a @ covariance @ a.T + 3.0 * kalman.process
            h = np.stack(
                [(told(x + 1e-6 * e) - told(x - 1e-6 * e)) / 2e-6 for e in np.eye(4)], 1
            )  # (6, 4)
            gain = np.linalg.solve(h @ covariance @ h.T + noise, h @ covariance).T
            x = x + gain @ (observed[t + 1] - told(x))
            kept = np.eye(4) - gain @ h
            covariance = kept @ covariance @ kept.T + gain @ noise @ gain.T  # Joseph's form
            np.testing.assert_allclose(means[t + 1], x, rtol=1e-6, atol=1e-6)


def test_dynamics_are_those_of_the_clean_episodes() -> None:
    transition, clean = linear_arm()
    found = KalmanFilter.fitted(clean, 0.3)
    np.testing.assert_allclose(found.transition, transition, atol=1e-5)
    assert np.abs(found.process).max() < 1e-10
    transition, clean = linear_arm(n=400, noise=0.2)
    found = KalmanFilter.fitted(clean, 0.3)
    np.testing.assert_allclose(found.transition, transition, atol=0.02)
    np.testing.assert_allclose(found.process, 0.04 * np.eye(4), atol=0.002)
    assert (found.sigma, found.weight) == (0.3, 1.0)


def test_a_filter_that_knows_everything_is_never_wrong_now_or_ahead() -> None:
    draw, dt = np.random.default_rng(0), 0.02
    actions, x = draw.uniform(-1, 1, (5, 100, 2)), draw.normal(size=(5, 4))
    a = np.array(
        [
            [1, 0, 0, 0],
            [0, 1, 0, 0],
            [dt, 0, 1, 0],
            [0, dt, 0, 1],
            [0, 0, 2, 0],
            [0, 0, 0, 2],
            [0, 0, 0, 0.0],
        ]
    )
    states = [x]
    for u in actions.swapaxes(0, 1):
        states.append(np.concatenate([states[-1], u, np.ones((5, 1))], 1) @ a)
    known = np.stack(states, 1)
    data = episodes(np.concatenate([known, fingertip(known[..., :2])], -1), actions)
    now, ahead = filtering.filter_errors(KalmanFilter(a, 1e-9 * np.eye(4), 0.01), data, data)
    assert (now.shape, ahead.shape) == ((45, 6), (45, 10, 6))
    np.testing.assert_allclose(now, 0, atol=1e-5)
    np.testing.assert_allclose(ahead, 0, atol=1e-5)


def test_on_an_arm_the_filter_beats_averages_and_averages_beat_the_raw_observation(
    kalman: KalmanFilter, held_out: Pair, test_data: Pair
) -> None:
    now, ahead = filtering.filter_errors(kalman.tuned(*held_out), *test_data)
    average = filtering.exponential_errors(filtering.tuned_exponential(*held_out), *test_data)
    raw = filtering.exponential_errors(0.0, *test_data)
    assert rmse(now) < 0.8 * rmse(average) < 0.8 * rmse(raw)
    assert rmse(ahead[:, 0]) < rmse(average)
    assert rmse(now) < rmse(ahead[:, 0]) < rmse(ahead[:, 9])


# Exponential filter


def test_an_exponential_filter_is_its_sum(test_data: Pair) -> None:
    noisy, clean = (data.take(slice(3)) for data in test_data)
    x, keep = noisy.states.astype(float), 0.7
    for row, t in enumerate(filtering.STARTS):
        mean = keep**t * x[:, 0] + sum(
            (1 - keep) * keep ** (t - s) * x[:, s] for s in range(1, t + 1)
        )
        found = filtering.exponential_errors(keep, noisy, clean)[3 * row : 3 * row + 3]
        np.testing.assert_allclose(found, errors(mean, clean.states[:, t]), atol=1e-6)


# Models


class Knows:
    """A model that knows the true episodes by their torques, and adds ``off`` (dx,) and noise to
    them.
    """

    segment_len, past_len = 10, 10

    def __init__(self, clean: Trajectories, off: float = 0.0, noise: float = 0.0) -> None:
        self.truth = {
            clean.actions[i, t : t + 10].tobytes(): clean.states[i, t + 1 : t + 11]
            for i in range(len(clean))
            for t in filtering.STARTS
        }
        self.off, self.noise, self.stochastic = torch.from_numpy(off * UNIT), noise, noise > 0

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        states = (
            torch.from_numpy(np.stack([self.truth[u.numpy().tobytes()] for u in actions]))
            + self.off
        )
        if self.noise:
            states = states + self.noise * torch.from_numpy(UNIT) * torch.randn(
                states.shape, generator=generator
            )  # type: ignore[arg-type]
        return states.float()


def test_a_model_that_knows_the_truth_makes_no_errors(test_data: Pair) -> None:
    noisy, clean = test_data
    found = filtering.model_errors(Knows(clean), noisy, clean)  # type: ignore[arg-type]
    assert found.shape == (9 * 40, 10, 6)
    np.testing.assert_allclose(found, 0, atol=1e-6)
    off = filtering.model_errors(Knows(clean, off=0.1), noisy, clean)  # type: ignore[arg-type]
    np.testing.assert_allclose(off, 0.1, atol=1e-5)


def test_errors_are_those_of_the_samples_mean(test_data: Pair) -> None:
    noisy, clean = test_data
    # type: ignore[arg-type]
    found = filtering.model_errors(Knows(clean, noise=0.3), noisy, clean, samples=16)
    assert rmse(found) == pytest.approx(0.3 / 4, rel=0.03)


def test_other_episodes_are_refused(kalman: KalmanFilter, held_out: Pair, test_data: Pair) -> None:
    noisy, (_, clean) = test_data[0].take(slice(20)), held_out
    for call in (
        lambda: filtering.model_errors(Knows(clean), noisy, clean),  # type: ignore[arg-type]
        lambda: filtering.filter_errors(kalman, noisy, clean),
        lambda: filtering.exponential_errors(0.5, noisy, clean),
        lambda: kalman.tuned(noisy, clean),
        lambda: filtering.tuned_exponential(noisy, clean.take(slice(5))),
    ):
        with pytest.raises(
            ValueError, match=f"episodes of {NOISY} and of {REACHER} hold other torques"
        ):
            call()
