"""Sources of standard normal noise: one generator, common random numbers, separate generators."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class SharedNoise:
    """Common random numbers: rows b, b + period, b + 2 period, ... of every batch draw the same noise.

    Planners lay candidates out as (C, B) and use a period of B, so that candidates are compared in the same futures.
    """

    generator: torch.Generator
    period: int


@dataclass(frozen=True)
class SeparateNoise:
    """Independent copies: rows are laid out copy by copy, (M, B), and each copy draws from a generator of its own."""

    generators: tuple[torch.Generator, ...]


Noise = torch.Generator | SharedNoise | SeparateNoise


def standard_normal(shape: Sequence[int], noise: Noise, like: Tensor) -> Tensor:
    """Draw N(0, 1) of ``shape`` with the device and type of ``like``: the same numbers on any device."""
    if isinstance(noise, SeparateNoise):
        share = (shape[0] // len(noise.generators), *shape[1:])
        return torch.cat([standard_normal(share, generator, like) for generator in noise.generators])
    if isinstance(noise, SharedNoise):
        drawn = standard_normal((noise.period, *shape[1:]), noise.generator, like)
        return drawn.repeat(shape[0] // noise.period, *[1] * (len(shape) - 1))
    return torch.randn(shape, generator=noise, device=noise.device, dtype=like.dtype).to(like.device)
