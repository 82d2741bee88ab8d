"""A learned value that stands for the rest of an episode, so that gradients stay short.

    J   = sum_{k<H} gamma^k r_k + gamma^H V'(x_H, g)                        what a policy improves
    R_k = r_k + gamma ((1 - lambda) V'(x_{k+1}, g) + lambda R_{k+1})        what V(x_k, g) learns

V' is a slow average of V. Episodes are cut into pieces of H steps: each update goes on where the
one before it ended, and what is over begins anew. As SHAC (Xu et al., 2022) does in a simulator.

Letters in shapes: as in ``networks``; H steps of a piece.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from tsmlib.models.base import Model
from tsmlib.policies.imagination import imagined_past
from tsmlib.policies.networks import OneStepPolicy, Policy
from tsmlib.policies.options import LearningOptions
from tsmlib.trajectory import Segment, initial_past

Lesson = tuple[Tensor, Tensor]  # states (R, H, dx) and the returns (R, H) from each of them

HIDDEN = 256  # units of the value's two layers
LAMBDA = 0.95
RATE = 0.5  # of the value's Adam, as a share of the policy's
SLOW = 0.02  # by which V' follows V at each of its updates


def discounted(rewards: Tensor, gamma: float) -> Tensor:
    """sum_t gamma^t r_t over the last dimension, the first step in full (Eq. 4 up to gamma)."""
    steps = torch.arange(rewards.shape[-1], dtype=rewards.dtype, device=rewards.device)
    return (rewards * gamma**steps).sum(-1)


class Bootstrap(nn.Module):
    """A policy, its value, and the episodes that are under way, as a checkpoint holds them.

    Args:
        policy: that learns.
        model: that it learns in.
        options: the schedule.
        seed: of the value's weights.
    """

    states: Tensor
    actions: Tensor
    target: Tensor
    left: Tensor

    def __init__(self, policy: Policy, model: Model, options: LearningOptions, seed: int) -> None:
        super().__init__()
        self.options, self.policy = options, policy
        self.value = OneStepPolicy(
            policy.state_dim,
            1,
            policy.target_dim,
            angles=tuple(policy.features.angles),
            hidden=HIDDEN,
            target_std=policy.target_std,
            places=policy.places,
            seed=seed,
        )
        like = next(policy.parameters())
        self.value.to(like)
        self.value.features.load_state_dict(policy.features.state_dict())
        self.slow = deepcopy(self.value).requires_grad_(False)
        rows, steps = options.episodes, imagined_past(policy, model)
        self.register_buffer("states", like.new_zeros(rows, steps, policy.state_dim))
        self.register_buffer("actions", like.new_zeros(rows, steps, policy.action_dim))
        self.register_buffer("target", like.new_zeros(rows, policy.target_dim))
        # Steps that are left; first ones end one after the other.
        self.register_buffer("left", -(torch.arange(rows) * options.horizon // rows))

    def begin(self, start: Tensor, target: Tensor) -> tuple[Segment, Tensor]:
        """Pasts and targets of the next piece.

        Args:
            start: (R, dx), where episodes begin that take the place of those that are over.
            target: (R, dg), theirs.

        Returns:
            Pasts (R, L, .) and targets (R, dg).
        """
        over = self.left <= 0
        fresh = initial_past(start, self.states.shape[1], self.actions.shape[2])
        self.states[over] = fresh.states.to(self.states)[over]
        self.actions[over] = 0.0
        self.target[over] = target.to(self.target)[over]
        self.left[over] += self.options.horizon
        return Segment(self.states.clone(), self.actions.clone()), self.target.clone()

    def objective(self, seen: Segment, rewards: Tensor) -> tuple[Tensor, Lesson]:
        """J of each episode, and what the value is to learn; what was seen becomes the past.

        Args:
            seen: states (R, H, dx) and actions (R, H, du).
            rewards: (R, H).

        Returns:
            J (R,), with a gradient; and the lesson.
        """
        gamma, steps, before = self.options.gamma, rewards.shape[1], self.states[:, -1:]
        last = self._values(self.slow, seen.states[:, -1:])[..., 0]
        objective = discounted(rewards, gamma) + gamma**steps * last
        with torch.no_grad():
            values = self._values(self.slow, seen.states)
            total, returns = values[..., -1], []
            for k in reversed(range(steps)):
                ahead = torch.lerp(values[..., k], total, LAMBDA)
                total = rewards[..., k] + gamma * ahead
                returns.append(total)
            lesson = torch.cat([before, seen.states[:, :-1]], 1), torch.stack(returns[::-1], -1)
            past = Segment(self.states, self.actions).then(seen).last(self.states.shape[1])
            self.states.copy_(past.states)
            self.actions.copy_(past.actions)
            self.left -= steps
        return objective, lesson

    def learn(self, lesson: Lesson, optimizer: torch.optim.Optimizer) -> None:
        """Bring V nearer to the returns, every other step at a time, and V' to V.

        Args:
            lesson: states (R, H, dx) and their returns (R, H).
            optimizer: of the value's weights.
        """
        states, returns = lesson
        weights = [p for p in self.value.parameters() if p.requires_grad]
        for first in range(min(2, states.shape[1])):
            error = self._values(self.value, states[:, first::2]) - returns[..., first::2]
            optimizer.zero_grad(set_to_none=True)
            error.square().mean().backward()
            nn.utils.clip_grad_norm_(weights, self.options.clip or torch.inf)
            optimizer.step()
            with torch.no_grad():
                for slow, p in zip(self.slow.parameters(), self.value.parameters(), strict=True):
                    slow.lerp_(p, SLOW)

    def _values(self, value: OneStepPolicy, states: Tensor) -> Tensor:
        """(R, K) of states (R, K, dx), under the targets of the episodes."""
        goals = (self.target / value.target_std)[:, None].expand(-1, states.shape[1], -1)
        found = value.output(states.flatten(0, 1), goals.flatten(0, 1))
        return found.unflatten(0, (-1, states.shape[1]))[..., 0]
