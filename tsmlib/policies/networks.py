"""Policies: a one-step network and a segment policy that acts through the action prior (section 4.3).

Letters in shapes: M policies side by side, B episodes, L past length, dx state size, du action size, dz code size.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import reduce
from itertools import pairwise
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.collection import Controller
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.features import Features
from tsmlib.models.layers import on_device_of
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment

Act = Callable[[Tensor, Tensor, Tensor | None], Tensor]


class Policy(Protocol):
    """What ``learn_policy`` trains: M copies of pi(. | past, target), asked one step at a time."""

    copies: int
    past_len: int
    action_dim: int
    output_dim: int  # of what is noisy: the action, or the code of a segment

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Get ready to act after ``past`` (R, L, .), whose last step is the first that the result is given."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]: ...


class BatchedLinear(nn.Module):
    """M linear layers side by side: (M, B, in) -> (M, B, out). Drawn as torch draws one linear layer."""

    def __init__(self, inputs: int, outputs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        bound = inputs**-0.5

        def drawn(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.stack([torch.rand(shape, generator=g) * 2 * bound - bound for g in generators]))

        self.weight = drawn(inputs, outputs)  # (M, in, out)
        self.bias = drawn(1, outputs)  # (M, 1, out)

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, x, self.weight)


class OneStepPolicy(nn.Module):
    """pi(u_t | x_t, g): a fully connected network of the present state and target (A.3: 2 x 64, ReLU).

    state_dim, action_dim, target_dim: dx, du, dg. angles: state dimensions in radians. target_std: metres, what a
    target counts in. Its output is squashed to the action bounds by tanh and starts near no torque.
    """

    past_len = 1

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (0, 1),
        hidden: int = 64,
        layers: int = 2,
        target_std: float = 0.1,  # of a coordinate, uniform in the disc of radius 0.2 m
        copies: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._config = dict(
            state_dim=state_dim, action_dim=action_dim, target_dim=target_dim, angles=list(angles), hidden=hidden,
            layers=layers, target_std=target_std, copies=copies,
        )  # fmt: skip
        generators = _generators(copies, seed)
        self.state_dim, self.target_dim, self.copies, self.target_std = state_dim, target_dim, copies, target_std
        self.action_dim = self.output_dim = action_dim
        self.features = Features(state_dim, tuple(angles))
        widths = [self.features.dim + target_dim, *[hidden] * layers, action_dim]
        self.net = nn.ModuleList(BatchedLinear(i, o, generators) for i, o in pairwise(widths))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(0.1)

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """It has no memory: the past plays no part."""
        _require_fit(self, past, target)
        goal = _by_copy(self, target / self.target_std)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            s = torch.cat([_by_copy(self, self.features(x)), goal], dim=-1)  # (M, B, in)
            for i, layer in enumerate(self.net):
                s = layer(F.relu(s) if i else s)
            mean = s.tanh().flatten(0, 1)
            return mean if noise is None else (mean + noise).clamp(-1, 1)

        return act


class SegmentPolicy(nn.Module):
    """pi(Z | X-, U-, g) acting through an action prior, with the gated causal layers of the decoders (Eq. 1, A.3).

        h = tanh(W_f * s + V_f g) . sigmoid(W_g * s + V_g g)

    The target takes the place of the code. Positions are steps of the past, (x_t, u_{t-1}) each; the output at the
    last one is the mean of Z. Of the segment that the prior decodes from Z only the first action is executed; then the
    policy is asked again (A31). The receptive field, 1 + sum(dilations), is the past that the policy sees.

    prior: a trained ActionPrior, copied into the policy and never trained by it; or its configuration.
    """

    def __init__(
        self,
        state_dim: int,
        prior: ActionPrior | Mapping[str, Any],
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (0, 1),
        channels: int = 32,
        dilations: tuple[int, ...] = (1, 2, 4, 2),  # receptive field 10 = H
        target_std: float = 0.1,
        copies: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.prior = deepcopy(prior) if isinstance(prior, ActionPrior) else ActionPrior(**prior)
        self.prior.requires_grad_(False)
        self._config = dict(
            state_dim=state_dim, prior=self.prior.config(), target_dim=target_dim, angles=list(angles),
            channels=channels, dilations=list(dilations), target_std=target_std, copies=copies,
        )  # fmt: skip
        generators = _generators(copies, seed)
        self.state_dim, self.target_dim, self.copies, self.target_std = state_dim, target_dim, copies, target_std
        self.action_dim, self.output_dim = len(self.prior.std), self.prior.latent_dim
        self.dilations = tuple(dilations)
        self.past_len = max(1 + sum(dilations), self.prior.past_len)
        self.features = Features(state_dim, tuple(angles))
        self.inlet = BatchedLinear(self.features.dim + self.action_dim, channels, generators)
        self.taps = nn.ModuleList(BatchedLinear(2 * channels, 2 * channels, generators) for _ in dilations)  # W_f, W_g
        self.outs = nn.ModuleList(
            BatchedLinear(channels, 2 * channels, generators) for _ in dilations
        )  # residual, skip
        self.goals = BatchedLinear(target_dim, 2 * channels * len(dilations), generators)  # V_f, V_g of every layer
        self.head = BatchedLinear(channels, self.output_dim, generators)

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Read the past but for its last step; the layers' inputs are then carried from step to step."""
        _require_fit(self, past, target)
        past = past.last(self.past_len)
        goals = self.goals(_by_copy(self, target / self.target_std)).chunk(len(self.dilations), dim=-1)
        zeros = goals[0].new_zeros(*goals[0].shape[:2], self.inlet.bias.shape[-1])
        carried = [deque([zeros] * dilation) for dilation in self.dilations]
        for x, u in list(zip(past.states.unbind(1), past.actions.unbind(1), strict=True))[:-1]:
            self._read(x, u, goals, carried)
        actions = deque(past.actions[:, :-1].unbind(1), maxlen=self.prior.past_len)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            z = self.head(F.relu(self._read(x, u, goals, carried))).flatten(0, 1)  # (R, dz)
            actions.append(u)
            return self.prior.first(torch.stack(tuple(actions), dim=1), z if noise is None else z + noise)

        return act

    def _read(self, x: Tensor, u: Tensor, goals: Sequence[Tensor], carried: list[deque[Tensor]]) -> Tensor:
        """One position through all layers: the sum of their skips (M, B, C). Moves ``carried`` one position on."""
        s = self.inlet(_by_copy(self, torch.cat([self.features(x), u / self.prior.std], dim=-1)))
        skips = []
        for taps, out, goal, inputs in zip(self.taps, self.outs, goals, carried, strict=True):
            inputs.append(s)
            filtered, gate = (taps(torch.cat([inputs.popleft(), s], dim=-1)) + goal).chunk(2, dim=-1)
            residual, skip = out(torch.tanh(filtered) * torch.sigmoid(gate)).chunk(2, dim=-1)
            s = s + residual
            skips.append(skip)
        return reduce(torch.add, skips)


