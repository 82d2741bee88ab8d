"""The energy score as a loss, beyond the paper.

    E|X - x| - E|X - X'| / 2        X, X' independent samples, x the truth, each a whole segment

It is strictly proper: the model that minimises it is the true distribution of the future.
"""

from itertools import combinations

import torch
from torch import Tensor


def energy_score(samples: Tensor, truth: Tensor) -> Tensor:
    """Of samples (S, B, K, D) and truths (B, K, D), mean over the batch; of one, the distance."""
    off = torch.stack([distance(sample, truth) for sample in samples]).mean()
    pairs = [distance(*pair) for pair in combinations(samples, 2)]
    return off - torch.stack(pairs).mean() / 2 if pairs else off


def distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean Euclidean distance of whole segments (B, K, D), with a gradient where it is zero."""
    return ((a - b).flatten(1).square().sum(1) + 1e-8).sqrt().mean()
