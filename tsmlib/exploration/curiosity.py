"""What leads exploration elsewhere: a bonus on disagreement, and plans that are disturbed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tsmlib.planning.base import Plan, Planner, Predictor, SearchSpace
from tsmlib.rewards import Reward, rewarded


def with_bonus(reward: Reward, *, weight: float, scale: Tensor) -> Reward:
    """``reward`` plus ``weight`` times the disagreement of sampled states (S, C, B, T, dx); one
    rollout has none.

    scale (dx,): the data's standard deviation, in which disagreement is measured where the data
    move.
    """

    def total(states: Tensor, actions: Tensor) -> Tensor:
        plain = rewarded(reward, states, actions)
        if states.ndim < 5:
            return plain
        spread = states.std(0, unbiased=False, keepdim=True) / scale.where(scale > 0, torch.inf)
        return plain + weight * spread.mean(-1)

    return total


@dataclass
class Perturbed:
    """A planner whose plans are disturbed before they are executed."""

    planner: Planner
    deviation: float
    generator: torch.Generator

    def __call__(
        self, predict: Predictor, reward: Reward, space: SearchSpace, start: Tensor | int, /
    ) -> Plan:
        plan = self.planner(predict, reward, space, start)
        noise = space.noise(1, len(plan.parameters), self.generator)[0]
        parameters = plan.parameters + self.deviation * space.scale * noise
        with torch.no_grad():
            return replace(plan, parameters=parameters, actions=space.decode(parameters[None])[0])
