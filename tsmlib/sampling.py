"""Sources of random numbers: one generator, common numbers, separate generators, none."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class SeparateNoise:
    """Independent copies: rows lie copy by copy, (M, B); each copy draws from its generator."""

    generators: tuple[torch.Generator, ...]


@dataclass(frozen=True)
class SharedNoise:
    """Common random numbers: rows b, b + period, ... of every batch draw the same noise.

    Planners lay candidates out as (C, B) and use a period of B, so that candidates are compared in
    the same futures. The generator may be several, each of its own copy within the period.
    """

    generator: torch.Generator | SeparateNoise
    period: int


@dataclass(frozen=True)
class NoNoise:
    """Zeros; of an ensemble each member in turn: ``first`` for ``period`` rows, then the next."""

    period: int
    first: int = 0


Noise = torch.Generator | SharedNoise | SeparateNoise | NoNoise


def generator_of(*key: int) -> torch.Generator:
    """Random numbers of their own for every key.

    Seeds that differ by a sum could meet; and on a CPU torch keeps the low 32 bits of a seed alone.
    """
    return torch.Generator().manual_seed(
        int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1)
    )


def standard_normal(shape: Sequence[int], noise: Noise, like: Tensor) -> Tensor:
    """Draw N(0, 1) of ``shape``, of device and type of ``like``: the same numbers everywhere."""
    if isinstance(noise, NoNoise):
        return like.new_zeros(tuple(shape))
    if isinstance(noise, SeparateNoise):
        share = (shape[0] // len(noise.generators), *shape[1:])
        return torch.cat(
            [standard_normal(share, generator, like) for generator in noise.generators]
        )
    if isinstance(noise, SharedNoise):
        drawn = standard_normal((noise.period, *shape[1:]), noise.generator, like)
        return drawn.repeat(shape[0] // noise.period, *[1] * (len(shape) - 1))
    return torch.randn(shape, generator=noise, device=noise.device, dtype=like.dtype).to(
        like.device
    )


def random_indices(
    below: int, shape: Sequence[int], noise: torch.Generator, device: torch.device
) -> Tensor:
    """Indices from 0 to ``below`` - 1, all equally likely, on ``device``."""
    drawn = torch.randint(below, tuple(shape), generator=noise, device=noise.device)
    return drawn.to(device)


def by_generator(
    rows: int, noise: torch.Generator | SharedNoise | SeparateNoise
) -> Iterator[tuple[slice, torch.Generator]]:
    """The rows of each generator, part by part: ``standard_normal`` for draws of any kind.

    Each part is drawn before the next is taken. Rows that share noise find their generator as the
    first ones did.
    """
    if isinstance(noise, torch.Generator):
        yield slice(0, rows), noise
    elif isinstance(noise, SeparateNoise):
        share = rows // len(noise.generators)
        for k, generator in enumerate(noise.generators):
            yield slice(k * share, (k + 1) * share), generator
    else:
        begun = [
            generator.get_state() for _, generator in by_generator(noise.period, noise.generator)
        ]
        for first in range(0, rows, noise.period):
            for (part, generator), state in zip(
                by_generator(noise.period, noise.generator), begun, strict=True
            ):
                generator.set_state(state)
                yield slice(first + part.start, first + part.stop), generator


def draw_members(n_members: int, rows: int, noise: Noise, like: Tensor) -> Tensor:
    """A member of an ensemble for each row, (rows,) from 0 to ``n_members`` - 1."""
    if isinstance(noise, NoNoise):
        return (noise.first + torch.arange(rows, device=like.device) // noise.period) % n_members
    uniform = torch.special.ndtr(standard_normal((rows,), noise, like))
    return (n_members * uniform).long().clamp(max=n_members - 1)
