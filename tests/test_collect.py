"""What data cover: where the fingertip has been, and for how long the arm remembers."""

from __future__ import annotations

import numpy as np
import pytest

from reproduction.measures.data import autocorrelation, cells_visited


def test_points_everywhere_visit_every_cell_and_one_point_one() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 401)] * 2), -1)
    assert cells_visited(grid, inner=0, outer=1) == 1
    inside = cells_visited(np.array([[0.01, 0.01]]), inner=0, outer=1, cells=4)
    assert inside == 1 / 12  # four of sixteen centres lie outside of the disc


def test_what_is_out_of_reach_does_not_count() -> None:
    corners = np.array([[0.99, 0.99], [-0.99, 0.99]])
    assert cells_visited(corners, inner=0, outer=1) == 0
    centre = np.array([[x, y] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    assert cells_visited(centre, inner=0.5, outer=1, cells=4) == 0
    half = np.stack(np.meshgrid(np.linspace(0.001, 1, 200), np.linspace(-1, 1, 400)), -1)
    assert cells_visited(half, inner=0.1, outer=1) == pytest.approx(0.5)


def test_a_wave_remembers_its_period_and_noise_nothing() -> None:
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (400, 1))
    wave = 3 + np.sin(2 * np.pi * np.arange(100) / 20 + phase)
    noise = np.random.default_rng(1).normal(size=(400, 100))
    series = np.stack([wave, noise], -1)
    np.testing.assert_allclose(autocorrelation(series, 20), [1, 0], atol=0.02)
    np.testing.assert_allclose(autocorrelation(series, 10), [-1, 0], atol=0.02)
    with pytest.raises(ValueError, match="lag is 100, expected 1 to 99"):
        autocorrelation(series, 100)
