"""Trajectory optimisation over actions (Eq. 2) or codes (Eq. 3), through any predictor.

    max over p of E[ sum_t r(x_t, u_t) ],   u = space.decode(p),   x ~ predict(u)

The paper's ``adam`` needs a differentiable prediction; ``cem`` and ``mppi`` sample and take any, so
that the oracle is the same planner with the true simulator as its model. All have the signature of
``base.Planner``. Noise is the search space's: ``DirectActions(..., smoothness=0)`` is white.

Letters in shapes: B targets planned for at once, C candidates for each, S model samples, T horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.checks import MOST, require_count, require_number, require_seed, require_type
from tsmlib.planning.base import Plan, Predictor, SearchSpace
from tsmlib.planning.search import (
    Search,
    best_of,
    expected_return,
    like,
    predicted,
    require_predictor,
)
from tsmlib.rewards import Reward, require_reward


@torch.enable_grad()  # see training.fit
def adam(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
    start: Tensor | int,
    *,
    iterations: int = 100,
    lr: float = 0.01,
    progress: str = "",
) -> Plan:
    """Gradient ascent on the expected return, as the paper plans (section 4.2).

    Args:
        predict: of actions (C, B, T, du) the states (S, C, B, T, dx), differentiable.
        reward: of states (..., B, T, dx) and actions (..., B, T, du), (..., B, T), differentiable.
        space: what is searched, ``DirectActions`` (Eq. 2) or ``LatentActions`` (Eq. 3).
        start: parameters (C, B, *shape) of C restarts, or the number of targets, to begin at zero.
        iterations: gradient steps; 0 judges the start alone.
        lr: learning rate of Adam.
        progress: title of the progress bar; none without.

    Returns:
        The plan; each target has the parameters with the best predicted return it ever had.

    Raises:
        ValueError: the return has no gradient with respect to the states.
        FloatingPointError: the gradient, or the return of every candidate, is not finite.
    """
    iterations = require_count("iterations", iterations, least=0, most=MOST)
    lr = require_number("lr", lr, 0, above=True)
    search = Search(predict, reward, space, start)
    parameters = search.start.clone().requires_grad_()
    optimizer = torch.optim.Adam([parameters], lr=lr)
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        actions = space.decode(parameters)
        states = predicted(predict, actions)
        returns = expected_return(states, actions, reward)
        if iteration == 0:
            _require_gradient(states, returns)
        search.update(parameters.detach(), returns.detach())
        # Of what is searched alone, not of weights.
        (gradient,) = torch.autograd.grad(-returns.sum(), parameters)
        sound = torch.isfinite(gradient)
        if iteration == 0 and not sound.all():
            raise FloatingPointError(
                "the gradient of the return is not finite at the start; look for a root or a norm "
                "at zero in the reward, and add a tiny constant under it"
            )
        parameters.grad = gradient.where(sound, 0)  # a restart stays where the model diverges
        optimizer.step()
    search.update(parameters.detach(), search.returns_of(parameters))
    return search.plan()


def cem(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
    start: Tensor | int,
    *,
    candidates: int = 256,
    elites: int = 24,
    iterations: int = 10,
    keep: float = 0.1,
    screened: float = 1.0,
    seed: int = 0,
    progress: str = "",
) -> Plan:
    """Cross-entropy method: sample around a mean, refit mean and deviation to the elites, repeat.

    Args:
        predict: of actions (C, B, T, du) the states (S, C, B, T, dx).
        reward: of states (..., B, T, dx) and actions (..., B, T, du), one number per step.
        space: what is searched, ``DirectActions`` (Eq. 2) or ``LatentActions`` (Eq. 3); its noise
            is what candidates are drawn with.
        start: parameters (C, B, *shape), the best of which is the first mean, or the number of
            targets, to begin at zero.
        candidates: sampled for each target in each iteration, at least 2.
        elites: the best candidates, to which mean and deviation are refitted, at least 2.
        iterations: at least 1.
        keep: share of the old mean and deviation that stays, against collapse; below 1.
        screened: share of the candidates that all parts of an ``EnsemblePredictor`` judge, those
            best by its first part; never fewer than the elites. 1: all candidates.
        seed: of the candidates, 0 or above.
        progress: title of the progress bar; none without.

    Returns:
        The plan: of each target the best candidate or mean ever seen.

    Raises:
        TypeError, ValueError: an argument that cannot be; the message names it.
        FloatingPointError: no candidate has a finite return, or the reward is NaN.
    """
    candidates = require_count("candidates", candidates, least=2, most=MOST)
    elites = require_count("elites", elites, least=2, most=MOST)
    if elites > candidates:
        raise ValueError(f"elites is {elites}; expected at most the {candidates} candidates")
    keep = require_number("keep", keep, 0, 1)
    screened = require_number("screened", screened, 0, 1)

    def refit(
        parameters: Tensor, returns: Tensor, centre: Tensor, deviation: Tensor
    ) -> tuple[Tensor, Tensor]:
        best = best_of(parameters, returns, elites)  # (elites, B, *shape)
        centre = keep * centre + (1 - keep) * best.mean(0)
        return centre, keep * deviation + (1 - keep) * best.std(0)

    judged = max(elites, round(screened * candidates))
    search = Search(predict, reward, space, start, judged=judged)
    return _sample(search, refit, candidates, iterations, seed, progress)


def mppi(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
    start: Tensor | int,
    *,
    candidates: int = 256,
    iterations: int = 10,
    temperature: float = 0.3,
    shrink: float = 0.8,
    seed: int = 0,
    progress: str = "",
) -> Plan:
    """Model predictive path integral control (Williams et al., 2017): a weighted mean.

        w_c ~ exp(R_c / (temperature * std(R)))        centre <- sum_c w_c parameters_c

    Beyond the original, the noise shrinks between iterations, so that many of them converge.

    Args:
        predict: of actions (C, B, T, du) the states (S, C, B, T, dx).
        reward: of states (..., B, T, dx) and actions (..., B, T, du), one number per step.
        space: what is searched, ``DirectActions`` (Eq. 2) or ``LatentActions`` (Eq. 3).
        start: parameters (C, B, *shape), the best of which is the first mean, or the number of
            targets, to begin at zero.
        candidates: sampled for each target in each iteration, at least 2.
        iterations: at least 1.
        temperature: in standard deviations of the candidates' returns, above 0.
        shrink: of the noise from one iteration to the next, above 0 and at most 1.
        seed: of the candidates, 0 or above.
        progress: title of the progress bar; none without.

    Returns:
        The plan: of each target the best candidate or mean ever seen.

    Raises:
        TypeError, ValueError: an argument that cannot be; the message names it.
        FloatingPointError: no candidate has a finite return, or the reward is NaN.
    """
    candidates = require_count("candidates", candidates, least=2, most=MOST)
    temperature = require_number("temperature", temperature, 0, above=True)
    shrink = require_number("shrink", shrink, 0, 1, above=True)

    def refit(
        parameters: Tensor, returns: Tensor, centre: Tensor, deviation: Tensor
    ) -> tuple[Tensor, Tensor]:
        spread = returns.std(0).clamp(min=1e-9)
        weights = ((returns - returns.max(0).values) / (temperature * spread)).softmax(0)
        return (like(weights, parameters) * parameters).sum(0), shrink * deviation

    search = Search(predict, reward, space, start)
    return _sample(search, refit, candidates, iterations, seed, progress)


Refit = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


@torch.no_grad()
def _sample(
    search: Search, refit: Refit, candidates: int, iterations: int, seed: int, progress: str
) -> Plan:
    """Sample candidates around a centre and move centre and deviation by ``refit``."""
    iterations = require_count("iterations", iterations, most=MOST)
    generator = torch.Generator().manual_seed(require_seed("seed", seed))
    # Candidates may do what the start cannot.
    search.update(search.start, search.returns_of(search.start), needed=False)
    centre = search.parameters
    deviation = torch.full_like(centre, search.space.scale)
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        noise = search.space.noise(candidates, len(centre), generator)
        parameters = centre + deviation * noise
        if iteration:
            parameters[0] = search.parameters
        returns, judged = search.returns_of_many(parameters)
        # A candidate on which the model diverges is as bad as the worst; one that was sorted out
        # is worse.
        finite = torch.isfinite(returns)
        worst = returns.where(finite, torch.inf).amin(0).nan_to_num(posinf=0.0)
        known = returns.where(finite, worst).where(judged, -torch.inf)
        centre, deviation = refit(parameters, known, centre, deviation)
        tried = torch.cat([parameters, centre[None]])
        search.update(tried, torch.cat([returns, search.returns_of(centre[None])]))
    return search.plan()


def _require_gradient(states: Tensor, returns: Tensor) -> None:
    instead = "plan with cem or mppi instead, which need no gradient"
    if not states.requires_grad:
        raise ValueError(
            "what predicts the states is not differentiable, as the true simulator is not; "
            + instead
        )
    slope = None
    if returns.requires_grad:
        (slope,) = torch.autograd.grad(returns.sum(), states, retain_graph=True, allow_unused=True)
    if slope is None:
        raise ValueError(
            "the reward is not a differentiable function of the states: a comparison, a rounding, "
            "NumPy or detach() cuts the gradient off. Write it with smooth torch functions, or "
            + instead
        )


@torch.no_grad()
def reevaluate(plan: Plan, predict: Predictor, reward: Reward) -> Plan:
    """The same plan with its return and states from fresh samples, which had no part in the choice.

    Args:
        plan: as a planner made it.
        predict: such as ``fresh_predictor(model, past, seed=...)``.
        reward: of states and actions, one number per step.

    Returns:
        The plan with new ``states`` and ``predicted_return``.
    """
    require_type("plan", plan, Plan, "a Plan, such as cem gives")
    require_predictor(predict)
    require_reward(reward)
    states = predicted(predict, plan.actions[None])
    predicted_return = expected_return(states, plan.actions[None], reward)[0]
    return replace(plan, states=states[:, 0], predicted_return=predicted_return)
