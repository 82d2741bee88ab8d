"""How good predictions are: likelihoods, proper scores and errors against the horizon (sections 5.2 and 5.3.1).

All scores live in the standardised feature space of the training data: angles as cosine and sine, unit variance,
dimensions that never change within an episode left out. Likelihoods are sums over dimensions and means over time steps
and trajectories. Letters in shapes: S samples, N trajectories, T steps, D scored features.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.dynamics import DynamicsModel, rollout
from tsmlib.nets import Features
from tsmlib.trajectory import Segment, Trajectories


@torch.no_grad()
def sample_states(
    model: DynamicsModel,
    data: Trajectories,
    *,
    samples: int,
    horizon: int = 90,  # from the first H observed steps to T = 100
    seed: int = 0,
    progress: str = "",
) -> Tensor:
    """Open-loop samples (S, N, T, dx), physical units, with the true actions after ``past_len`` observed steps.

    Column k holds the prediction of x_{past_len + k + 1}.
    """
    past_len, whole = model.past_len, data.padded(0)
    if not 1 <= horizon <= data.horizon - past_len:
        raise ValueError(
            f"horizon is {horizon}; episodes of {data.horizon} steps with {past_len} observed first leave 1 to "
            f"{data.horizon - past_len} to predict"
        )
    past = Segment(whole.states[:, :past_len], whole.actions[:, :past_len])
    actions = whole.actions[:, past_len : past_len + horizon]
    drawn = []
    for draw in tqdm(range(samples), desc=progress, disable=not progress):
        generator = torch.Generator().manual_seed(seed * 1_000_003 + draw)
        drawn.append(rollout(model, past, actions, generator=generator))
    return torch.stack(drawn)


def predict(
    model: DynamicsModel,
    features: Features,
    data: Trajectories,
    *,
    samples: int,
    horizon: int = 90,
    seed: int = 0,
    progress: str = "",
) -> tuple[Tensor, Tensor]:
    """What ``sample_states`` draws, (S, N, T, D), and the truth, (N, T, D), in the space of the scores.

    A sample that is not finite is kept at the edge of the representable range, so that it counts as worst.
    """
    states = sample_states(model, data, samples=samples, horizon=horizon, seed=seed, progress=progress)
    steps = slice(model.past_len, model.past_len + horizon)
    truth = features(data.padded(0).states[:, steps])[..., features.scored]
    drawn = [features(draw)[..., features.scored].nan_to_num(nan=1e6).clamp(-1e6, 1e6) for draw in states]
    return torch.stack(drawn), truth


def scores(
    samples: Tensor, truth: Tensor, validation: tuple[Tensor, Tensor]
) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Every score of ``predict``'s samples against the horizon, metric -> (T,), and the two fitted variances.

    validation: samples and truth of the validation set, on which alone the variances are fitted.
    """
    floor, variance = fit_floor(*validation), fit_shared(*validation)
    against_horizon = {
        "ll_paper": ll_paper(samples, truth, floor).mean(0),
        "ll_shared": ll_shared(samples, truth, variance).mean(0),
        "energy_score": energy_score(samples, truth).mean(0),
        "coverage80": coverage(samples, truth, 0.8).mean(0),
        "nrmse": nrmse(samples, truth),
    }
    return against_horizon, {"floor": floor, "shared": variance}


def ll_paper(samples: Tensor, truth: Tensor, floor: float) -> Tensor:
    """The paper's protocol: log-likelihood (N, T) under a diagonal Gaussian fitted to the samples at each step.

    floor: a variance added everywhere, one scalar per model fitted on validation (``fit_floor``).
    """
    variance = samples.var(0) + floor  # (N, T, D)
    return _gaussian(truth - samples.mean(0), variance)


def ll_shared(samples: Tensor, truth: Tensor, variance: float) -> Tensor:
    """Log-likelihood (N, T) under one scalar variance around the samples' mean, the same form for every model."""
    return _gaussian(truth - samples.mean(0), truth.new_tensor(variance))


def fit_floor(samples: Tensor, truth: Tensor) -> float:
    """The scalar floor that maximises ``ll_paper`` on validation data, by a fine grid of powers of ten."""
    error, variance = truth - samples.mean(0), samples.var(0)
    grid = torch.logspace(-8, 4, 121)
    values = torch.stack([_gaussian(error, variance + floor).mean() for floor in grid])
    return float(grid[values.argmax()])


def fit_shared(samples: Tensor, truth: Tensor) -> float:
    """The scalar variance that maximises ``ll_shared`` on validation data: the mean squared error."""
    return float((truth - samples.mean(0)).square().mean())


def energy_score(samples: Tensor, truth: Tensor) -> Tensor:
    """Energy score (N, T) per step, E|X - x| - E|X - X'| / 2 (unbiased); lower is better."""
    n = len(samples)
    to_truth = (samples - truth).norm(dim=-1).mean(0)
    between = torch.zeros_like(to_truth)
    for shift in range(1, n):
        between += (samples[shift:] - samples[:-shift]).norm(dim=-1).sum(0)
    return to_truth - between / (n * (n - 1))


def coverage(samples: Tensor, truth: Tensor, level: float = 0.8) -> Tensor:
    """Share of dimensions (N, T) in which the truth lies within the samples' central interval of ``level``."""
    ordered, n = samples.sort(0).values, len(samples)
    low, high = (_between(ordered, q * (n - 1)) for q in ((1 - level) / 2, (1 + level) / 2))
    return ((truth >= low) & (truth <= high)).float().mean(-1)


def nrmse(samples: Tensor, truth: Tensor) -> Tensor:
    """Root mean squared error of the samples' mean over training standard deviation, at each step (T,)."""
    return (truth - samples.mean(0)).square().mean((0, 2)).sqrt()


def _between(ordered: Tensor, position: float) -> Tensor:
    """Linear interpolation between rows; torch.quantile takes no more than 16 million numbers."""
    below = min(int(position), len(ordered) - 2)
    return ordered[below].lerp(ordered[below + 1], position - below)


def _gaussian(error: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum(-1)
