"""Sources of random numbers: one generator, common random numbers, separate generators, numbers given, none."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class SeparateNoise:
    """Independent copies: rows are laid out copy by copy, (M, B), and each copy draws from a generator of its own."""

    generators: tuple[torch.Generator, ...]


@dataclass(frozen=True)
class SharedNoise:
    """Common random numbers: rows b, b + period, b + 2 period, ... of every batch draw the same noise.

    Planners lay candidates out as (C, B) and use a period of B, so that candidates are compared in the same futures.
    The generator may be several, each of its own copy within the period.
    """

    generator: torch.Generator | SeparateNoise
    period: int


@dataclass(frozen=True)
class NoNoise:
    """Zeros; of an ensemble each member in turn, member ``first`` for ``period`` rows, then the next, and so on."""

    period: int
    first: int = 0


@dataclass
class GivenNoise:
    """Numbers that were drawn before, in the order in which they are asked for (``stacked_training``); each is given
    once, and removed."""

    numbers: list[Tensor]

    def next(self, shape: Sequence[int]) -> Tensor:
        """ValueError for another shape than that which was drawn."""
        given = self.numbers.pop(0)
        if tuple(given.shape) != tuple(shape):
            raise ValueError(
                f"noise of shape {tuple(shape)} is asked for, but {tuple(given.shape)} was drawn"
            )
        return given


class Draw(NamedTuple):
    """Numbers that are asked for: standard normal ones, or indices from 0 to ``below`` - 1."""

    shape: torch.Size
    below: int | None = None

    def sample(self, generator: torch.Generator) -> Tensor:
        """The numbers, on the generator's device."""
        if self.below is None:
            return torch.randn(self.shape, generator=generator, device=generator.device)
        return torch.randint(self.below, self.shape, generator=generator, device=generator.device)


@dataclass
class RecordedNoise:
    """Zeros in place of noise; keeps what was asked for."""

    draws: list[Draw] = field(default_factory=list)


Noise = torch.Generator | SharedNoise | SeparateNoise | NoNoise


def generator_of(*key: int) -> torch.Generator:
    """Random numbers of their own for every key.

    Seeds that differ by a sum could meet; and on a CPU torch keeps the low 32 bits of a seed alone.
    """
    return torch.Generator().manual_seed(
        int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1)
    )


def standard_normal(
    shape: Sequence[int], noise: Noise | GivenNoise | RecordedNoise, like: Tensor
) -> Tensor:
    """Draw N(0, 1) of ``shape`` with the device and type of ``like``: the same numbers on any device."""
    if isinstance(noise, NoNoise):
        return like.new_zeros(tuple(shape))
    if isinstance(noise, GivenNoise):
        return noise.next(shape)
    if isinstance(noise, RecordedNoise):
        noise.draws.append(Draw(torch.Size(shape)))
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
    below: int,
    shape: Sequence[int],
    noise: torch.Generator | GivenNoise | RecordedNoise,
    device: torch.device,
) -> Tensor:
    """Indices from 0 to ``below`` - 1, all equally likely, on ``device``. Only losses draw them: the noise of planners
    (``SharedNoise``, ...) is not accepted."""
    if isinstance(noise, GivenNoise):
        return noise.next(shape)
    draw = Draw(torch.Size(shape), below)
    if isinstance(noise, RecordedNoise):
        noise.draws.append(draw)
        return torch.zeros(draw.shape, dtype=torch.long, device=device)
    return draw.sample(noise).to(device)


def by_generator(
    rows: int, noise: torch.Generator | SharedNoise | SeparateNoise
) -> Iterator[tuple[slice, torch.Generator]]:
    """The rows that draw from one generator, part by part: what ``standard_normal`` does, for draws of any kind.

    Each part is drawn before the next is asked for. Rows that share noise find their generator as the first ones did.
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
