"""Statistics: t interval, two-way random effects, rank correlation, classifier two-sample test."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtr, stdtrit


def interval(values: ArrayLike, level: float = 0.95) -> tuple[float, float]:
    """Mean of ``values`` (n,) and half its t interval of ``level`` (0 for one value)."""
    array = np.asarray(values, dtype=float)
    dof = len(array) - 1
    if dof < 1:
        return float(array.mean()), 0.0
    half = stdtrit(dof, (1 + level) / 2) * array.std(ddof=1) / np.sqrt(len(array))
    return float(array.mean()), float(half)


@dataclass(frozen=True)
class Estimate:
    """A mean, its standard error, and the degrees of freedom of that (0: there is no error)."""

    mean: float
    error: float
    dof: int

    def half(self, level: float = 0.95) -> float:
        """Half the t interval of ``level``; 0 without an error."""
        return float(stdtrit(self.dof, (1 + level) / 2) * self.error) if self.dof else 0.0

    def p_below(self, bound: float) -> float:
        """One-sided p value against a mean of at least ``bound``; NaN without an error."""
        if not self.dof:
            return float("nan")
        away = self.mean - bound
        return float(stdtr(self.dof, away / self.error)) if self.error else float(away >= 0)


def random_effects(values: ArrayLike, *, crossed: bool = True) -> Estimate:
    """Mean of ``values`` (seeds, trials) with the error that both seeds and trials have a part in.

    crossed: the trials are the same in every seed, as frozen targets are. Two-way random effects without replication:
    the variance of the mean is (MS_seeds + MS_trials - MS_rest) / n, of which each mean square alone is the least that
    is taken; degrees of freedom are those of whatever there is less of, since a variance between few seeds is often
    estimated too small. Not crossed: trials of a seed are its own, so that the means of seeds decide. With one seed the
    trials decide, with one trial the seeds.

    The formula is written out here, since none of the dependencies fits crossed random effects; where neither variance
    is estimated negative, the error is that of restricted maximum likelihood.
    """
    array = np.asarray(values, dtype=float)
    seeds, trials = array.shape
    if min(seeds, trials) == 1 or not crossed:
        flat = array.ravel() if min(seeds, trials) == 1 else array.mean(1)
        error = float(flat.std(ddof=1) / len(flat) ** 0.5) if len(flat) > 1 else 0.0
        return Estimate(float(flat.mean()), error, len(flat) - 1)
    mean, rows, columns = array.mean(), array.mean(1, keepdims=True), array.mean(0, keepdims=True)
    of_seeds, of_trials = trials * rows.var(ddof=1), seeds * columns.var(ddof=1)
    rest = ((array - rows - columns + mean) ** 2).sum() / ((seeds - 1) * (trials - 1))
    square = max(of_seeds + of_trials - rest, of_seeds, of_trials)
    return Estimate(float(mean), float((square / array.size) ** 0.5), min(seeds, trials) - 1)


def holm(p_values: ArrayLike, levels: ArrayLike) -> np.ndarray:
    """Which of several hypotheses Holm's procedure rejects (n,), each p value held against its own level; NaN: none."""
    p, level = np.asarray(p_values, dtype=float), np.asarray(levels, dtype=float)
    rejected, asked = np.zeros(len(p), dtype=bool), int(np.isfinite(p).sum())
    for k, i in enumerate(
        np.argsort(np.where(np.isfinite(p), p / level, np.inf), kind="stable")[:asked]
    ):
        if p[i] > level[i] / (asked - k):
            break
        rejected[i] = True
    return rejected


def spearman(a: ArrayLike, b: ArrayLike) -> float:
    """Rank correlation of two rows of numbers, ties at their average rank; 0 where one of them is constant."""
    from scipy.stats import rankdata  # heavy, and seldom needed

    first, second = (rankdata(np.asarray(x).ravel()) for x in (a, b))
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])


def two_sample_auc(first: ArrayLike, second: ArrayLike, *, folds: int = 5, seed: int = 0) -> float:
    """Classifier two-sample test: AUC of a logistic regression between two samples of features (B, q).

    The regression reads each feature and its square, so that a sample that is only narrower is found too; both sides
    weigh alike however large. Cross-validated in ``folds`` parts: an AUC per part, then their mean, since scores of
    different regressions are not comparable. Below 0.5 by chance alone. ValueError with fewer than two rows a fold.
    """
    from sklearn.linear_model import LogisticRegression  # heavy, and of the extra "study"
    from sklearn.model_selection import StratifiedKFold, cross_val_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    sides = [np.asarray(side, dtype=float) for side in (first, second)]
    if min(map(len, sides)) < 2 * folds:
        raise ValueError(
            f"{len(sides[0])} and {len(sides[1])} rows are too few for {folds} folds of at least 2 each"
        )
    features, label = np.concatenate(sides), np.repeat([1, 0], [len(side) for side in sides])
    ridge = 0.01  # against a loss that is a mean over rows
    classifier = make_pipeline(
        StandardScaler(),
        FunctionTransformer(lambda x: np.hstack([x, x**2])),
        LogisticRegression(C=1 / (ridge * len(label)), class_weight="balanced", max_iter=1000),
    )
    parts = StratifiedKFold(folds, shuffle=True, random_state=seed)
    return float(cross_val_score(classifier, features, label, scoring="roc_auc", cv=parts).mean())
