"""Latent codes of a segment model (section 5.3.4).

At test time codes are drawn from the model's prior, and from the encoder where the future is known.
Deviations and errors are in units of the training data's deviation (the feature space of
``evaluation.prediction``).

Letters in shapes: S samples, N windows of test episodes, T steps, H segment length, dz code size.
"""

import math

import torch
from torch import Tensor

from reproduction.measures.futures import Coded, SampledFutures
from tsmlib.evaluation import prediction, scoring
from tsmlib.models.features import Features
from tsmlib.models.layers import kl_from_standard_normal, sample_posterior
from tsmlib.models.tsm import TSM
from tsmlib.sampling import standard_normal
from tsmlib.trajectory import Segment, Window

# Variance of a unit's posterior mean above which it counts as active (Burda et al., 2016).
ACTIVE = 0.01


def kl_by_dimension(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(Q(Z_i) || N(0, 1)) in nats of each code dimension and segment, (N, dz).

    Args:
        mean: (N, dz), of the encoder.
        log_variance: (N, dz).
    """
    return kl_from_standard_normal(mean[..., None], log_variance[..., None])


def active_units(mean: Tensor) -> Tensor:
    """(dz,) bool: dimensions whose posterior mean (N, dz) varies by more than ACTIVE."""
    return mean.var(0) > ACTIVE


@torch.no_grad()
def total_effects(model: Coded, window: Window, generator: torch.Generator) -> Tensor:
    """Total effect of each code dimension on the next segment, (dz,), in deviations of the data.

    The root of E[(f(z) - f(z with z_i drawn anew))^2] / 2, mean over features, steps and windows.
    Says what the decoder does with a code of the prior however it was trained; the encoder has no
    part in it.
    """
    past, actions = window.past, window.future.actions[:, : model.code_len]
    z, again = (
        standard_normal((len(actions), model.latent_dim), generator, actions) for _ in range(2)
    )
    states = model.decode(past, actions, z)
    moved = []
    for i in range(model.latent_dim):
        other = torch.where(torch.arange(model.latent_dim) == i, again, z)
        difference = model.features.difference(model.decode(past, actions, other), states)
        moved.append((difference.square().mean() / 2).sqrt())
    return torch.stack(moved)


@torch.no_grad()
def reconstruction(model: TSM, window: Window, generator: torch.Generator) -> dict[str, Tensor]:
    """Error (N,) of the next segment, root mean square over features and steps, by its code.

    ``posterior``: drawn from Q, which has seen the segment; ``prior``: drawn from N(0, I);
    ``zero``: z = 0.
    """
    future = Segment(*(part[:, : model.code_len] for part in window.future))
    codes = {
        "posterior": sample_posterior(*model.encode(future.states), generator),
        "prior": model.draw(window.past, generator),
        "zero": model.draw(window.past, None),
    }
    errors = {}
    for word, z in codes.items():
        difference = model.features.difference(
            model.decode(window.past, future.actions, z), future.states
        )
        errors[word] = difference.square().mean((1, 2)).sqrt()
    return errors


def deviations(seen: SampledFutures, features: Features) -> tuple[Tensor, Tensor]:
    """Variance of the samples, and squared error of their mean: (N, T) each, mean over the features
    that change.
    """
    samples = prediction.scored(features, seen.samples)
    error = samples.mean(0) - prediction.scored(features, seen.window.future.states)
    return scoring.spread(samples).mean(-1), error.square().mean(-1)


def root_mean(squares: Tensor, where: Tensor | None = None) -> float:
    """The root of the mean of squares (N, T): over windows (at the places ``where``) first, then
    over steps.

    Every step counts alike, so that places which lie later than others do not look worse for it.
    NaN without a place.
    """
    where = torch.ones_like(squares, dtype=torch.bool) if where is None else where
    some = where.any(0)
    by_step = (squares * where).sum(0)[some] / where.sum(0)[some]
    return math.sqrt(by_step.mean()) if some.any() else math.nan


def directions(codes: Tensor, outcome: Tensor) -> tuple[Tensor, float]:
    """The directions (2, dz) of codes (N, dz) along which an outcome (N, 2) changes most,
    orthonormal, most first.

    By least squares; also the share of the outcome's variance that a linear function of the code
    explains.
    """
    x, y = codes - codes.mean(0), outcome - outcome.mean(0)
    slope = torch.linalg.lstsq(x, y).solution  # (dz, 2)
    explained = 1 - float((y - x @ slope).square().sum() / y.square().sum().clamp_min(1e-30))
    return torch.linalg.svd(slope, full_matrices=False).U.T, explained
