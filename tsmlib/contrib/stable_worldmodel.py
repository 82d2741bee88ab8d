"""Models and planners of this package in stable-worldmodel, which is not needed here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib.models.base import Model, as_dynamics, rollout
from tsmlib.planning.base import Plan
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment, initial_past

Info = Mapping[str, Tensor | np.ndarray]


class PlanConfig(Protocol):
    """What is read of their PlanConfig: T, and the actions in each of theirs."""

    horizon: int
    action_block: int


class Cost:
    """What stable-worldmodel calls a Costable: minus the return of each candidate (section 4).

    ``CEMSolver(Cost(model, task.reward), batch_size=len(task))`` searches with theirs what
    ``tsmlib.cem`` searches here.

    Args:
        model: any dynamics model.
        reward: of this package, for as many starts as the solver plans at once, its batch_size.
        key: under which its information holds states (B, S, dx) or histories (B, S, L, dx), in
            physical units, of which the last is taken.
        action_block: actions in each of theirs, as in their PlanConfig.
    """

    def __init__(
        self, model: Model, reward: Reward, *, key: str = "state", action_block: int = 1
    ) -> None:
        self.model, self.reward, self.key, self.action_block = model, reward, key, action_block

    def get_cost(self, info_dict: Info, action_candidates: Tensor) -> Tensor:
        """Compute the cost of candidates, by the mode of the model.

        Args:
            info_dict: states under ``key``.
            action_candidates: (B, S, T, block du), clipped to [-1, 1].

        Returns:
            (B, S), with gradients.

        Raises:
            KeyError: the information holds no such states; its keys are named.
            ValueError: a reward for another number of starts.
        """
        rows, samples, steps, _ = action_candidates.shape
        actions = action_candidates.clamp(-1, 1)
        actions = actions.reshape(rows, samples, steps * self.action_block, -1)
        x = _states(info_dict, self.key, 3).to(actions).expand(rows, samples, -1).flatten(0, 1)
        past = initial_past(x, as_dynamics(self.model).past_len, actions.shape[-1])
        states = rollout(self.model, past, actions.flatten(0, 1))
        states = states.unflatten(0, (rows, samples)).transpose(0, 1)  # (S, B, T, dx)
        return -rewarded(self.reward, states, actions.transpose(0, 1)).sum(-1).T

    criterion = get_cost  # the other name in their protocol


class Solver:
    """A search of this package as a Solver of theirs, which their WorldModelPolicy executes.

    Args:
        search: of a past (B, L, .), the plan of B starts.
        past_len: L, ``model.past_len``.
        key: as of ``Cost``, of states (B, dx) or histories (B, L, dx).
    """

    def __init__(
        self, search: Callable[[Segment], Plan], past_len: int, *, key: str = "state"
    ) -> None:
        self.search, self.past_len, self.key = search, past_len, key

    def configure(self, *, action_space: gymnasium.Space, n_envs: int, config: PlanConfig) -> None:
        """Take the sizes of the environments and of a plan."""
        self.n_envs, self.horizon = n_envs, config.horizon
        self.size = (action_space.shape or ())[-1]
        self.action_dim = self.size * config.action_block

    def solve(self, info_dict: Info, init_action: Tensor | None = None) -> dict[str, Tensor]:
        """Plan for the states in ``info_dict``: "actions" (B, T, block du) in [-1, 1]."""
        x = _states(info_dict, self.key, 2).float()
        plan = self.search(initial_past(x, self.past_len, self.size))
        return {"actions": plan.actions.reshape(len(x), self.horizon, self.action_dim)}

    __call__ = solve


def _states(info: Info, key: str, ndim: int) -> Tensor:
    """The states under a key, the last ones of histories."""
    if key not in info:
        raise KeyError(
            f"no {key!r} among {', '.join(info)}; name the one that holds the states of the model: "
            "key=..."
        )
    x = torch.as_tensor(info[key])
    return x.select(-2, -1) if x.ndim > ndim else x
