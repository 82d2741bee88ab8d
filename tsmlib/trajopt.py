"""Trajectory optimisation through a model or the true simulator, over actions (Eq. 2) or latent codes (Eq. 3).

    max over p of E[ sum_t r(x_t, u_t) ],   u = space.decode(p),   x ~ predict(u)

What is optimised over is a ``Space``: DirectActions (Eq. 2) or LatentActions (Eq. 3). What predicts is a function
from actions to states: ``through_model`` or ``through_simulator``. A ``Planner`` is ``adam``, as the paper plans,
which needs a differentiable prediction, or ``cem`` or ``mppi``, which sample and take any prediction, so that the
oracle is the same planner with the true simulator as its model. All three have one signature.

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
from tsmlib.nets import SharedNoise, beside
from tsmlib.prior import ActionPrior
from tsmlib.rewards import Reward, rewarded
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

    def after(self, parameters: Tensor, steps: int) -> tuple[Space, Tensor]:
        """What is left when ``steps`` actions of a plan (B, *shape) are done: the space, and the plan in it."""
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

    def after(self, parameters: Tensor, steps: int) -> tuple[DirectActions, Tensor]:
        return DirectActions(self.shape[0] - steps, self.shape[1], rms=self.scale), parameters[:, steps:]


class LatentActions:
    """Eq. 3: one latent code per segment, decoded by the action prior. T must be a multiple of H.

    past: the actions before the plan (B, L, du), U_0 = 0 without. whole: refuse a horizon that is no multiple of H;
    if not, the end of the last segment is cut off.
    """

    scale = 1.0

    def __init__(self, prior: ActionPrior, horizon: int, *, past: Tensor | None = None, whole: bool = True) -> None:
        n_segments = -(-horizon // prior.segment_len)
        if horizon < 1 or (whole and n_segments * prior.segment_len != horizon):
            raise ValueError(
                f"a horizon of {horizon} steps is not a whole number of segments of {prior.segment_len}; "
                f"choose {max(1, horizon // prior.segment_len) * prior.segment_len}"
            )
        self.prior, self.horizon, self.past = prior, horizon, past
        self.shape: tuple[int, ...] = (n_segments, prior.latent_dim)

    def decode(self, parameters: Tensor) -> Tensor:
        return self._whole(parameters)[:, :, : self.horizon]

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        return torch.randn(n, n_targets, *self.shape, generator=generator)

    @torch.no_grad()
    def after(self, parameters: Tensor, steps: int) -> tuple[LatentActions, Tensor]:
        """Codes that begin with a segment stay as they are. Otherwise the rest of the plan is cut into new segments,
        and its codes are those that the prior's encoder gives them: nearly the same actions."""
        prior, left = self.prior, self.horizon - steps
        actions = self._whole(parameters[None])[0]  # (B, K H, du)
        past = torch.cat([self._before(len(actions)).to(actions.device), actions[:, :steps]], dim=1)[
            :, -prior.past_len :
        ]
        space = LatentActions(prior, left, past=past, whole=False)
        done, within = divmod(steps, prior.segment_len)
        if not within:
            return space, parameters[:, done:]
        rest = actions[:, steps : steps + space.shape[0] * prior.segment_len]
        missing = space.shape[0] * prior.segment_len - rest.shape[1]
        rest = torch.cat([rest, rest[:, -1:].expand(-1, missing, -1)], dim=1)
        codes, _ = prior.encode(*beside(prior, rest.reshape(-1, prior.segment_len, rest.shape[2])))
        return space, codes.to(parameters.device).unflatten(0, (len(rest), -1))

    def _whole(self, parameters: Tensor) -> Tensor:
        """Actions (C, B, K H, du)."""
        n, n_targets = parameters.shape[:2]
        start = self._before(n_targets).repeat(n, 1, 1)
        actions = self.prior.plan(*beside(self.prior, start, parameters.flatten(0, 1)))
        return actions.to(parameters.device).unflatten(0, (n, n_targets))

    def _before(self, n_targets: int) -> Tensor:
        if self.past is not None:
            return self.past
        return torch.zeros(n_targets, self.prior.past_len, len(self.prior.std), dtype=self.prior.std.dtype)


