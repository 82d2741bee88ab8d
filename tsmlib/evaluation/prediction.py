"""How good predictions are: likelihoods, proper scores, coverage and errors (sections 5.2 and 5.3.1).

All scores live in the standardised feature space of the training data: angles as cosine and sine, unit variance,
dimensions that never change within an episode left out. Likelihoods are sums over dimensions, in nats per time step.
What a score leaves open (variances, residual noise) is fitted on validation data alone, with the same freedom for
every model. Letters in shapes: S samples, N trajectories or segments, T predicted steps, D scored features.

    ll_paper            the paper's protocol: diagonal Gaussian fitted to the samples, plus one scalar variance
    ll_shared           one scalar variance around the samples' mean
    ll_horizon          one variance per step and dimension around the samples' mean
    ll_own              the model's own density: an equal mixture of Gaussians around its samples, whose one variance
                        per step and dimension is residual noise
    energy_score, crps  proper scores of the samples themselves; lower is better
    ..._noise           the same after Gaussian residual noise, one variance per step, was added to every sample
    squared_error       of the samples' mean, mean over dimensions; its root mean is the NRMSE

A model that is deterministic says so by an attribute ``stochastic = False`` and is one sample. Then ll_paper is the
paper's likelihood of its baselines, ll_own is ll_horizon, energy score and CRPS are distances, and the Gaussian of
ll_horizon takes the place of the samples in coverage. With residual noise it becomes S noisy copies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.models.base import DynamicsModel, rollout
from tsmlib.models.features import Features
from tsmlib.trajectory import Segment, Trajectories

VERSION = 2  # raise it when a score changes: scores that are kept are found again only by the version that made them
ROWS = 800  # samples times trajectories that are rolled out and scored at once
SHIFTS = 4  # pairs (s, s + 1), ..., (s, s + 4) of samples estimate the spread E|X - X'|
WORST = 1e6  # where a sample that is not finite, or beyond, is kept: it counts as worst, and every score stays finite
LEVELS = torch.arange(1, 20) / 20  # 0.05 .. 0.95, the nominal levels of a calibration curve
NOISE = torch.cat([torch.zeros(1), torch.logspace(-3, 0.5, 22)])  # residual standard deviations to choose from
FLOORS = torch.logspace(-8, 4, 121)


@dataclass(frozen=True)
class Fitted:
    """What scores take from validation data. Variances, in units of the training data's."""

    floor: float  # of ll_paper
    shared: float  # of ll_shared
    horizon: Tensor  # (T, D), of ll_horizon
    own: Tensor  # (T, D), of ll_own
    noise: Tensor  # (T,), of the ..._noise scores, where it is a residual variance


@dataclass(frozen=True)
class Scores:
    """One model's scores. The caller averages: over trajectories, over some of them, over the horizon.

    values: metric -> (N, T). pit: (N, T, D), the predictive distribution function at the truth, uniform on [0, 1]
    where calibrated. outside: (N,), the share of samples that leave the physical range or are not finite at any step.
    """

    values: dict[str, Tensor]
    pit: Tensor
    outside: Tensor
    fitted: Fitted

    def against_horizon(self, where: Tensor | None = None) -> dict[str, Tensor]:
        """Mean over trajectories, metric -> (T,), with ``nrmse`` for squared_error.

        where: (N,) or (N, T) bool, what to average over; a step that has nothing to average is NaN.
        """
        means = {metric: _mean(value, where) for metric, value in self.values.items()}
        means["nrmse"] = means.pop("squared_error").sqrt()
        return means

    def calibration(self, where: Tensor | None = None) -> Tensor:
        """Observed coverage (19,) of the central intervals of ``LEVELS``, over all steps or those of ``where``."""
        return torch.stack([_mean(coverage(self.pit, float(level)).flatten(), _flat(where, self)) for level in LEVELS])


