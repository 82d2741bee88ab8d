"""A model of this package behind the solvers of stable-worldmodel, which is not needed here."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from tsmlib.models.base import Model, as_dynamics, rollout
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import initial_past


class Cost:
    """What stable-worldmodel calls a Costable: minus the return of each candidate (section 4).

    ``CEMSolver(Cost(model, task.reward))`` searches with theirs what ``tsmlib.cem`` searches here.

    Args:
        model: any dynamics model.
        reward: of this package, for as many starts as the solver plans at once.
        key: under which its information holds states (B, S, dx) or histories (B, S, L, dx), in
            physical units, of which the last is taken.
    """

    def __init__(self, model: Model, reward: Reward, *, key: str = "state") -> None:
        self.model, self.reward, self.key = model, reward, key

    def get_cost(
        self, info_dict: Mapping[str, Tensor | np.ndarray], action_candidates: Tensor
    ) -> Tensor:
        """Compute the cost of candidates, by the mode of the model.

        Args:
            info_dict: states under ``key``.
            action_candidates: (B, S, T, du), clipped to [-1, 1].

        Returns:
            (B, S), with gradients.

        Raises:
            KeyError: the information holds no such states; its keys are named.
        """
        if self.key not in info_dict:
            raise KeyError(
                f"no {self.key!r} among {', '.join(info_dict)}; name the one that holds the states "
                "of the model: Cost(model, reward, key=...)"
            )
        rows, samples, _, size = action_candidates.shape
        actions = action_candidates.clamp(-1, 1)
        x = torch.as_tensor(info_dict[self.key]).to(actions)
        x = (x[:, :, -1] if x.ndim == 4 else x).expand(rows, samples, -1).flatten(0, 1)
        past = initial_past(x, as_dynamics(self.model).past_len, size)
        states = rollout(self.model, past, actions.flatten(0, 1))
        states = states.unflatten(0, (rows, samples)).transpose(0, 1)  # (S, B, T, dx)
        return -rewarded(self.reward, states, actions.transpose(0, 1)).sum(-1).T
