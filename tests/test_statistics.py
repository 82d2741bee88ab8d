"""Intervals, rank correlations and the classifier two-sample test are those of the textbooks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from tsmlib import statistics


def test_a_half_interval_is_student_s_t_times_the_standard_error() -> None:
    values = np.array([1.0, 2.0, 4.0])
    error = values.std(ddof=1) / np.sqrt(3)
    assert statistics.interval(values) == pytest.approx((7 / 3, 4.302653 * error))
    assert statistics.interval(values, 0.90) == pytest.approx((7 / 3, 2.919986 * error))
    assert statistics.interval(np.random.default_rng(0).normal(size=1000))[1] == pytest.approx(
        1.962 / 1000**0.5, rel=0.1
    )
    assert statistics.interval([5.0]) == (5.0, 0.0)


def drawn(
    rng: np.random.Generator, seeds: int, trials: int, of_seeds: float, of_trials: float
) -> np.ndarray:
    """Values (seeds, trials) of mean 0, with deviations of seeds and of trials in units of that of the rest."""
    return (
        of_seeds * rng.standard_normal((seeds, 1))
        + of_trials * rng.standard_normal((1, trials))
        + rng.standard_normal((seeds, trials))
    )


def restricted_likelihood(values: np.ndarray) -> float:
    """Standard error of the mean in a model with crossed random effects, by numerical REML on the whole covariance."""
    y, (seeds, trials) = values.ravel(), values.shape
    of_seed = np.kron(np.eye(seeds), np.ones((trials, trials)))
    of_trial, ones = np.kron(np.ones((seeds, seeds)), np.eye(trials)), np.ones(len(y))

    def covariance(logarithms: np.ndarray) -> np.ndarray:
        a, b, c = np.exp(logarithms)
        return a * of_seed + b * of_trial + c * np.eye(len(y))

    def loss(logarithms: np.ndarray) -> float:
        v = covariance(logarithms)
        solved = np.linalg.solve(v, np.stack([ones, y], 1))
        information, mean = ones @ solved[:, 0], ones @ solved[:, 1] / (ones @ solved[:, 0])
        residual = y - mean
        return (
            np.linalg.slogdet(v)[1]
            + np.log(information)
            + residual @ (solved[:, 1] - mean * solved[:, 0])
        )

    found = minimize(
        loss,
        np.zeros(3),
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-11, "maxiter": 4000},
    )
    return float((ones @ np.linalg.solve(covariance(found.x), ones)) ** -0.5)


@pytest.mark.parametrize(("seeds", "trials"), [(3, 8), (5, 6), (10, 5)])
def test_the_error_of_two_random_effects_is_that_of_restricted_maximum_likelihood(
    seeds: int, trials: int
) -> None:
    values = drawn(np.random.default_rng(seeds), seeds, trials, 2.0, 2.0)
    assert statistics.random_effects(values).error == pytest.approx(
        restricted_likelihood(values), rel=1e-4
    )


@pytest.mark.parametrize(("seeds", "trials"), [(3, 20), (3, 100), (5, 5), (10, 100)])
@pytest.mark.parametrize(
    ("of_seeds", "of_trials"), [(0.0, 0.0), (0.2, 1.0), (1.0, 0.0), (1.0, 1.0), (0.0, 2.0)]
)
def test_an_interval_of_two_random_effects_covers_the_mean_as_often_as_it_says(
    seeds: int, trials: int, of_seeds: float, of_trials: float
) -> None:
    rng, studies = np.random.default_rng(0), 1000
    found = [
        statistics.random_effects(drawn(rng, seeds, trials, of_seeds, of_trials))
        for _ in range(studies)
    ]
    covered = sum(abs(each.mean) <= each.half() for each in found) / studies
    assert (
        covered >= 0.95 - 3 * (0.95 * 0.05 / studies) ** 0.5
    )  # by chance one study in 700 would be below


def test_a_rank_correlation_sees_order_alone() -> None:
    x = torch.tensor([0.5, -1.0, 2.0, 3.0])
    assert statistics.spearman(x, x**3) == pytest.approx(1)
    assert statistics.spearman(x, -x) == pytest.approx(-1)
    assert statistics.spearman(x, torch.ones(4)) == 0
    assert statistics.spearman([1, 2, 2, 3], [1, 2, 2, 3]) == pytest.approx(
        1
    )  # ties share their rank
    assert statistics.spearman([1, 2, 2, 3], [1, 3, 2, 4]) == pytest.approx(0.9486833)


def test_samples_of_one_distribution_are_not_distinguished_and_planted_differences_are() -> None:
    draw = torch.Generator().manual_seed(0)
    first, second = (torch.randn(400, 3, generator=draw, dtype=torch.double) for _ in range(2))
    assert statistics.two_sample_auc(first, second) == pytest.approx(0.5, abs=0.06)
    assert statistics.two_sample_auc(first + torch.tensor([2.0, 0, 0]), second) > 0.85
    assert statistics.two_sample_auc(0.2 * first, second) > 0.85  # the same mean, only narrower
    assert statistics.two_sample_auc(first[:20] + 2, second) > 0.85  # sides of different size
    with pytest.raises(ValueError, match="9 and 400 rows are too few"):
        statistics.two_sample_auc(first[:9], second)