@torch.no_grad()
def score(
    model: DynamicsModel,
    features: Features,
    test: Trajectories,
    validation: Trajectories,
    *,
    samples: int = 500,
    horizon: int = 90,
    starts: Sequence[int] = (10,),
    seed: int = 0,
    progress: str = "",
) -> Scores:
    """Every score of ``model`` on ``test``, with all that is fitted taken from ``validation``.

    Open loop with the true actions after ``starts`` observed steps, for ``horizon`` steps. The default is from the
    first H = 10 steps to T = 100. Teacher-forced segments are starts=range(10, 100, 10) and horizon=10: each predicts
    H steps from the true past, and N counts segments, those of one trajectory after each other.

    Memory: the validation samples (S, N, T, D), 0.4 GiB at the paper's sizes; test samples are never held together.
    Raises ValueError where model, test and validation data are not of one kind, naming both sides.
    """
    _require_fit(features, test, validation, samples)
    rollouts = partial(_rollouts, model, samples=samples, horizon=horizon, starts=starts, progress=progress)
    low, high = physical_range(test, validation)
    held = list(rollouts(validation, key=(1, seed)))
    drawn = torch.cat([scored(features, states) for states, _ in held], 1)
    fitted = fit(drawn, torch.cat([scored(features, truth) for _, truth in held]), copies=samples, seed=seed)
    del held, drawn
    parts: list[tuple[dict[str, Tensor], Tensor, Tensor]] = []
    for states, truth in rollouts(test, key=(0, seed)):
        outside = ((states >= low) & (states <= high)).logical_not().any(-1).any(-1).float().mean(0)  # NaN is outside
        generator = _generator(2, seed, len(parts))
        values, pit = measure(scored(features, states), scored(features, truth), fitted, samples, generator)
        parts.append((values, pit, outside))
    values = {metric: torch.cat([part[0][metric] for part in parts]) for metric in parts[0][0]}
    return Scores(values, torch.cat([part[1] for part in parts]), torch.cat([part[2] for part in parts]), fitted)


def _require_fit(features: Features, test: Trajectories, validation: Trajectories, samples: int) -> None:
    """ValueError unless all of it belongs together."""
    if samples < 1:
        raise ValueError(f"samples is {samples}, expected at least 1")
    for field in ("env", "dt", "names", "angles"):
        ours, theirs = getattr(test, field), getattr(validation, field)
        if ours != theirs:
            raise ValueError(
                f"test data have {field} {ours!r}, validation data {theirs!r}; score with two splits of one data set"
            )
    expected, found = len(features.step_std), test.states.shape[-1]
    if expected != found or features.angles != list(test.angles):
        raise ValueError(
            f"the model's states have {expected} dimensions with angles {features.angles}, those of {test.env} {found} "
            f"with angles {list(test.angles)}; score a model that was trained on {test.env}"
        )


# Samples -------------------------------------------------------------------------------------------------------------


def sample_states(
    model: DynamicsModel,
    data: Trajectories,
    *,
    samples: int,
    horizon: int = 90,
    starts: Sequence[int] = (10,),
    seed: int = 0,
    progress: str = "",
) -> Tensor:
    """Open-loop samples (S, N, T, dx), physical units, with the true actions after ``starts`` observed steps.

    Column k holds the prediction of x_{start + k + 1}. A deterministic model gives one sample, whatever S.
    """
    blocks = _rollouts(model, data, samples=samples, horizon=horizon, starts=starts, key=(0, seed), progress=progress)
    return torch.cat([states for states, _ in blocks], dim=1)


def predict(
    model: DynamicsModel,
    features: Features,
    data: Trajectories,
    *,
    samples: int,
    horizon: int = 90,
    starts: Sequence[int] = (10,),
    seed: int = 0,
    progress: str = "",
) -> tuple[Tensor, Tensor]:
    """What ``sample_states`` draws, (S, N, T, D), and the truth, (N, T, D), in the space of the scores."""
    states = sample_states(
        model, data, samples=samples, horizon=horizon, starts=starts, seed=seed, progress=progress
    )  # fmt: skip
    return scored(features, states), scored(features, cut(data.padded(0).states, starts, horizon))


def scored(features: Features, states: Tensor) -> Tensor:
    """(..., dx) -> (..., D), the space of the scores. What is not finite becomes the worst that can be counted."""
    return features(states)[..., features.scored].nan_to_num(nan=WORST).clamp(-WORST, WORST)


def cut(steps: Tensor, starts: Sequence[int], horizon: int) -> Tensor:
    """(N, T, ...) -> (N * len(starts), horizon, ...): columns start .. start + horizon, in the order of ``score``."""
    return torch.stack([steps[:, start : start + horizon] for start in starts], 1).flatten(0, 1)


