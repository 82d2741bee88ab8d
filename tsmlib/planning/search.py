"""What all planners share: one guard of arguments, the returns of candidates, the best so far.

Letters in shapes: B targets, C candidates for each, S model samples, T horizon.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import MOST, as_tensor, described, require_callable, require_count
from tsmlib.models.layers import BLOCK
from tsmlib.planning.base import Plan, Predictor, SearchSpace
from tsmlib.planning.predictors import EnsemblePredictor
from tsmlib.rewards import Reward, require_reward, rewarded


def predicted(predict: Predictor, actions: Tensor) -> Tensor:
    """States (S, C, B, T, dx) of actions (C, B, T, du); ValueError where they are others."""
    states = predict(actions)
    if not isinstance(states, Tensor) or states.ndim != 5 or states.shape[1:4] != actions.shape[:3]:
        raise ValueError(
            f"the predictor gave {described(states)} for actions (C, B, T, du) = "
            f"{tuple(actions.shape)}; expected states (S, C, B, T, dx)"
        )
    return states


def expected_return(states: Tensor, actions: Tensor, reward: Reward) -> Tensor:
    """Undiscounted return (C, B), mean over the samples of states (S, C, B, T, dx)."""
    return rewarded(reward, states, actions).sum(-1).mean(0)


@torch.no_grad()
def evaluate(predict: Predictor, reward: Reward, space: SearchSpace, parameters: Tensor) -> Tensor:
    """What candidates are judged by, the mean over samples as in the paper (Eqs. 2 and 3).

    Args:
        predict: of actions (C, B, T, du) the states (S, C, B, T, dx).
        reward: of states and actions, one number per step.
        space: decodes the parameters.
        parameters: (C, B, *shape).

    Returns:
        (C, B).
    """
    return _returns(predict, reward, _decoded(space, parameters)).mean(0)


def like(values: Tensor, parameters: Tensor) -> Tensor:
    """(C, B) with as many dimensions as ``parameters`` (C, B, *shape)."""
    return values.reshape(*values.shape, *[1] * (parameters.ndim - values.ndim))


def best_of(parameters: Tensor, returns: Tensor, n: int) -> Tensor:
    """The n parameters with the highest returns (C, B) of each target, best first."""
    best = returns.topk(n, dim=0).indices
    return parameters.gather(0, like(best, parameters).expand(-1, -1, *parameters.shape[2:]))


def _decoded(space: SearchSpace, parameters: Tensor) -> Tensor:
    chunks = parameters.split(max(1, BLOCK // parameters.shape[1]))
    return torch.cat([space.decode(chunk) for chunk in chunks])


def _returns(predict: Predictor, reward: Reward, actions: Tensor) -> Tensor:
    """The return of each sample (S, C, B), rolled out so many candidates at a time."""
    chunks = actions.split(max(1, BLOCK // actions.shape[1]))
    returns = [rewarded(reward, predicted(predict, part), part).sum(-1) for part in chunks]
    return torch.cat(returns, dim=1)


class Search:
    """One run of a planner: for each target the parameters with the highest return so far.

    Args:
        predict: of actions (C, B, T, du) the states (S, C, B, T, dx).
        reward: of states and actions, one number per step.
        space: what is searched.
        start: parameters (C, B, *shape), or the number of targets, to begin at zero.
        judged: candidates that all parts of an ``EnsemblePredictor`` judge, of many; 0: all.

    Raises:
        TypeError: an argument of another kind.
        ValueError: a start or actions of another shape.
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
        require_predictor(predict)
        require_reward(reward)
        require_space(space)
        self.predict, self.reward, self.space = predict, reward, space
        self.judged = judged
        self.start = _starts(space, start)
        self.began = time.perf_counter()
        self.parameters = self.start[0].clone()
        self.returns = self.start.new_full((self.start.shape[1],), -torch.inf)
        self.curve: list[Tensor] = []

    def returns_of(self, parameters: Tensor) -> Tensor:
        """What candidates (C, B, *shape) are judged by: (C, B)."""
        return evaluate(self.predict, self.reward, self.space, parameters)

    def returns_of_many(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """``returns_of``, and which candidates were judged, (C, B) bool each.

        The first part of an ensemble sorts out all but the ``judged`` best, whose return is -inf.
        """
        if not 0 < self.judged < len(parameters) or not isinstance(self.predict, EnsemblePredictor):
            returns = self.returns_of(parameters)
            return returns, torch.ones_like(returns, dtype=torch.bool)
        first, *others = self.predict.each
        actions = _decoded(self.space, parameters)
        rough = _returns(first, self.reward, actions).mean(0)
        rough = rough.where(torch.isfinite(rough), -torch.inf)
        best = rough.topk(self.judged, dim=0).indices  # (judged, B)
        chosen = actions.gather(0, like(best, actions).expand(-1, -1, *actions.shape[2:]))
        judgements = [_returns(other, self.reward, chosen) for other in others]
        returns = torch.cat([rough.gather(0, best)[None], *judgements]).mean(0)
        judged_by_all = torch.zeros_like(rough, dtype=torch.bool).scatter(0, best, True)
        return torch.full_like(rough, -torch.inf).scatter(0, best, returns), judged_by_all

    def update(self, parameters: Tensor, returns: Tensor, *, needed: bool = True) -> None:
        """Keep what is better; FloatingPointError where a finite return is ``needed``."""
        value, index = returns.where(torch.isfinite(returns), -torch.inf).max(0)
        hopeless = torch.isinf(torch.maximum(value, self.returns))
        if needed and hopeless.any():
            raise FloatingPointError(
                f"no candidate for target {int(hopeless.nonzero()[0])} has a predicted return that "
                "is finite; the model diverges on all of them, or the reward is infinite"
            )
        better = value > self.returns
        chosen = parameters[index, torch.arange(len(index))]
        self.parameters = torch.where(like(better, chosen), chosen, self.parameters)
        self.returns = torch.where(better, value, self.returns)
        self.curve.append(self.returns)

    @torch.no_grad()
    def plan(self) -> Plan:
        """The best so far."""
        actions = self.space.decode(self.parameters[None])
        states = predicted(self.predict, actions)
        return Plan(
            actions=actions[0],
            parameters=self.parameters,
            states=states[:, 0],
            predicted_return=expected_return(states, actions, self.reward)[0],
            curve=torch.stack(self.curve),
            seconds=time.perf_counter() - self.began,
            start=getattr(self.predict, "start", None),
            robot=getattr(self.predict, "robot", None),
        )


def require_predictor(predict: object) -> None:
    if hasattr(predict, "begin") or hasattr(predict, "predict_segment"):
        raise TypeError(
            f"predict is {described(predict)}, a model; expected a predictor through it: "
            "tsmlib.model_predictor(model, task.past(model.past_len))"
        )
    hint = "tsmlib.model_predictor(model, past) or tsmlib.simulator_predictor(task)"
    require_callable("predict", predict, f"a predictor, such as {hint}")


def require_space(space: object) -> None:
    missing = [n for n in ("shape", "scale", "decode", "noise") if not hasattr(space, n)]
    if missing or isinstance(space, type):
        raise TypeError(
            f"space is {described(space)}; expected what is searched: tsmlib.DirectActions("
            "horizon, action_dim, rms=...) or tsmlib.LatentActions(prior, horizon)"
        )


def _starts(space: SearchSpace, start: object) -> Tensor:
    """Starting parameters (C, B, *shape), whose actions are bounded."""
    if isinstance(start, int | float | np.number | str | bool) or start is None:
        n_targets = require_count("start, the number of targets,", start, most=MOST)
        parameters = torch.zeros(1, n_targets, *space.shape)
    else:
        parameters = as_tensor("start", start, ("C", "B", *space.shape)).detach()
        if not parameters.numel():
            raise ValueError(f"start has shape {tuple(parameters.shape)}; expected at least one")
    with torch.no_grad():
        actions = space.decode(parameters[:1])
    if actions.ndim != 4 or actions.shape[:2] != parameters[:1].shape[:2]:
        raise ValueError(
            f"the search space decodes {tuple(parameters[:1].shape)} to {described(actions)}; "
            "expected actions (C, B, T, du)"
        )
    if actions.isnan().any() or actions.abs().max() > 1 + 1e-6:
        raise ValueError(
            f"the search space decodes to actions up to {float(actions.abs().max()):g}; expected "
            "them within [-1, 1]"
        )
    return parameters
