"""Trajectory optimisation through a model or the true simulator, over actions (Eq. 2) or latent codes (Eq. 3).

    max over p of E[ sum_t r(x_t, u_t) ],   u = space.decode(p),   x ~ predict(u)

The paper's ``adam`` needs a differentiable prediction; ``cem`` and ``mppi`` sample and take any, so that the oracle is
the same planner with the true simulator as its model. All three have one signature, that of ``base.Planner``.

Letters in shapes: B targets planned at once, C candidates for each, S model samples, T horizon, K segments.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.models.layers import BLOCK
from tsmlib.planning.base import Plan, Predictor, SearchSpace
from tsmlib.planning.predictors import EnsemblePredictor
from tsmlib.rewards import Reward, rewarded


@torch.enable_grad()  # see training.fit
def adam(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
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
    search = _Search(predict, reward, space, start)
    parameters = search.start.clone().requires_grad_()
    optimizer = torch.optim.Adam([parameters], lr=lr)
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        actions = space.decode(parameters)
        states = predict(actions)
        returns = expected_return(states, actions, reward)
        if not iteration:
            _check_gradient(states, returns)
        search.update(parameters.detach(), returns.detach())
        (gradient,) = torch.autograd.grad(
            -returns.sum(), parameters
        )  # of what is searched alone, not of weights
        sound = torch.isfinite(gradient)
        if not iteration and not sound.all():
            raise FloatingPointError(
                "the gradient of the return is not finite at the start; look for a root or a norm at zero in the "
                "reward, and add a tiny constant under it"
            )
        parameters.grad = gradient.where(
            sound, 0
        )  # where the model diverges later on, a restart stays
        optimizer.step()
    search.update(parameters.detach(), search.returns_of(parameters))
    return search.plan()


def _check_gradient(states: Tensor, returns: Tensor) -> None:
    instead = "plan with cem or mppi instead, which need no gradient"
    if not states.requires_grad:
        raise ValueError(
            f"what predicts the states is not differentiable, as the true simulator is not; {instead}"
        )
    slope = None
    if returns.requires_grad:
        (slope,) = torch.autograd.grad(returns.sum(), states, retain_graph=True, allow_unused=True)
    if slope is None:
        raise ValueError(
            "the reward is not a differentiable function of the states: a comparison, a rounding, NumPy or detach() "
            f"cuts the gradient off. Write it with smooth torch functions, or {instead}"
        )


def cem(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
    start: Tensor | int,
    *,
    candidates: int = 256,
    elites: int = 24,
    iterations: int = 10,
    keep: float = 0.1,  # of the old mean and deviation, against collapse
    screened: float = 1.0,
    seed: int = 0,
    progress: str = "",
) -> Plan:
    """Cross-entropy method: sample around a mean, refit mean and deviation to the elites, keep the best ever seen.

    The mean begins at the best of ``start`` (C, B, *shape), or at zero for as many targets.

    screened: where several judge (``EnsemblePredictor``: an ensemble's members, or a model's mode and samples), the
    share of the candidates that all judge, those best by the first; never fewer than the elites. 1: all candidates.
    """
    if not 2 <= elites <= candidates or iterations < 1 or not 0 <= screened <= 1:
        raise ValueError(
            f"candidates is {candidates}, elites {elites}, iterations {iterations}, screened {screened}; expected "
            "2 <= elites <= candidates, at least one iteration and a share from 0 to 1"
        )

    def refit(
        parameters: Tensor, returns: Tensor, mean: Tensor, deviation: Tensor
    ) -> tuple[Tensor, Tensor]:
        chosen = returns.topk(elites, dim=0).indices  # (elites, B)
        elite = parameters.gather(0, _like(chosen, parameters).expand(-1, -1, *space.shape))
        return keep * mean + (1 - keep) * elite.mean(0), keep * deviation + (1 - keep) * elite.std(
            0
        )

    search = _Search(
        predict, reward, space, start, judged=max(elites, round(screened * candidates))
    )
    return _sample(search, refit, candidates, iterations, seed, progress)


def mppi(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
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

    def refit(
        parameters: Tensor, returns: Tensor, mean: Tensor, deviation: Tensor
    ) -> tuple[Tensor, Tensor]:
        spread = returns.std(0).clamp(min=1e-9)
        weights = ((returns - returns.max(0).values) / (temperature * spread)).softmax(0)
        return (_like(weights, parameters) * parameters).sum(0), shrink * deviation

    return _sample(
        _Search(predict, reward, space, start), refit, candidates, iterations, seed, progress
    )


Refit = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


@torch.no_grad()
def _sample(
    search: _Search, refit: Refit, candidates: int, iterations: int, seed: int, progress: str
) -> Plan:
    """Sample candidates around a mean and move mean and deviation by ``refit``; the best ever seen, or mean, wins."""
    generator, space = torch.Generator().manual_seed(seed), search.space
    search.update(
        search.start, search.returns_of(search.start), needed=False
    )  # candidates may do what it cannot
    mean = search.parameters
    deviation = torch.full_like(mean, space.scale)
    for iteration in tqdm(range(iterations), desc=progress, disable=not progress):
        parameters = mean + deviation * space.noise(candidates, len(mean), generator)
        if iteration:
            parameters[0] = search.parameters
        returns, judged = search.returns_of_many(parameters)
        # To the refit a candidate on which the model diverges is as bad as the worst, one that was sorted out worse.
        finite = torch.isfinite(returns)
        worst = returns.where(finite, torch.inf).amin(0).nan_to_num(posinf=0.0)
        mean, deviation = refit(
            parameters, returns.where(finite, worst).where(judged, -torch.inf), mean, deviation
        )
        search.update(
            torch.cat([parameters, mean[None]]), torch.cat([returns, search.returns_of(mean[None])])
        )
    return search.plan()


def _like(values: Tensor, parameters: Tensor) -> Tensor:
    """(C, B) with as many dimensions as ``parameters``."""
    return values.reshape(*values.shape, *[1] * (parameters.ndim - 2))


@torch.no_grad()
def reevaluate(plan: Plan, predict: Predictor, reward: Reward) -> Plan:
    """The same plan with its predicted return and states from fresh samples, which had no part in the choice."""
    states = predict(plan.actions[None])
    return replace(
        plan,
        states=states[:, 0],
        predicted_return=expected_return(states, plan.actions[None], reward)[0],
    )


@torch.no_grad()
def plan_at(
    plan: Plan, iteration: int, predict: Predictor, reward: Reward, space: SearchSpace
) -> Plan:
    """The plan as it was after ``iteration`` steps of its planner (0: its start).

    Its predicted return and states come from ``predict``: as in ``reevaluate``, give it samples of its own.
    """
    if plan.trace is None or not 0 <= iteration < len(plan.trace):
        steps = "kept no trace" if plan.trace is None else f"took {len(plan.trace) - 1} iterations"
        raise ValueError(f"the planner {steps}; there is no plan as of iteration {iteration}")
    parameters = plan.trace[iteration]
    found = replace(
        plan,
        parameters=parameters,
        actions=space.decode(parameters[None])[0],
        curve=plan.curve[: iteration + 1],
        trace=plan.trace[: iteration + 1],
    )
    return reevaluate(found, predict, reward)


def iterations_to(curve: Tensor, share: float = 0.95) -> Tensor:
    """After how many iterations a plan's ``curve`` (iterations + 1, B) has ``share`` of all that it gains: (B,).

    A curve that gains nothing is there from the start (claim C15). It begins with its first finite value.
    """
    first = curve.gather(0, curve.isfinite().int().argmax(0, keepdim=True))[0]
    return (curve >= first + share * (curve[-1] - first)).int().argmax(0)


@torch.no_grad()
def sampled_starts(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
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
    parameters = space.scale * space.noise(
        candidates, n_targets, torch.Generator().manual_seed(seed)
    )
    returns = evaluate(predict, reward, space, parameters)
    best = returns.where(torch.isfinite(returns), -torch.inf).topk(keep, dim=0).indices
    return parameters.gather(0, _like(best, parameters).expand(-1, -1, *space.shape))


def expected_return(states: Tensor, actions: Tensor, reward: Reward) -> Tensor:
    """Undiscounted return (C, B), mean over the S samples of states (S, C, B, T, dx). Checks what the reward gives."""
    return rewarded(reward, states, actions).sum(-1).mean(0)


@torch.no_grad()
def evaluate(
    predict: Predictor, reward: Reward, space: SearchSpace, parameters: Tensor, *, rows: int = BLOCK
) -> Tensor:
    """Expected return (C, B) of parameters (C, B, *shape), up to ``rows`` candidates at a time, times
    their targets, each with its samples."""
    return _returns(predict, reward, _decoded(space, parameters, rows=rows), rows=rows)


def _decoded(space: SearchSpace, parameters: Tensor, *, rows: int = BLOCK) -> Tensor:
    """The actions (C, B, T, du) of parameters (C, B, *shape), decoded up to ``rows`` at a time."""
    return torch.cat(
        [space.decode(chunk) for chunk in parameters.split(max(1, rows // parameters.shape[1]))]
    )


def _returns(predict: Predictor, reward: Reward, actions: Tensor, *, rows: int = BLOCK) -> Tensor:
    """Expected return (C, B) of actions (C, B, T, du); rows: as of ``evaluate``."""
    return _sample_returns(predict, reward, actions, rows=rows).mean(0)


def _sample_returns(
    predict: Predictor, reward: Reward, actions: Tensor, *, rows: int = BLOCK
) -> Tensor:
    """The return of each sample (S, C, B); rows: as of ``evaluate``."""
    chunks = actions.split(max(1, rows // actions.shape[1]))
    return torch.cat([rewarded(reward, predict(chunk), chunk).sum(-1) for chunk in chunks], dim=1)


class _Search:
    """One run of a planner: per target, the parameters with the highest predicted return so far.

    judged: the number of candidates that a whole ensemble judges, of many; 0: all.
    """

    def __init__(
        self,
        predict: Predictor,
        reward: Reward,
        space: SearchSpace,
        start: Tensor | int,
        *,
        judged: int = 0,
    ) -> None:
        if isinstance(start, int):
            start = torch.zeros(1, start, *space.shape)
        if start.shape[2:] != space.shape or start.ndim != 2 + len(space.shape):
            raise ValueError(
                f"start is {tuple(start.shape)}, expected (C, B, {', '.join(map(str, space.shape))})"
            )
        self.predict, self.reward, self.space, self.start = predict, reward, space, start
        self.judged = judged
        self.began = time.perf_counter()
        self.parameters = start[0].clone()
        self.returns = start.new_full((start.shape[1],), -torch.inf)
        self.curve: list[Tensor] = []
        self.trace: list[Tensor] = []

    def returns_of(self, parameters: Tensor) -> Tensor:
        return evaluate(self.predict, self.reward, self.space, parameters)

    def returns_of_many(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """``returns_of``, and which candidates were judged (C, B) bool: the ``judged`` best by the first member of an
        ensemble; the return of the others is -inf."""
        if not 0 < self.judged < len(parameters) or not isinstance(self.predict, EnsemblePredictor):
            returns = self.returns_of(parameters)
            return returns, torch.ones_like(returns, dtype=torch.bool)
        first, *others = self.predict.each
        actions = _decoded(self.space, parameters)
        rough = _returns(first, self.reward, actions)
        rough = rough.where(torch.isfinite(rough), -torch.inf)
        best = rough.topk(self.judged, dim=0).indices
        chosen = actions.gather(0, _like(best, actions).expand(-1, -1, *actions.shape[2:]))
        judged = [_sample_returns(other, self.reward, chosen) for other in others]
        returns = torch.cat([rough.gather(0, best)[None], *judged]).mean(0)
        judged_by_all = torch.zeros_like(rough, dtype=torch.bool).scatter(0, best, True)
        return torch.full_like(rough, -torch.inf).scatter(0, best, returns), judged_by_all

    def update(self, parameters: Tensor, returns: Tensor, *, needed: bool = True) -> None:
        """Keep what is better; FloatingPointError where nothing finite is found until now, and it is ``needed``."""
        value, index = returns.where(torch.isfinite(returns), -torch.inf).max(0)
        hopeless = torch.isinf(torch.maximum(value, self.returns))
        if needed and hopeless.any():
            raise FloatingPointError(
                f"no candidate for target {int(hopeless.nonzero()[0])} has a predicted return that is finite; the "
                "model diverges on all of them, or the reward is infinite"
            )
        better = value > self.returns
        chosen = parameters[index, torch.arange(len(index))]
        self.parameters = torch.where(_like(better[None], chosen[None])[0], chosen, self.parameters)
        self.returns = torch.where(better, value, self.returns)
        self.curve.append(self.returns)
        self.trace.append(self.parameters)

    @torch.no_grad()
    def plan(self) -> Plan:
        actions = self.space.decode(self.parameters[None])
        states = self.predict(actions)
        return Plan(
            actions=actions[0],
            parameters=self.parameters,
            states=states[:, 0],
            predicted_return=expected_return(states, actions, self.reward)[0],
            curve=torch.stack(self.curve),
            seconds=time.perf_counter() - self.began,
            trace=torch.stack(self.trace),
        )
