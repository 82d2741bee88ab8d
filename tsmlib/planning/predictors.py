"""Predictors: candidate actions to states, through a model or through the true simulator."""

from functools import cache, partial

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib.collection import collect, open_loop
from tsmlib.models.base import Model, as_dynamics, rollout
from tsmlib.planning.base import Predictor
from tsmlib.sampling import SharedNoise
from tsmlib.trajectory import Segment

FRESH = 32  # samples behind a predicted return that is reported


def model_predictor(model: Model, past: Segment, *, samples: int = 0, seed: int = 0) -> Predictor:
    """Predict by rolling out ``model`` from ``past`` (B, L, .): its mode, or samples of it.

    samples: 0 rolls out the mode (z = 0) of every candidate, S = 1; n draws n samples of each, S = n, with the same
    noise, a function of ``seed``, for every candidate and call. ValueError for samples of a deterministic model.
    """
    if samples < 0:
        raise ValueError(f"samples is {samples}, expected 0 (the mode) or a positive number of samples")
    if samples and not as_dynamics(model).stochastic:
        raise ValueError(
            f"{samples} samples of {type(model).__name__} asked for, but it is deterministic: its one rollout is the "
            "mode, samples=0"
        )
    draws = max(samples, 1)

    def predict(actions: Tensor) -> Tensor:
        n, n_targets = actions.shape[:2]
        rows = actions[:, None].expand(-1, draws, -1, -1, -1).flatten(0, 2)  # (C S B, T, du)
        pasts = Segment(*(part.repeat(n * draws, 1, 1) for part in past))
        noise = SharedNoise(torch.Generator().manual_seed(seed), draws * n_targets) if samples else None
        states = rollout(model, pasts, rows, generator=noise)
        return states.unflatten(0, (n, draws, n_targets)).transpose(0, 1)

    return predict


def fresh_predictor(model: Model, past: Segment, *, seed: int, samples: int = FRESH) -> Predictor:
    """What the return of a finished plan is predicted with: samples that had no part in choosing it.

    ``seed`` must not be the planner's. A deterministic model has no samples: its one rollout predicts.
    """
    return model_predictor(model, past, samples=samples if as_dynamics(model).stochastic else 0, seed=seed)


def simulator_predictor(env_id: str, start: np.ndarray) -> Predictor:
    """Predict by executing in the true simulator, in bulk, from ``start`` (B, dx): S = 1. Not differentiable.

    Any state can be a start, also one in the middle of an episode. In MuJoCo what follows is what would have followed,
    up to rounding; in pymunk, contacts that last forget the force with which they press.
    """
    make = cache(partial(gymnasium.make_vec, env_id))

    def predict(actions: Tensor) -> Tensor:
        n, n_targets, horizon, _ = actions.shape
        env = make(num_envs=n * n_targets)
        seen = collect(env, open_loop(actions.flatten(0, 1)), horizon=horizon, states=np.tile(start, (n, 1)))
        return torch.from_numpy(seen.states[:, 1:]).unflatten(0, (n, n_targets))[None]

    return predict