@dataclass(frozen=True)
class Plan:
    """The best actions found for each of B targets.

    actions (B, T, du); parameters (B, *shape) they decode from; states (S, B, T, dx) predicted for them;
    predicted (B,): expected undiscounted return; curve (iterations + 1, B): predicted return of the best so far, from
    the start on; seconds; trace (iterations + 1, B, *shape): the parameters of the best so far, see ``stopped``.
    """

    actions: Tensor
    parameters: Tensor
    states: Tensor
    predicted: Tensor
    curve: Tensor
    seconds: float
    trace: Tensor | None = None


class Planner(Protocol):
    """``adam``, ``cem`` or ``mppi``, with its settings bound by ``functools.partial``."""

    def __call__(self, predict: Predict, reward: Reward, space: Space, start: Tensor | int, /) -> Plan:
        """Plan from parameters ``start`` (C, B, *shape), or for ``start`` targets from zero. Never worse than it."""
        ...


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
    """Predict by executing in the true simulator, in bulk, from ``start`` (B, dx): S = 1. Not differentiable.

    Any state can be a start, also one in the middle of an episode. In MuJoCo what follows is what would have followed,
    up to rounding; in pymunk, contacts that last forget the force with which they press.
    """
    make = cache(partial(gymnasium.make_vec, env_id))

    def predict(actions: Tensor) -> Tensor:
        n, n_targets, horizon, _ = actions.shape
        env = make(num_envs=n * n_targets)
        seen = collect(env, once(actions.flatten(0, 1)), horizon=horizon, states=np.tile(start, (n, 1)))
        return torch.from_numpy(seen.states[:, 1:]).unflatten(0, (n, n_targets))[None]

    return predict


@torch.enable_grad()  # see train.fit
def adam(
    predict: Predict,
    reward: Reward,
    space: Space,
    start: Tensor | int,
    *,
    iterations: int = 100,  # section 4.2
    lr: float = 0.01,  # section 4.2
    progress: str = "",
) -> Plan:
    """Gradient ascent on the expected return, as the paper plans, from ``start`` (C, B, *shape) or zero.

    C restarts run side by side; each target keeps the parameters with the best predicted return it ever had.
    ValueError where the return has no gradient with respect to the states or the actions.
    """
    if iterations < 0:
        raise ValueError(f"iterations is {iterations}, expected 0 or more")
    began = time.perf_counter()
    start = _parameters(start, space)
    parameters = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([parameters], lr=lr)
    best = _Best(start)
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        actions = space.decode(parameters)
        states = predict(actions)
        returns = expected_return(states, actions, reward)
        if not iteration:
            _check_gradient(states, returns)
        best.update(parameters.detach(), returns.detach())
        optimizer.zero_grad()
        (-returns.sum()).backward()
        assert parameters.grad is not None
        sound = torch.isfinite(parameters.grad)
        if not iteration and not sound.all():
            raise FloatingPointError(
                "the gradient of the return is not finite at the start; look for a root or a norm at zero in the "
                "reward, and add a tiny constant under it"
            )
        parameters.grad[~sound] = 0  # where the model diverges later on, a restart stays
        optimizer.step()
    with torch.no_grad():
        best.update(parameters.detach(), evaluate(predict, reward, space, parameters))
    return best.plan(predict, reward, space, time.perf_counter() - began)


def _check_gradient(states: Tensor, returns: Tensor) -> None:
    instead = "plan with cem or mppi instead, which need no gradient"
    if not states.requires_grad:
        raise ValueError(f"what predicts the states is not differentiable, as the true simulator is not; {instead}")
    slope = None
    if returns.requires_grad:
        (slope,) = torch.autograd.grad(returns.sum(), states, retain_graph=True, allow_unused=True)
    if slope is None:
        raise ValueError(
            "the reward is not a differentiable function of the states: a comparison, a rounding, NumPy or detach() "
            f"cuts the gradient off. Write it with smooth torch functions, or {instead}"
        )