def controller(policy: Policy, target: Tensor, *, noise: float = 0.0, generator: Noise | None = None) -> Controller:
    """The policy at work in an environment, for ``collect``: one action, then asked again. target (R, dg).

    noise: standard deviation of its output, drawn from ``generator``; none without.
    """

    def control(past: Segment) -> Tensor:
        states, actions, goal = on_device_of(policy, *past, target)
        shape = (len(goal), policy.output_dim)
        drawn = None if generator is None else noise * standard_normal(shape, generator, goal)
        with torch.no_grad():
            act = policy.begin(Segment(states, actions), goal)
            return act(states[:, -1], actions[:, -1], drawn)[:, None].to(past.states.device)

    return control


def _generators(copies: int, seed: int) -> list[torch.Generator]:
    if copies < 1:
        raise ValueError(f"copies is {copies}, expected at least 1")
    return [torch.Generator().manual_seed(seed + m) for m in range(copies)]


def _require_fit(policy: Any, past: Segment, target: Tensor) -> None:
    """ValueError where ``past`` or ``target`` is not what the policy was made for."""
    (rows, steps, state_dim), name = past.states.shape, type(policy).__name__
    if state_dim != policy.state_dim:
        raise ValueError(
            f"states have {state_dim} dimensions, this {name} was made for {policy.state_dim}: it belongs to another "
            "environment"
        )
    if steps < policy.past_len:
        raise ValueError(
            f"the past holds {steps} steps, {name} needs {policy.past_len}; collect with past_len={policy.past_len}"
        )
    if rows % policy.copies:
        raise ValueError(
            f"{rows} episodes do not divide among {policy.copies} copies of the policy; expected a multiple"
        )
    if target.shape != (rows, policy.target_dim):
        raise ValueError(f"targets are {tuple(target.shape)}, expected one per episode, ({rows}, {policy.target_dim})")


def _by_copy(policy: Policy, rows: Tensor) -> Tensor:
    """(R, k) -> (M, B, k)."""
    return rows.unflatten(0, (policy.copies, -1))
