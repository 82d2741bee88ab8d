"""Split-conformal intervals around any prediction, the return of a chosen plan among them.

Calibrate on pairs made exactly as later ones are, chosen plans with what their execution returned:
a new pair then lies in its interval as often as ``level`` says, whatever is wrong with the model
(Vovk, Gammerman and Shafer 2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tsmlib.checks import as_tensor, require_number
from tsmlib.models.base import Numbers


@dataclass(frozen=True)
class Conformal:
    """What to add to a prediction for the two ends of its interval.

    Args:
        low: added for the lower end; one number for each predicted one.
        high: added for the upper end.
        level: share of new pairs that lie within.
    """

    low: np.ndarray
    high: np.ndarray
    level: float

    @classmethod
    def fit(cls, predicted: Numbers, actual: Numbers, level: float = 0.9) -> Conformal:
        """Calibrate on pairs that no training and no choice has seen.

        Args:
            predicted: (N, ...), such as the ``predicted_return`` of N plans, or states (N, T, dx).
            actual: what came of each, of the same shape.
            level: share of new pairs within their interval, each number by itself.

        Returns:
            The intervals, with equal shares of the misses above and below.

        Raises:
            ValueError: shapes that differ, values that are not finite, or too few pairs.
        """
        level = require_number("level", level, 0.0, 0.999, above=True)
        guess = as_tensor("predicted", predicted, tuple(np.shape(predicted))).double().numpy()
        residuals = as_tensor("actual", actual, guess.shape).double().numpy() - guess
        misses = int((len(residuals) + 1) * (1 - level) / 2 + 1e-9)  # on each side
        if not misses:
            raise ValueError(
                f"{len(residuals)} pairs cannot calibrate intervals of level {level}; expected at "
                f"least {int(np.ceil(2 / (1 - level) - 1e-9)) - 1}: plan for more starts"
            )
        ordered = np.sort(residuals, axis=0)
        return cls(ordered[misses - 1], ordered[-misses], level)

    def interval(self, predicted: Numbers) -> tuple[np.ndarray, np.ndarray]:
        """Both ends of the interval around each prediction (B, ...)."""
        guess = np.asarray(predicted, np.float64)
        return guess + self.low, guess + self.high

    def coverage(self, predicted: Numbers, actual: Numbers) -> np.ndarray:
        """Share of pairs (B, ...) that lie within, for each predicted number."""
        low, high = self.interval(predicted)
        found = np.asarray(actual, np.float64)
        return ((low <= found) & (found <= high)).mean(axis=0)
