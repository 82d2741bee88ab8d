"""Open-loop and teacher-forced predictions of a model, scored (section 5.3.1). The scores are those
of ``scoring``.

Letters in shapes: S samples, N trajectories or segments, T predicted steps, D scored features.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.checks import MOST, require_count, require_seed, require_type
from tsmlib.evaluation.scoring import LEVELS, Fitted, coverage, fit, measure
from tsmlib.models.base import Model, as_dynamics, require_robot, rollout
from tsmlib.models.features import Features
from tsmlib.robot import warn_of_other_env
from tsmlib.sampling import generator_of
from tsmlib.trajectory import Segment, Trajectories

ROWS = 800  # samples times trajectories that are rolled out and scored at once
# where a sample that is not finite, or beyond, is kept: it counts as worst, and every score stays
# finite
WORST = 1e6


@dataclass(frozen=True)
class Scores:
    """One model's scores. The caller averages: over trajectories, over some of them, over the
    horizon.

    values: metric -> (N, T). pit: (N, T, D), the predictive distribution function at the truth,
    uniform on [0, 1] where calibrated. outside: (N,), the share of samples that leave the physical
    range or are not finite at any step.
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
        """Observed coverage (19,) of the central intervals of ``LEVELS``, over all steps or those
        of ``where``.
        """
        return torch.stack(
            [
                _mean(coverage(self.pit, float(level)).flatten(), _flat(where, self))
                for level in LEVELS
            ]
        )


