"""Intervals, rank correlations and the classifier two-sample test are those of the textbooks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from reproduction.measures.statistics import spearman, two_sample_auc
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


def test_a_rank_correlation_sees_order_alone() -> None:
    x = torch.tensor([0.5, -1.0, 2.0, 3.0])
    assert spearman(x, x**3) == pytest.approx(1)
    assert spearman(x, -x) == pytest.approx(-1)
    assert spearman(x, torch.ones(4)) == 0
    assert spearman([1, 2, 2, 3], [1, 2, 2, 3]) == pytest.approx(1)  # ties share their rank
    assert spearman([1, 2, 2, 3], [1, 3, 2, 4]) == pytest.approx(0.9486833)


def test_samples_of_one_distribution_are_not_distinguished_and_planted_differences_are() -> None:
    draw = torch.Generator().manual_seed(0)
    first, second = (torch.randn(400, 3, generator=draw, dtype=torch.double) for _ in range(2))
    assert two_sample_auc(first, second) == pytest.approx(0.5, abs=0.06)
    assert two_sample_auc(first + torch.tensor([2.0, 0, 0]), second) > 0.85
    assert two_sample_auc(0.2 * first, second) > 0.85  # the same mean, only narrower
    assert two_sample_auc(first[:20] + 2, second) > 0.85  # sides of different size
    with pytest.raises(ValueError, match="9 and 400 rows are too few"):
        two_sample_auc(first[:9], second)
