"""Returns, and gradients of several copies of a policy side by side."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def discounted(rewards: Tensor, gamma: float) -> Tensor:
    """sum_t gamma^t r_t over the last dimension, the first step in full (Eq. 4 up to gamma)."""
    steps = torch.arange(rewards.shape[-1], dtype=rewards.dtype, device=rewards.device)
    return (rewards * gamma**steps).sum(-1)


def clip_gradients(gradients: Sequence[Tensor], norm: float) -> Tensor:
    """Shorten each copy's gradients (M, ...) to ``norm`` unless it is 0; the norms before (M,)."""
    norms = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
    if norm:
        for g in gradients:
            g *= (norm / norms).clamp(max=1).reshape(-1, *[1] * (g.ndim - 1))
    return norms
