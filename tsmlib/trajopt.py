"""Trajectory optimisation through a model or the true simulator, over actions (Eq. 2) or latent codes (Eq. 3).

    max over p of E[ sum_t r(x_t, u_t) ],   u = space.decode(p),   x ~ predict(u)

What is optimised over is a ``Space``: DirectActions (Eq. 2) or LatentActions (Eq. 3). What predicts is a function
from actions to states: ``through_model`` or ``through_simulator``. Adam, as the paper plans, needs a differentiable
one; CEM takes both, so that the oracle is the same planner with the true simulator as its model.

Letters in shapes: B targets planned at once, C candidates for each, S model samples, T horizon, K segments.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Protocol

import gymnasium
import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.collect import collect, once, smooth_torques
from tsmlib.dynamics import DynamicsModel, rollout
from tsmlib.nets import SharedNoise
from tsmlib.prior import ActionPrior
from tsmlib.rewards import Reward
from tsmlib.trajectory import Segment

Predict = Callable[[Tensor], Tensor]  # actions (C, B, T, du) -> sampled states (S, C, B, T, dx)


class Space(Protocol):
    """What a planner searches: parameters that decode to bounded actions."""

    shape: tuple[int, ...]  # of one target's parameters
    scale: float  # standard deviation of parameters whose actions are like the training data's

    def decode(self, parameters: Tensor) -> Tensor:
        """(C, B, *shape) -> actions (C, B, T, du) in [-1, 1]."""
        ...

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        """Perturbations (n, n_targets, *shape) of unit variance."""
        ...


class DirectActions:
    """Eq. 2: the torques themselves, squashed to the bounds by tanh. Its noise is as smooth as the training torques."""

    def __init__(self, horizon: int, action_dim: int = 2, *, rms: float = 0.1) -> None:
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, expected a positive number of steps")
        self.shape: tuple[int, ...] = (horizon, action_dim)
        self.scale = rms

    def decode(self, parameters: Tensor) -> Tensor:
        return parameters.tanh()

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        (horizon, action_dim), settle = self.shape, 20  # steps until the smooth noise has its full variance
        torques = smooth_torques(n * n_targets, settle + horizon, generator=generator, action_dim=action_dim, rms=0.1)
        return torques[:, settle:].unflatten(0, (n, n_targets)) / 0.1


class LatentActions:
    """Eq. 3: one latent code per segment, decoded by the action prior from U_0 = 0. T must be a multiple of H."""

    scale = 1.0

    def __init__(self, prior: ActionPrior, horizon: int) -> None:
        if horizon < 1 or horizon % prior.segment_len:
            raise ValueError(
                f"a horizon of {horizon} steps is not a whole number of segments of {prior.segment_len}; "
                f"choose {max(1, horizon // prior.segment_len) * prior.segment_len}"
            )
        self.prior = prior
        self.shape: tuple[int, ...] = (horizon // prior.segment_len, prior.latent_dim)

    def decode(self, parameters: Tensor) -> Tensor:
        codes = parameters.flatten(0, 1)
        start = codes.new_zeros(len(codes), self.prior.past_len, len(self.prior.std))
        return self.prior.plan(start, codes).unflatten(0, parameters.shape[:2])

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        return torch.randn(n, n_targets, *self.shape, generator=generator)


@dataclass(frozen=True)
class Plan:
    """The best actions found for each of B targets.

    actions (B, T, du); parameters (B, *shape) they decode from; states (S, B, T, dx) predicted for them;
    predicted (B,): expected undiscounted return; curve (iterations, B): predicted return along the way; seconds.
    """

    actions: Tensor
    parameters: Tensor
    states: Tensor
    predicted: Tensor
    curve: Tensor
    seconds: float


def through_model(model: DynamicsModel, past: Segment, *, samples: int = 1, seed: int = 0) -> Predict:
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


def through_simulator(env_id: str, start: np.ndarray) -> Predict:
    """Predict by executing in the true simulator, in bulk, from ``start`` (B, dx): S = 1. Not differentiable."""
    make = cache(partial(gymnasium.make_vec, env_id))

    def predict(actions: Tensor) -> Tensor:
        n, n_targets, horizon, _ = actions.shape
        env = make(num_envs=n * n_targets)
        seen = collect(env, once(actions.flatten(0, 1)), horizon=horizon, states=np.tile(start, (n, 1)))
        return torch.from_numpy(seen.states[:, 1:]).unflatten(0, (n, n_targets))[None]

    return predict


def adam(
    predict: Predict,
    reward: Reward,
    space: Space,
    start: Tensor,
    *,
    iterations: int = 100,  # section 4.2
    lr: float = 0.01,  # section 4.2
    progress: str = "",
) -> Plan:
    """Gradient ascent on the expected return, as the paper plans, from ``start`` (C, B, *shape).

    C restarts run side by side; each target keeps the parameters with the best predicted return it ever had.
    """
    if iterations < 0:
        raise ValueError(f"iterations is {iterations}, expected 0 or more")
    began = time.perf_counter()
    parameters = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([parameters], lr=lr)
    best = _Best(start)
    for _ in tqdm(range(iterations), desc=progress, disable=not progress):
        actions = space.decode(parameters)
        returns = expected_return(predict(actions), actions, reward)
        best.update(parameters.detach(), returns.detach())
        optimizer.zero_grad()
        (-returns.sum()).backward()
        optimizer.step()
    with torch.no_grad():
        best.update(parameters.detach(), evaluate(predict, reward, space, parameters))
    return best.plan(predict, reward, space, time.perf_counter() - began)


@torch.no_grad()
def cem(
    predict: Predict,
    reward: Reward,
    space: Space,
    n_targets: int,
    *,
    candidates: int = 256,
    elites: int = 24,
    iterations: int = 10,
    keep: float = 0.1,  # of the old mean and deviation, against collapse
    seed: int = 0,
    progress: str = "",
) -> Plan:
    """Cross-entropy method: sample around a mean, refit mean and deviation to the elites, keep the best ever seen."""
    if not 2 <= elites <= candidates or iterations < 1:
        raise ValueError(
            f"candidates is {candidates}, elites {elites}, iterations {iterations}; expected 2 <= elites <= candidates "
            "and at least one iteration"
        )
    began = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    mean = torch.zeros(n_targets, *space.shape)
    deviation = torch.full_like(mean, space.scale)
    best = _Best(mean[None])
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        parameters = mean + deviation * space.noise(candidates, n_targets, generator)
        if iteration:
            parameters[0], parameters[1] = mean, best.parameters
        returns = evaluate(predict, reward, space, parameters)
        best.update(parameters, returns)
        chosen = returns.topk(elites, dim=0).indices  # (elites, B)
        elite = parameters.gather(
            0, chosen.reshape(*chosen.shape, *[1] * len(space.shape)).expand(-1, -1, *space.shape)
        )
        mean = keep * mean + (1 - keep) * elite.mean(0)
        deviation = keep * deviation + (1 - keep) * elite.std(0)
    return best.plan(predict, reward, space, time.perf_counter() - began)


@torch.no_grad()
def reassess(plan: Plan, predict: Predict, reward: Reward) -> Plan:
    """The same plan with ``predicted`` and ``states`` from fresh samples.

    A planner picks what does best under the few samples that it plans with; what the model promises is the
    expectation, and needs samples that had no part in the choice.
    """
    states = predict(plan.actions[None])
    return replace(plan, states=states[:, 0], predicted=expected_return(states, plan.actions[None], reward)[0])


@torch.no_grad()
def sampled_starts(
    predict: Predict,
    reward: Reward,
    space: Space,
    n_targets: int,
    *,
    candidates: int = 256,
    keep: int = 4,
    seed: int = 0,
) -> Tensor:
    """The ``keep`` best of random candidates for each target, as starts (keep, B, *shape) for ``adam``.

    Where nothing is pushed before contact there is no gradient either, so a start must already touch the object.
    """
    if not 1 <= keep <= candidates:
        raise ValueError(f"keep is {keep} of {candidates} candidates, expected 1 to {candidates}")
    parameters = space.scale * space.noise(candidates, n_targets, torch.Generator().manual_seed(seed))
    chosen = evaluate(predict, reward, space, parameters).topk(keep, dim=0).indices
    return parameters.gather(0, chosen.reshape(*chosen.shape, *[1] * len(space.shape)).expand(-1, -1, *space.shape))


def expected_return(states: Tensor, actions: Tensor, reward: Reward) -> Tensor:
    """Undiscounted return (C, B), mean over the S samples of states (S, C, B, T, dx)."""
    return reward(states, actions).sum(-1).mean(0)


@torch.no_grad()
def evaluate(predict: Predict, reward: Reward, space: Space, parameters: Tensor, *, rows: int = 6400) -> Tensor:
    """Expected return (C, B) of parameters (C, B, *shape), about ``rows`` candidates at a time to bound memory."""
    returns = []
    for chunk in parameters.split(max(1, rows // parameters.shape[1])):
        actions = space.decode(chunk)
        returns.append(expected_return(predict(actions), actions, reward))
    return torch.cat(returns)


class _Best:
    """Per target, the parameters with the highest predicted return so far."""

    def __init__(self, start: Tensor) -> None:
        self.parameters = start[0].clone()
        self.returns = start.new_full((start.shape[1],), -torch.inf)
        self.curve: list[Tensor] = []

    def update(self, parameters: Tensor, returns: Tensor) -> None:
        if not torch.isfinite(returns).all():
            raise FloatingPointError(
                f"{(~torch.isfinite(returns)).sum().item()} of {returns.numel()} candidates have a predicted return "
                "that is not finite; the model or the reward diverges on them"
            )
        value, index = returns.max(0)
        better = value > self.returns
        chosen = parameters[index, torch.arange(len(index))]
        self.parameters = torch.where(better.reshape(-1, *[1] * (chosen.ndim - 1)), chosen, self.parameters)
        self.returns = torch.where(better, value, self.returns)
        self.curve.append(self.returns)

    @torch.no_grad()
    def plan(self, predict: Predict, reward: Reward, space: Space, seconds: float) -> Plan:
        actions = space.decode(self.parameters[None])
        states = predict(actions)
        return Plan(
            actions=actions[0],
            parameters=self.parameters,
            states=states[:, 0],
            predicted=expected_return(states, actions, reward)[0],
            curve=torch.stack(self.curve),
            seconds=seconds,
        )