def cem(
    predict: Predict,
    reward: Reward,
    space: Space,
    start: Tensor | int,
    *,
    candidates: int = 256,
    elites: int = 24,
    iterations: int = 10,
    keep: float = 0.1,  # of the old mean and deviation, against collapse
    seed: int = 0,
    progress: str = "",
) -> Plan:
    """Cross-entropy method: sample around a mean, refit mean and deviation to the elites, keep the best ever seen.

    The mean begins at the best of ``start`` (C, B, *shape), or at zero for as many targets.
    """
    if not 2 <= elites <= candidates or iterations < 1:
        raise ValueError(
            f"candidates is {candidates}, elites {elites}, iterations {iterations}; expected 2 <= elites <= candidates "
            "and at least one iteration"
        )

    def refit(parameters: Tensor, returns: Tensor, mean: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
        chosen = returns.topk(elites, dim=0).indices  # (elites, B)
        elite = parameters.gather(0, _like(chosen, parameters).expand(-1, -1, *space.shape))
        return keep * mean + (1 - keep) * elite.mean(0), keep * deviation + (1 - keep) * elite.std(0)

    return _sample(predict, reward, space, start, refit, candidates, iterations, seed, progress)


def mppi(
    predict: Predict,
    reward: Reward,
    space: Space,
    start: Tensor | int,
    *,
    candidates: int = 256,
    iterations: int = 10,
    temperature: float = 0.3,  # in standard deviations of the candidates' returns
    shrink: float = 0.8,  # of the noise, from one iteration to the next
    seed: int = 0,
    progress: str = "",
) -> Plan:
    """Model predictive path integral control (Williams et al., 2017): the mean moves to a weighted mean of candidates.

        w_c ~ exp(R_c / (temperature * std(R)))        mean <- sum_c w_c parameters_c

    Beyond the original, the noise shrinks from one iteration to the next, so that many iterations converge.
    """
    if candidates < 2 or iterations < 1 or not temperature > 0 or not 0 < shrink <= 1:
        raise ValueError(
            f"candidates is {candidates}, iterations {iterations}, temperature {temperature}, shrink {shrink}; "
            "expected 2 or more, 1 or more, above 0, and above 0 to 1"
        )

    def refit(parameters: Tensor, returns: Tensor, mean: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
        spread = returns.std(0).clamp(min=1e-9)
        weights = ((returns - returns.max(0).values) / (temperature * spread)).softmax(0)
        return (_like(weights, parameters) * parameters).sum(0), shrink * deviation

    return _sample(predict, reward, space, start, refit, candidates, iterations, seed, progress)


Refit = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


@torch.no_grad()
def _sample(
    predict: Predict, reward: Reward, space: Space, start: Tensor | int, refit: Refit,
    candidates: int, iterations: int, seed: int, progress: str,
) -> Plan:  # fmt: skip
    """Sample candidates around a mean and move mean and deviation by ``refit``; the best ever seen, or mean, wins."""
    began = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    start = _parameters(start, space)
    best = _Best(start)
    best.update(start, evaluate(predict, reward, space, start))
    mean = best.parameters
    deviation = torch.full_like(mean, space.scale)
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        parameters = mean + deviation * space.noise(candidates, len(mean), generator)
        if iteration:
            parameters[0] = best.parameters
        returns = evaluate(predict, reward, space, parameters)
        finite = torch.isfinite(returns)  # a candidate on which the model diverges is as bad as the worst
        worst = returns.where(finite, torch.inf).amin(0).nan_to_num(posinf=0.0)
        returns = returns.where(finite, worst)
        mean, deviation = refit(parameters, returns, mean, deviation)
        both = torch.cat([returns, evaluate(predict, reward, space, mean[None])])
        best.update(torch.cat([parameters, mean[None]]), both)
    return best.plan(predict, reward, space, time.perf_counter() - began)


def _parameters(start: Tensor | int, space: Space) -> Tensor:
    """``start`` as parameters (C, B, *shape)."""
    if isinstance(start, int):
        return torch.zeros(1, start, *space.shape)
    if start.shape[2:] != space.shape or start.ndim != 2 + len(space.shape):
        raise ValueError(f"start is {tuple(start.shape)}, expected (C, B, {', '.join(map(str, space.shape))})")
    return start


def _like(values: Tensor, parameters: Tensor) -> Tensor:
    """(C, B) with as many dimensions as ``parameters``."""
    return values.reshape(*values.shape, *[1] * (parameters.ndim - 2))


@torch.no_grad()
def reassess(plan: Plan, predict: Predict, reward: Reward) -> Plan:
    """The same plan with ``predicted`` and ``states`` from fresh samples.

    A planner picks what does best under the few samples that it plans with; what the model promises is the
    expectation, and needs samples that had no part in the choice.
    """
    states = predict(plan.actions[None])
    return replace(plan, states=states[:, 0], predicted=expected_return(states, plan.actions[None], reward)[0])


@torch.no_grad()
def stopped(plan: Plan, iteration: int, predict: Predict, reward: Reward, space: Space) -> Plan:
    """The plan as it was after ``iteration`` steps of its planner (0: its start), to see what more of them earned.

    ``predicted`` and ``states`` come from ``predict``: as in ``reassess``, give it samples of its own.
    """
    if plan.trace is None or not 0 <= iteration < len(plan.trace):
        steps = "kept no trace" if plan.trace is None else f"took {len(plan.trace) - 1} iterations"
        raise ValueError(f"the planner {steps}; there is no plan as of iteration {iteration}")
    parameters = plan.trace[iteration]
    found = replace(
        plan, parameters=parameters, actions=space.decode(parameters[None])[0],
        curve=plan.curve[: iteration + 1], trace=plan.trace[: iteration + 1],
    )  # fmt: skip
    return reassess(found, predict, reward)


def iterations_to(curve: Tensor, share: float = 0.95) -> Tensor:
    """After how many iterations a plan's ``curve`` (iterations + 1, B) has ``share`` of all that it gains: (B,).

    A curve that gains nothing is there from the start (claim C15).
    """
    return (curve >= curve[0] + share * (curve[-1] - curve[0])).int().argmax(0)


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
    return parameters.gather(0, _like(chosen, parameters).expand(-1, -1, *space.shape))


def expected_return(states: Tensor, actions: Tensor, reward: Reward) -> Tensor:
    """Undiscounted return (C, B), mean over the S samples of states (S, C, B, T, dx). Checks what the reward gives."""
    return rewarded(reward, states, actions).sum(-1).mean(0)


@torch.no_grad()
def evaluate(predict: Predict, reward: Reward, space: Space, parameters: Tensor, *, rows: int = 1600) -> Tensor:
    """Expected return (C, B) of parameters (C, B, *shape), about ``rows`` at a time, which fit in a cache."""
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
        self.trace: list[Tensor] = []

    def update(self, parameters: Tensor, returns: Tensor) -> None:
        value, index = returns.where(torch.isfinite(returns), -torch.inf).max(0)
        hopeless = torch.isinf(torch.maximum(value, self.returns))
        if hopeless.any():
            raise FloatingPointError(
                f"no candidate for target {int(hopeless.nonzero()[0])} has a predicted return that is finite; the "
                "model diverges on all of them, or the reward is infinite"
            )
        better = value > self.returns
        chosen = parameters[index, torch.arange(len(index))]
        self.parameters = torch.where(better.reshape(-1, *[1] * (chosen.ndim - 1)), chosen, self.parameters)
        self.returns = torch.where(better, value, self.returns)
        self.curve.append(self.returns)
        self.trace.append(self.parameters)

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
            trace=torch.stack(self.trace),
        )