def physical_range(*data: Trajectories) -> tuple[Tensor, Tensor]:
    """Lowest and highest state (dx,) that counts as physical: the range of the data, half as wide again at each end.

    Angles may be anything finite.
    """
    states = np.concatenate([part.states.reshape(-1, part.states.shape[-1]) for part in data])
    low, high = (torch.from_numpy(edge).float() for edge in (states.min(0), states.max(0)))
    margin = 0.5 * (high - low) + 1e-6
    low, high, angles = low - margin, high + margin, list(data[0].angles)
    low[angles], high[angles] = -torch.finfo(low.dtype).max, torch.finfo(low.dtype).max
    return low, high


@torch.no_grad()
def _rollouts(
    model: DynamicsModel,
    data: Trajectories,
    *,
    samples: int,
    horizon: int,
    starts: Sequence[int],
    key: tuple[int, int],  # of the random numbers: which set of data, and the seed
    progress: str,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Blocks of trajectories: states (S, n, T, dx) and truth (n, T, dx). Blocks are independent."""
    if not (starts and min(starts) >= 1 and 1 <= horizon <= data.horizon - max(starts)):
        raise ValueError(
            f"starts {list(starts)} and horizon {horizon} do not fit: at least one step is observed first, and "
            f"episodes have {data.horizon}"
        )
    before = max(0, model.past_len - min(starts))  # steps that the model looks back beyond the first one
    whole, stochastic = data.padded(before), getattr(model, "stochastic", True)
    past = Segment(
        *(torch.cat([part[:, before + s - model.past_len : before + s] for s in starts], 1) for part in whole)
    )
    past = Segment(*(part.reshape(-1, model.past_len, part.shape[-1]) for part in past))
    actions, truth = (cut(part[:, before:], starts, horizon) for part in (whole.actions, whole.states))
    rows = torch.arange(len(truth))
    if not stochastic:
        point = torch.cat([rollout(model, Segment(*(p[b] for p in past)), actions[b]) for b in rows.split(ROWS)])
    blocks = rows.split(max(1, ROWS // samples))
    for index, block in enumerate(tqdm(blocks, desc=progress, disable=not progress)):
        if stochastic:
            many = block.repeat(samples)  # (S * n,)
            states = rollout(
                model, Segment(*(part[many] for part in past)), actions[many], generator=_generator(*key, index)
            )
            yield states.unflatten(0, (samples, len(block))), truth[block]
        else:
            yield point[block][None], truth[block]


# What is fitted on validation data -----------------------------------------------------------------------------------


def fit(samples: Tensor, truth: Tensor, *, copies: int, seed: int = 0) -> Fitted:
    """Everything that ``measure`` takes from validation data. copies: of a deterministic model's sample."""
    horizon = (truth - samples.mean(0)).square().mean(0)
    return Fitted(
        floor=fit_floor(samples, truth), shared=fit_shared(samples, truth), horizon=horizon.clamp_min(FLOORS[0]),
        own=fit_own(samples, truth), noise=fit_noise(samples, truth, copies=copies, seed=seed),
    )  # fmt: skip


def fit_floor(samples: Tensor, truth: Tensor) -> float:
    """The scalar floor that maximises ``ll_paper``, by a fine grid of powers of ten and the mean squared error.

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
    """The variances (T, D) that maximise ``ll_own``, by expectation maximisation, each step on its own.

    It starts at a tenth of the mean's squared error. Samples tell more than one stationary point apart: from there the
    better one was found, and 30 iterations were within 0.005 nats of 400. With a single sample one iteration is exact.
    """
    start = 0.1 * (truth - samples.mean(0)).square().mean(0).clamp_min(FLOORS[0])
    variances = []
    for step, variance in enumerate(start):
        squares = (samples[:, :, step] - truth[:, step]).square()  # (S, N, D)
        for _ in range(iterations):
            share = (squares @ (-0.5 / variance)).softmax(0)  # (S, N): whose sample the truth may have come from
            variance = torch.einsum("sn,snd->d", share, squares).div(len(truth)).clamp_min(FLOORS[0])
        variances.append(variance)
    return torch.stack(variances)


def fit_noise(samples: Tensor, truth: Tensor, *, copies: int, seed: int = 0) -> Tensor:
    """The residual variance (T,) that minimises each step's energy score, of the squares of ``NOISE``.

    By at most 50 samples.
    """
    few = samples[:50]
    noise = torch.randn((min(50, copies), *truth.shape), generator=_generator(3, seed))  # the same for every deviation
    values = torch.zeros(len(NOISE), truth.shape[1])
    for block in torch.arange(len(truth)).split(16):
        for index, deviation in enumerate(NOISE):
            noisy = few[:, block] + deviation * noise[:, block]
            values[index] += distances(noisy, truth[block], shifts=2)[0].sum(0)
    return NOISE[values.argmin(0)].square()


# Scores --------------------------------------------------------------------------------------------------------------


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
    """Log-density (..., T) of an error (..., T, D) under a diagonal Gaussian, in nats, summed over dimensions."""
    return -0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum(-1)


def spread(samples: Tensor) -> Tensor:
    """Variance (N, T, D) of the samples; that of a single one is zero."""
    return (samples - samples.mean(0)).square_().sum(0) / max(1, len(samples) - 1)  # ten times as fast as var


def fit_loss(samples: int, dims: int) -> float:
    """Nats per step that ``ll_paper`` without a floor loses for having S samples of a true Gaussian, in expectation.

    The fitted variance is (v / (S - 1)) chi-squared with S - 1 degrees of freedom, independent of the fitted mean:

        D / 2 (E log chi2_{S-1} / (S - 1) + (1 + 1 / S) E (S - 1) / chi2_{S-1} - 1)

    Infinite below 4 samples. About D / S.
    """
    if samples < 4:
        return math.inf
    half = (samples - 1) / 2
    log_variance = float(torch.digamma(torch.tensor(half, dtype=torch.float64))) - math.log(half)
    return dims / 2 * (log_variance + (1 + 1 / samples) * (samples - 1) / (samples - 3) - 1)


def ll_own(samples: Tensor, truth: Tensor, variance: Tensor) -> Tensor:
    """Log-likelihood (N, T) under the mixture 1/S sum_s N(x; x_s, diag v), v (T, D) residual noise (``fit_own``)."""
    nearness = (samples - truth).square_().mul_(-0.5 / variance).sum(-1).logsumexp(0)  # (N, T)
    return nearness + gaussian(torch.zeros_like(variance), variance) - math.log(len(samples))


def distances(samples: Tensor, truth: Tensor, *, shifts: int = SHIFTS) -> tuple[Tensor, Tensor]:
    """Energy score and CRPS (N, T), E|X - x| - E|X - X'| / 2, the CRPS as a mean over dimensions.

    Unbiased. X' are the samples moved on by 1, 2, ..., ``shifts`` in a circle, which is as good as all pairs once S is
    large and costs O(S); shifts >= S - 1 are all pairs. A single sample has no spread: both are distances.
    """
    energy, crps = (part.mean(0) for part in _lengths(samples - truth))
    last = min(shifts, len(samples) - 1)
    for shift in range(1, last + 1):
        parts = (_lengths(samples[shift:] - samples[:-shift]), _lengths(samples[:shift] - samples[-shift:]))
        for total, lengths in zip((energy, crps), zip(*parts, strict=True), strict=True):
            total -= sum(part.sum(0) for part in lengths) / (2 * last * len(samples))
    return energy, crps


def rank(samples: Tensor, truth: Tensor, generator: torch.Generator) -> Tensor:
    """PIT values (N, T, D): where the truth falls among the samples, uniform on [0, 1] if both are drawn alike.

    A place drawn at random between the two samples around the truth, so that this holds for few samples too.
    """
    below = (len(samples) + (truth - samples).sign_().sum(0)) / 2  # a tie counts half
    return (below + torch.rand(below.shape, generator=generator)) / (len(samples) + 1)


def coverage(pit: Tensor, level: float) -> Tensor:
    """Share of dimensions (N, T) in which the truth lies within the central interval of ``level``."""
    return ((2 * pit - 1).abs() <= level).float().mean(-1)


def _generator(*key: int) -> torch.Generator:
    """Random numbers of their own for every key; seeds that differ by a sum could meet."""
    return torch.Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1))


def _lengths(difference: Tensor) -> tuple[Tensor, Tensor]:
    return torch.linalg.vector_norm(difference, dim=-1), difference.abs_().mean(-1)


def _mean(value: Tensor, where: Tensor | None) -> Tensor:
    """Over the first dimension, at the places that ``where`` (N,) or (N, T) names."""
    if where is None:
        return value.mean(0)
    chosen = where.reshape(*where.shape, *[1] * (value.ndim - where.ndim)).expand_as(value)
    return value.where(chosen, 0.0).sum(0) / chosen.sum(0)


def _flat(where: Tensor | None, scores: Scores) -> Tensor | None:
    if where is None:
        return None
    return where.reshape(len(where), -1).expand(scores.pit.shape[:2]).flatten()
