"""Scores of samples against the truth, and the constants that they take from validation data
(sections 5.2, 5.3.1).

All live in the standardised feature space of the training data: angles as cosine and sine, unit
variance, dimensions that never change within an episode left out. Likelihoods are sums over
dimensions, in nats per time step. What a score leaves open (variances, residual noise) is fitted on
validation data alone, with the same freedom for every model. Letters in shapes: S samples, N
trajectories or segments, T predicted steps, D scored features.

    ll_paper            the paper's protocol: diagonal Gaussian fitted to the samples, plus one
    scalar variance ll_shared           one scalar variance around the samples' mean ll_horizon
    one variance per step and dimension around the samples' mean ll_own              the model's own
    density: an equal mixture of Gaussians around its samples, whose one variance
                        per step and dimension is residual noise
    energy_score, crps  proper scores of the samples themselves; lower is better ..._noise
    the same after Gaussian residual noise, one variance per step, was added to every sample
    squared_error       of the samples' mean, mean over dimensions; its root mean is the NRMSE

A deterministic model is one sample. Then ll_paper is the paper's likelihood of its baselines,
ll_own is ll_horizon, energy score and CRPS are distances, and the Gaussian of ll_horizon takes the
place of the samples in coverage. With residual noise it becomes S noisy copies.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tsmlib.sampling import generator_of

SHIFTS = 4  # pairs (s, s + 1), ..., (s, s + 4) of samples estimate the spread E|X - X'|
LEVELS = torch.arange(1, 20) / 20  # 0.05 .. 0.95, the nominal levels of a calibration curve
# Residual standard deviations to choose from.
NOISE = torch.cat([torch.zeros(1), torch.logspace(-3, 0.5, 22)])
FLOORS = torch.logspace(-8, 4, 121)


@dataclass(frozen=True)
class Fitted:
    """What scores take from validation data. Variances, in units of the training data's."""

    floor: float  # of ll_paper
    shared: float  # of ll_shared
    horizon: Tensor  # (T, D), of ll_horizon
    own: Tensor  # (T, D), of ll_own
    noise: Tensor  # (T,), of the ..._noise scores, where it is a residual variance


def fit(samples: Tensor, truth: Tensor, *, copies: int, seed: int = 0) -> Fitted:
    """Everything that ``measure`` takes from validation data. copies: of a deterministic model's
    sample.
    """
    horizon = (truth - samples.mean(0)).square().mean(0)
    return Fitted(
        floor=fit_floor(samples, truth),
        shared=fit_shared(samples, truth),
        horizon=horizon.clamp_min(FLOORS[0]),
        own=fit_own(samples, truth),
        noise=fit_noise(samples, truth, copies=copies, seed=seed),
    )


def fit_floor(samples: Tensor, truth: Tensor) -> float:
    """The scalar floor that maximises ``ll_paper``, by a fine grid of powers of ten and the mean
    squared error.

    With a single sample the mean squared error is the best.
    """
    error, variance = truth - samples.mean(0), spread(samples)
    grid = torch.cat([torch.tensor([fit_shared(samples, truth)]), FLOORS])
    values = torch.stack([gaussian(error, variance + floor).double().mean() for floor in grid])
    return float(grid[values.argmax()])


def fit_shared(samples: Tensor, truth: Tensor) -> float:
    """The scalar variance that maximises ``ll_shared``: the mean squared error."""
    return max(float((truth - samples.mean(0)).square().mean()), float(FLOORS[0]))


def fit_own(samples: Tensor, truth: Tensor, *, iterations: int = 30) -> Tensor:
    """The variances (T, D) that maximise ``ll_own``, by expectation maximisation, each step on its
    own.

    It starts at a tenth of the mean's squared error. Samples tell more than one stationary point
    apart: from there the better one was found, and 30 iterations were within 0.005 nats of 400.
    With a single sample one iteration is exact.
    """
    start = 0.1 * (truth - samples.mean(0)).square().mean(0).clamp_min(FLOORS[0])
    variances = []
    for step, variance in enumerate(start):
        squares = (samples[:, :, step] - truth[:, step]).square()  # (S, N, D)
        for _ in range(iterations):
            # (S, N): whose sample the truth may have come from.
            share = (squares @ (-0.5 / variance)).softmax(0)
            variance = (
                torch.einsum("sn,snd->d", share, squares).div(len(truth)).clamp_min(FLOORS[0])
            )
        variances.append(variance)
    return torch.stack(variances)


