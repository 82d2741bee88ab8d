"""Gradients of the return: their errors (claim C07) and their signal to noise (claim C13, section
4.2).

Letters in shapes: B starts, S model samples, K segments, T horizon, dz and du size of code and
action.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.planners import expected_return
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.trajectory import Segment

STEPS = 1e-7, 1e-8
ROUNDING = 1e-6  # relative: a deviation below it is that of float32


def relative_errors(
    value: Callable[[], Tensor], variables: Sequence[Tensor], *, steps: Sequence[float] = STEPS
) -> list[float]:
    """Errors of derivatives by autograd against central differences, relative to the former, one
    number per variable.

    value: a function of no arguments that gives a number; variables: leaves of type float64 that it
    reads, as they are again afterwards. Each is moved along its gradient plus a random direction.
    steps: so small that the curvature of a long rollout with contacts does not count, whose share
    falls with their square; the smallest error counts, since a ReLU may bend within one.
    ValueError where the number does not depend on one of them.
    """
    gradients = torch.autograd.grad(value(), variables, allow_unused=True)
    draw, found = torch.Generator().manual_seed(5), []
    for i, (variable, gradient) in enumerate(zip(variables, gradients, strict=True)):
        if gradient is None or not gradient.norm() > 0:
            raise ValueError(
                f"variable {i}, {tuple(variable.shape)}, has no gradient: the value "
                "does not depend on it"
            )
        direction = gradient / gradient.norm() + 0.1 * torch.randn(
            gradient.shape, generator=draw
        ).to(gradient)
        expected, errors = float((gradient * direction).sum()), []
        for step in steps:
            ends = []
            for sign in (1, -1):
                with torch.no_grad():
                    variable.add_(sign * step * direction)
                    ends.append(float(value()))
                    variable.sub_(sign * step * direction)
            errors.append(abs((ends[0] - ends[1]) / (2 * step) - expected) / abs(expected))
        found.append(min(errors))
    return found


def of_return(
    task: Task, model: nn.Module, prior: ActionPrior, *, seed: int = 0
) -> dict[str, float]:
    """The largest of ``relative_errors`` of the expected return of ``task`` through model, prior
    and reward, by what it is a function of: random codes, random torques, the weights of the model,
    the weights of the prior.

    Of copies in float64, with two model samples. Weights that play no part, those of the encoders,
    are left out.
    """
    net: Any = deepcopy(model).double().requires_grad_()
    prior = deepcopy(prior).double().requires_grad_()
    past = Segment(*(part.double() for part in task.past(net.past_len)))
    predict = model_predictor(net, past, samples=2 if net.stochastic else 0, seed=seed)
    draw = torch.Generator().manual_seed(seed)

    def errors(space: SearchSpace, parts: dict[str, list[Tensor]]) -> dict[str, float]:
        point = (space.scale * space.noise(1, len(task), draw)).double().requires_grad_()

        def value() -> Tensor:
            actions = space.decode(point)
            return expected_return(predict(actions), actions, task.reward).sum()

        word = "codes" if isinstance(space, LatentActions) else "torques"
        return {
            part: max(relative_errors(value, some))
            for part, some in {word: [point], **parts}.items()
        }

    weights = {"model": _playing(net), "prior": _playing(prior)}
    return errors(LatentActions(prior, task.horizon), weights) | errors(
        DirectActions(task.horizon, task.action_dim, rms=0.1), {}
    )


def _playing(net: nn.Module) -> list[Tensor]:
    """The weights that a prediction depends on."""
    return [p for key, p in net.named_parameters() if not key.startswith("encoder")]


def signal(
    task: Task, model: DynamicsModel, space: SearchSpace, *, samples: int = 32, seed: int = 0
) -> Tensor:
    """Signal to noise of the gradient that a planner follows: |mean| / standard deviation over
    ``samples`` samples of the model, for each variable; of these the geometric mean, at one random
    point of ``space`` per start: (B,).

    A deviation within rounding of the mean counts as that: the ratio ends where a model ignores its
    codes.
    """
    points = space.scale * space.noise(1, len(task), torch.Generator().manual_seed(seed))
    past, gradients = task.past(model.past_len), []
    for i in range(samples):
        parameters = points.clone().requires_grad_()
        actions = space.decode(parameters)
        states = model_predictor(model, past, samples=1, seed=seed + 1 + i)(actions)
        (slope,) = torch.autograd.grad(
            expected_return(states, actions, task.reward).sum(), parameters
        )
        gradients.append(slope[0].flatten(1).double())
    drawn = torch.stack(gradients)  # (S, B, variables)
    mean, deviation = drawn.mean(0).abs(), drawn.std(0)
    ratio = mean / torch.maximum(deviation, ROUNDING * mean).clamp_min(1e-300)
    return ratio.clamp_min(ROUNDING).log().mean(1).exp()
