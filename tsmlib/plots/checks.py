"""Checks of what a figure is given: shapes, finite numbers, and the panels that are named."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from tsmlib.plots.method import Method

Panels = Mapping[str, Mapping[Method, np.ndarray]]  # title -> method -> array


def shaped(field: str, values: ArrayLike, shape: str) -> np.ndarray:
    """``values`` as floats, checked against a shape written as in the docstrings: letters are free, numbers fixed."""
    array, want = np.asarray(values, dtype=float), shape.split()
    if array.ndim != len(want) or any(
        w.isdigit() and int(w) != s for w, s in zip(want, array.shape, strict=True)
    ):
        raise ValueError(f"{field} has shape {array.shape}, expected ({', '.join(want)})")
    if 0 in array.shape:
        raise ValueError(f"{field} has shape {array.shape}: nothing to draw")
    return array


def finite(field: str, values: ArrayLike, shape: str) -> np.ndarray:
    """``shaped``, and every value is a number."""
    array = shaped(field, values, shape)
    if bad := int(np.sum(~np.isfinite(array))):
        raise ValueError(
            f"{field}: {bad} of {array.size} values are not finite; a mean over them means nothing. "
            "Count such rollouts as worst, or drop and explain them, before they are drawn"
        )
    return array


def finite_panels(panels: Panels, shape: str) -> dict[str, dict[Method, np.ndarray]]:
    """Panels of finite arrays of one shape."""
    return {
        title: {
            method: finite(f"{title}, {method.label}", array, shape)
            for method, array in rows.items()
        }
        for title, rows in panels.items()
    }


def per_panel(
    word: str, given: str | Mapping[str, str], titles: Collection[str]
) -> Mapping[str, str]:
    """One text per panel, from one for all or a mapping."""
    texts = dict.fromkeys(titles, given) if isinstance(given, str) else given
    if missing := [title for title in titles if title not in texts]:
        raise ValueError(f"{word} names {', '.join(texts)}; panel '{missing[0]}' is missing")
    return texts


def known(word: str, given: Iterable[str], titles: Collection[str]) -> None:
    """Raise unless ``given`` names panels that are there."""
    if unknown := [title for title in given if title not in titles]:
        raise ValueError(f"{word} names a panel '{unknown[0]}'; there are {', '.join(titles)}")
