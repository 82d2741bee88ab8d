"""Predictors: candidate actions to states, through a model or through the true simulator."""

from functools import cache, partial

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib.collection import collect, open_loop
from tsmlib.models.base import Model, rollout
from tsmlib.planning.base import Predictor
from tsmlib.sampling import SharedNoise
from tsmlib.trajectory import Segment


def model_predictor(model: Model, past: Segment, *, samples: int = 1, seed: int = 0) -> Predictor:
    """Predict by rolling out ``model`` from ``past`` (B, L, .), with the same noise for every candidate and call.

    samples: S model samples per candidate; 0 rolls out the mode (z = 0) instead.
    """
    draws = max(samples, 1)

    def predict(actions: Tensor) -> Tensor:
        n, n_targets = actions.shape[:2]
        rows = actions[:, None].expand(-1, draws, -1, -1, -1).flatten(0, 2)  # (C S B, T, du)
        pasts = Segment(*(part.repeat(n * draws, 1, 1) for part in past))
        noise = SharedNoise(torch.Generator().manual_seed(seed), draws * n_targets) if samples else None
        states = rollout(model, pasts, rows, generator=noise)
        return states.unflatten(0, (n, draws, n_targets)).transpose(0, 1)

    return predict


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
