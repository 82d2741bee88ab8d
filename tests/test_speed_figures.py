"""The figure of how cost grows."""

from __future__ import annotations

import numpy as np
import pytest
from _figure import LOOKS, exponents, growth

SIZES = np.array([1, 2, 4, 8])


def test_an_exponent_is_that_of_the_power_that_made_the_curve() -> None:
    seconds = np.stack([3.0 * SIZES**0.5, 0.1 * SIZES**2.0])
    np.testing.assert_allclose(exponents(SIZES, seconds), [0.5, 2.0])


def test_each_panel_names_its_exponents() -> None:
    flat = np.stack([np.ones(4), np.ones(4)])
    figure = growth({"batch": {"train": (SIZES, flat * SIZES)}, "threads": {"simulate": (SIZES, flat / SIZES)}})
    notes = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert notes == ["slope 1.00 (1.00 to 1.00)", "slope −1.00 (−1.00 to −1.00)"]


def test_an_exponent_that_differs_from_round_to_round_is_not_printed() -> None:
    noisy = np.stack([SIZES**0.1, SIZES**4.0])
    (note,) = growth({"threads": {"train": (SIZES, noisy)}}).axes[0].texts
    assert note.get_text() == "rounds differ too much"


def test_every_quantity_has_a_colour_of_its_own() -> None:
    assert len({look["color"] for look in LOOKS.values()}) == len(LOOKS)


def test_numbers_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="seconds of batch, train"):
        growth({"batch": {"train": (SIZES, np.full((2, 4), np.nan))}})