def fit_noise(samples: Tensor, truth: Tensor, *, copies: int, seed: int = 0) -> Tensor:
    """The residual variance (T,) that minimises each step's energy score, of the squares of
    ``NOISE``.

    By at most 50 samples.
    """
    few = samples[:50]
    shape = (min(50, copies), *truth.shape)
    noise = torch.randn(shape, generator=generator_of(3, seed))  # the same for every deviation
    values = torch.zeros(len(NOISE), truth.shape[1])
    for block in torch.arange(len(truth)).split(16):
        for index, deviation in enumerate(NOISE):
            noisy = few[:, block] + deviation * noise[:, block]
            values[index] += distances(noisy, truth[block], shifts=2)[0].sum(0)
    return NOISE[values.argmin(0)].square()


def measure(
    samples: Tensor, truth: Tensor, fitted: Fitted, copies: int, generator: torch.Generator
) -> tuple[dict[str, Tensor], Tensor]:
    """Every score, metric -> (N, T), and the PIT values (N, T, D) of samples (S, N, T, D)."""
    mean = samples.mean(0)
    error = truth - mean
    if len(samples) == 1:
        pit = torch.special.ndtr(error / fitted.horizon.sqrt())
    else:
        pit = rank(samples, truth, generator)
    noise = torch.randn((max(copies, len(samples)), *truth.shape), generator=generator)
    noisy = noise.mul_(fitted.noise.sqrt()[:, None]).add_(samples)
    values = {
        "ll_paper": gaussian(error, spread(samples) + fitted.floor),
        "ll_shared": gaussian(error, torch.tensor(fitted.shared)),
        "ll_horizon": gaussian(error, fitted.horizon),
        "ll_own": ll_own(samples, truth, fitted.own),
        **{f"coverage{level}": coverage(pit, level / 100) for level in (50, 80, 95)},
        "squared_error": error.square().mean(-1),
    }
    values["energy_score"], values["crps"] = distances(samples, truth)
    values["energy_score_noise"], values["crps_noise"] = distances(noisy, truth)
    return values, pit


def gaussian(error: Tensor, variance: Tensor) -> Tensor:
    """Log-density (..., T) of an error (..., T, D) under a diagonal Gaussian, in nats, summed over
    dimensions.
    """
    return -0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum(-1)


def spread(samples: Tensor) -> Tensor:
    """Variance (N, T, D) of the samples; that of a single one is zero."""
    # Ten times as fast as var.
    return (samples - samples.mean(0)).square_().sum(0) / max(1, len(samples) - 1)


def ll_own(samples: Tensor, truth: Tensor, variance: Tensor) -> Tensor:
    """Log-likelihood (N, T) under the mixture 1/S sum_s N(x; x_s, diag v), v (T, D) residual noise
    (``fit_own``).
    """
    nearness = (samples - truth).square_().mul_(-0.5 / variance).sum(-1).logsumexp(0)  # (N, T)
    return nearness + gaussian(torch.zeros_like(variance), variance) - math.log(len(samples))


def distances(samples: Tensor, truth: Tensor, *, shifts: int = SHIFTS) -> tuple[Tensor, Tensor]:
    """Energy score and CRPS (N, T), E|X - x| - E|X - X'| / 2, the CRPS as a mean over dimensions.

    Unbiased. X' are the samples moved on by 1, 2, ..., ``shifts`` in a circle, which is as good as
    all pairs once S is large and costs O(S); shifts >= S - 1 are all pairs. A single sample has no
    spread: both are distances.
    """
    energy, crps = (part.mean(0) for part in _lengths(samples - truth))
    last = min(shifts, len(samples) - 1)
    for shift in range(1, last + 1):
        parts = (
            _lengths(samples[shift:] - samples[:-shift]),
            _lengths(samples[:shift] - samples[-shift:]),
        )
        for total, lengths in zip((energy, crps), zip(*parts, strict=True), strict=True):
            total -= sum(part.sum(0) for part in lengths) / (2 * last * len(samples))
    return energy, crps


def rank(samples: Tensor, truth: Tensor, generator: torch.Generator) -> Tensor:
    """PIT values (N, T, D): where the truth falls among the samples, uniform on [0, 1] if both are
    drawn alike.

    A place drawn at random between the two samples around the truth, so that this holds for few
    samples too.
    """
    below = (len(samples) + (truth - samples).sign_().sum(0)) / 2  # a tie counts half
    return (below + torch.rand(below.shape, generator=generator)) / (len(samples) + 1)


def coverage(pit: Tensor, level: float) -> Tensor:
    """Share of dimensions (N, T) whose truth lies within the central interval of ``level``."""
    return ((2 * pit - 1).abs() <= level).float().mean(-1)


def _lengths(difference: Tensor) -> tuple[Tensor, Tensor]:
    return torch.linalg.vector_norm(difference, dim=-1), difference.abs_().mean(-1)
