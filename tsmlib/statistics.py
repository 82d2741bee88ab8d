"""The t interval of a mean."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit


def interval(values: ArrayLike, level: float = 0.95) -> tuple[float, float]:
    """Mean and half its t interval.

    Args:
        values: numbers (n,).
        level: of the interval.

    Returns:
        The mean, and half the interval, 0 for one value.
    """
    array = np.asarray(values, dtype=float)
    dof = len(array) - 1
    if dof < 1:
        return float(array.mean()), 0.0
    half = stdtrit(dof, (1 + level) / 2) * array.std(ddof=1) / np.sqrt(len(array))
    return float(array.mean()), float(half)
