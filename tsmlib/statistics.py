"""Statistics: t interval, rank correlation, classifier two-sample test."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def spearman(a: Tensor, b: Tensor) -> float:
    """Rank correlation of two rows of numbers; 0 where one of them is constant. Ties count in the order they come."""
    ranks = torch.stack([x.flatten().argsort().argsort().double() for x in (a, b)])
    if len(ranks[0]) < 2 or a.min() == a.max() or b.min() == b.max():
        return 0.0
    return float(torch.corrcoef(ranks)[0, 1])


def auc(positive: Tensor, negative: Tensor) -> float:
    """The chance that a score of ``positive`` (n,) is above one of ``negative`` (m,), ties counting half."""
    ordered = negative.sort().values
    below = torch.searchsorted(ordered, positive.contiguous())
    at_most = torch.searchsorted(ordered, positive.contiguous(), right=True)
    return float((below + at_most).double().mean() / (2 * len(negative)))


def told_apart(first: Tensor, second: Tensor, *, folds: int = 5, seed: int = 0) -> float:
    """AUC of a logistic regression between two samples of traits (B, q), each judged by one that never saw it.

    The regression reads each trait and its square, so that a sample that is only narrower is found too; both sides
    weigh alike however large. Cross-validated in ``folds`` parts: an AUC per part, then their mean, since scores of
    different regressions are not comparable. Below 0.5 by chance alone. ValueError with fewer than two rows a fold.
    """
    if min(len(first), len(second)) < 2 * folds:
        raise ValueError(f"{len(first)} and {len(second)} rows are too few for {folds} folds of at least 2 each")
    generator = torch.Generator().manual_seed(seed)
    parts = [torch.randperm(len(side), generator=generator) % folds for side in (first, second)]
    found = []
    for fold in range(folds):
        train = [side[part != fold] for side, part in zip((first, second), parts, strict=True)]
        known = torch.cat(train)
        middle, scale = known.mean(0), known.std(0).clamp_min(1e-9)
        weights = _logistic(*(_squared((side - middle) / scale) for side in train))
        test = (side[part == fold] for side, part in zip((first, second), parts, strict=True))
        found.append(auc(*(_squared((side - middle) / scale) @ weights for side in test)))
    return float(np.mean(found))


def _squared(x: Tensor) -> Tensor:
    """Traits, their squares and a one."""
    return torch.cat([x, x.square(), torch.ones(len(x), 1, dtype=x.dtype)], dim=1)


def _logistic(first: Tensor, second: Tensor, *, ridge: float = 1e-2, iterations: int = 30) -> Tensor:
    """Weights (q,) of the logistic regression that is above zero on ``first``, by Newton's method."""
    x = torch.cat([first, second])
    label = torch.cat([torch.ones(len(first)), torch.zeros(len(second))]).to(x)
    weigh = torch.where(label > 0, 0.5 / len(first), 0.5 / len(second)).to(x)
    shrink, weights = ridge * torch.eye(x.shape[1], dtype=x.dtype), x.new_zeros(x.shape[1])
    for _ in range(iterations):
        p = torch.sigmoid(x @ weights)
        slope = x.T @ (weigh * (p - label)) + shrink @ weights
        curvature = (x.T * (weigh * p * (1 - p))) @ x + shrink
        step = torch.linalg.solve(curvature, slope)
        weights = weights - step * min(1.0, 5 / float(step.norm().clamp_min(1e-12)))
    return weights


def interval(values: np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Mean of ``values`` (n,) and half its t interval of ``level``, 0.95 or 0.90 (0 for one value)."""
    dof = len(values) - 1
    if dof < 1:
        return float(values.mean()), 0.0
    few, normal, a, b, c = {  # the first five quantiles, and Cornish and Fisher's expansion
        0.95: ((12.706, 4.303, 3.182, 2.776, 2.571), 1.960, 2.372, 2.823, 2.556),
        0.90: ((6.314, 2.920, 2.353, 2.132, 2.015), 1.645, 1.524, 1.421, 0.984),
    }[level]
    t = few[dof - 1] if dof <= len(few) else normal + a / dof + b / dof**2 + c / dof**3
    return float(values.mean()), float(t * values.std(ddof=1) / np.sqrt(len(values)))