@torch.no_grad()
def score(
    model: Model,
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
    """Score a model's predictions, with all that is fitted taken from validation data.

    Open loop with the true actions. Teacher-forced segments are starts=range(10, 100, 10) and
    horizon=10: each predicts H steps from the true past, and N counts segments, those of one
    trajectory after each other. Of episodes that end early, N counts the segments within them.

    Args:
        model: that predicts.
        features: of the training data, in whose units scores are: ``model.features``.
        test: episodes that are scored.
        validation: held-out episodes, on which variances and noise are fitted.
        samples: S, rollouts of each; their memory on validation is S N T D numbers.
        horizon: T, steps predicted.
        starts: steps observed before a prediction, at least 1.
        seed: of the samples.
        progress: title of the progress bar; none without.

    Returns:
        The scores, one number per trajectory and step.

    Raises:
        ValueError: model, features, test and validation data are not of one robot, or starts and
            horizon do not fit the episodes; both sides are named. Or a score is not finite.
    """
    _require_fit(model, features, test, validation)
    samples, seed = require_count("samples", samples, most=MOST), require_seed("seed", seed)
    rollouts = partial(
        _rollouts, model, samples=samples, horizon=horizon, starts=starts, progress=progress
    )
    low, high = physical_range(test, validation)
    held = list(rollouts(validation, key=(1, seed)))
    drawn = torch.cat([scored(features, states) for states, _ in held], 1)
    fitted = fit(
        drawn, torch.cat([scored(features, truth) for _, truth in held]), copies=samples, seed=seed
    )
    del held, drawn
    parts: list[tuple[dict[str, Tensor], Tensor, Tensor]] = []
    for states, truth in rollouts(test, key=(0, seed)):
        # NaN is outside.
        outside = ((states >= low) & (states <= high)).logical_not().any(-1).any(-1).float().mean(0)
        generator = generator_of(2, seed, len(parts))
        values, pit = measure(
            scored(features, states), scored(features, truth), fitted, samples, generator
        )
        parts.append((values, pit, outside))
    values = {metric: torch.cat([part[0][metric] for part in parts]) for metric in parts[0][0]}
    for metric, value in values.items():
        if not torch.isfinite(value).all():
            raise ValueError(
                f"the score '{metric}' is not finite; expected finite numbers: check the "
                "statistics of the model's features, and that its data move"
            )
    return Scores(
        values,
        torch.cat([part[1] for part in parts]),
        torch.cat([part[2] for part in parts]),
        fitted,
    )


def _require_fit(
    model: Model, features: Features, test: Trajectories, validation: Trajectories
) -> None:
    """An error unless all of it belongs together."""
    as_dynamics(model)
    require_type("features", features, Features, "tsmlib's Features, as model.features")
    for name, data in (("test", test), ("validation", validation)):
        require_type(name, data, Trajectories, "tsmlib.Trajectories")
    test.robot.require_same(validation.robot, "test and validation data")
    require_robot(model, test.robot, "the model and the test data", but=("env",))
    warn_of_other_env(getattr(model, "robot", None), test.robot, "the model and the test data")
    expected, found = len(features.step_std), test.robot.state_dim
    if expected != found or list(features.angles) != list(test.angles):
        raise ValueError(
            f"features are of {expected} states with angles {list(features.angles)}, those of "
            f"{test.env} {found} with angles {list(test.angles)}; expected those of a model that "
            f"was trained on {test.env}"
        )


def sample_states(
    model: Model,
    data: Trajectories,
    *,
    samples: int,
    horizon: int = 90,
    starts: Sequence[int] = (10,),
    seed: int = 0,
    progress: str = "",
) -> Tensor:
    """Open-loop samples (S, N, T, dx) in physical units, with the true actions after ``starts``
    observed steps.

    Column k holds the prediction of x_{start + k + 1}. N counts as in ``score``.
    A deterministic model gives one sample, whatever S.
    """
    blocks = _rollouts(
        model,
        data,
        samples=samples,
        horizon=horizon,
        starts=starts,
        key=(0, seed),
        progress=progress,
    )
    return torch.cat([states for states, _ in blocks], dim=1)


def scored(features: Features, states: Tensor) -> Tensor:
    """(..., dx) -> (..., D), the space of the scores. What is not finite becomes the worst that can
    be counted.

    ``features`` may be on another device; what is returned is where ``states`` are.
    """
    found = features(states.to(features.mean.device))[..., features.scored].to(states.device)
    return found.nan_to_num(nan=WORST).clamp(-WORST, WORST)


def cut(steps: Tensor, starts: Sequence[int], horizon: int) -> Tensor:
    """(N, T, ...) -> (N * len(starts), horizon, ...): columns start .. start + horizon, in the
    order of ``score``.
    """
    return torch.stack([steps[:, start : start + horizon] for start in starts], 1).flatten(0, 1)


def physical_range(*data: Trajectories) -> tuple[Tensor, Tensor]:
    """Lowest and highest state (dx,) that counts as physical: the range of the data, half as wide
    again at each end.

    Angles may be anything finite.
    """
    states = np.concatenate([part.flat_states for part in data])
    low, high = (torch.from_numpy(edge) for edge in (states.min(0), states.max(0)))
    margin = 0.5 * (high - low) + 1e-6 * torch.maximum(high.abs(), low.abs())
    low, high, angles = low - margin, high + margin, list(data[0].angles)
    low[angles], high[angles] = -torch.finfo(low.dtype).max, torch.finfo(low.dtype).max
    return low, high


@torch.no_grad()
def _rollouts(
    model: Model,
    data: Trajectories,
    *,
    samples: int,
    horizon: int,
    starts: Sequence[int],
    key: tuple[int, int],  # of the random numbers: which set of data, and the seed
    progress: str,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Blocks of trajectories: states (S, n, T, dx) and truth (n, T, dx). Blocks are independent."""
    horizon = require_count("horizon", horizon)
    require_type("starts", starts, Iterable, "steps observed before a prediction, such as (10,)")
    starts = [require_count("a start", start) for start in starts]
    if not starts or horizon > data.horizon - max(starts):
        raise ValueError(
            f"starts {list(starts)} and horizon {horizon} do not fit: at least one step "
            "is observed first, and "
            f"episodes have {data.horizon}"
        )
    data.window_counts(min(starts) + horizon, "scores")  # warns of those that are left out
    inside = torch.from_numpy(data.steps[:, None] >= np.array(starts) + horizon)
    episodes, which = inside.nonzero(as_tuple=True)  # in the order of episodes, then of starts
    past_len, stochastic = as_dynamics(model).past_len, as_dynamics(model).stochastic
    window = data.windows(episodes, torch.tensor(starts)[which], past_len, horizon)
    past, (truth, actions) = window.past, window.future
    rows = torch.arange(len(truth))
    if not stochastic:
        point = torch.cat(
            [rollout(model, Segment(*(p[b] for p in past)), actions[b]) for b in rows.split(ROWS)]
        )
    blocks = rows.split(max(1, ROWS // samples))
    for index, block in enumerate(tqdm(blocks, desc=progress, disable=not progress)):
        if stochastic:
            many = block.repeat(samples)  # (S * n,)
            states = rollout(
                model,
                Segment(*(part[many] for part in past)),
                actions[many],
                generator=generator_of(*key, index),
            )
            yield states.unflatten(0, (samples, len(block))), truth[block]
        else:
            yield point[block][None], truth[block]


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
