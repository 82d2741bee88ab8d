"""Rank correlation and the classifier two-sample test."""

import numpy as np
from numpy.typing import ArrayLike


def spearman(a: ArrayLike, b: ArrayLike) -> float:
    """Rank correlation, ties at their average rank; 0 where one side is constant.

    Args:
        a: numbers (n,).
        b: as many numbers (n,).
    """
    from scipy.stats import rankdata  # heavy, and seldom needed

    first, second = (rankdata(np.asarray(x).ravel()) for x in (a, b))
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])


def two_sample_auc(first: ArrayLike, second: ArrayLike, *, folds: int = 5, seed: int = 0) -> float:
    """Classifier two-sample test: AUC of a logistic regression between two samples of features.

    The regression reads each feature and its square, so that a sample that is only narrower is
    found too; both sides weigh alike. An AUC per fold, then their mean, since scores of different
    regressions are not comparable. Below 0.5 by chance alone.

    Args:
        first: features (B, q).
        second: features (B', q).
        folds: of the cross-validation.
        seed: of the folds.

    Returns:
        The AUC: 0.5 where the samples are alike, 1 where they are apart.

    Raises:
        ValueError: fewer than two rows a fold.
    """
    from sklearn.linear_model import LogisticRegression  # heavy, and of the extra "study"
    from sklearn.model_selection import StratifiedKFold, cross_val_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    sides = [np.asarray(side, dtype=float) for side in (first, second)]
    if min(map(len, sides)) < 2 * folds:
        raise ValueError(
            f"{len(sides[0])} and {len(sides[1])} rows are too few for {folds} folds; expected at "
            "least 2 in each"
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
