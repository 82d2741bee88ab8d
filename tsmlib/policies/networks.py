"""Policies: a one-step network and a segment policy that acts through the action prior (section 4.3).

Letters in shapes: M policies side by side, B episodes of each, R = M B rows laid out policy by policy, L past length,
dx, du, dz, dg size of state, action, code, target.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.collection import Controller
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.config import Configured
from tsmlib.models.features import Features
from tsmlib.models.layers import BatchedLinear, GatedLayer, advance, on_device_of
from tsmlib.storage.files import Json
from tsmlib.trajectory import Segment

# The latest state x_t (R, dx), the action u_{t-1} (R, du) that led to it, noise (R, output_dim) -> u_t (R, du)
Act = Callable[[Tensor, Tensor, Tensor | None], Tensor]


class Policy(Configured):
    """M copies of pi(. | past, target), asked one step at a time: the base of all policies.

    state_dim, target_dim: dx, dg. angles: state dimensions in radians. target_std: metres, what a target counts in.
    past_len: steps of past that it reads. output_dim: size of what is noisy, the action or the code of a segment.
    ``features`` standardise its states once they have statistics, by ``fit`` or from the model that it learns in.
    """

    past_len: int
    action_dim: int
    output_dim: int

    def __init__(
        self,
        state_dim: int,
        target_dim: int,
        *,
        angles: tuple[int, ...],
        target_std: float,
        copies: int,
    ) -> None:
        if copies < 1:
            raise ValueError(f"copies is {copies}, expected at least 1")
        super().__init__()
        self.state_dim, self.target_dim, self.target_std, self.copies = (
            state_dim,
            target_dim,
            target_std,
            copies,
        )
        self.features = Features(state_dim, tuple(angles))

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Get ready to act after ``past`` (R, L, .), whose last step is the first that the result is given."""
        raise NotImplementedError

    def goals(self, past: Segment, target: Tensor) -> Tensor:
        """Targets (R, dg) as the network sees them, (M, B, dg). ValueError where they or ``past`` do not fit."""
        (rows, steps, dim), name, needed, dg = (
            past.states.shape,
            type(self).__name__,
            self.past_len,
            self.target_dim,
        )
        if dim != self.state_dim:
            wrong = f"states have {dim} dimensions, this {name} was made for {self.state_dim}: it belongs to another "
            raise ValueError(wrong + "environment")
        if steps < needed:
            raise ValueError(
                f"the past holds {steps} steps, {name} needs {needed}; collect with past_len={needed}"
            )
        if rows % self.copies:
            raise ValueError(
                f"{rows} episodes do not divide among {self.copies} copies of the policy"
            )
        if target.shape != (rows, dg):
            raise ValueError(
                f"targets are {tuple(target.shape)}, expected one per episode, ({rows}, {dg})"
            )
        return self.by_copy(target / self.target_std)

    def by_copy(self, rows: Tensor) -> Tensor:
        """(R, k) -> (M, B, k)."""
        return rows.unflatten(0, (self.copies, -1))


class OneStepPolicy(Policy):
    """pi(u_t | x_t, g): a fully connected network of the present state and target (A.3: 2 x 64, ReLU).

    Its output is squashed to the action bounds by tanh and starts near no torque.
    """

    past_len = 1

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (),
        hidden: int = 64,
        layers: int = 2,
        target_std: float = 0.1,  # of a coordinate, uniform in the disc of radius 0.2 m
        copies: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__(state_dim, target_dim, angles=angles, target_std=target_std, copies=copies)
        self.action_dim = self.output_dim = action_dim
        generators = _generators(copies, seed)
        widths = [self.features.dim + target_dim, *[hidden] * layers, action_dim]
        self.net = nn.ModuleList(BatchedLinear(i, o, generators) for i, o in pairwise(widths))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(0.1)

    def begin(self, past: Segment, target: Tensor) -> Act:
        goals = self.goals(past, target)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            s = torch.cat([self.by_copy(self.features(x)), goals], dim=-1)  # (M, B, in)
            for i, layer in enumerate(self.net):
                s = layer(F.relu(s) if i else s)
            mean = s.tanh().flatten(0, 1)
            return mean if noise is None else (mean + noise).clamp(-1, 1)

        return act


class SegmentPolicy(Policy):
    """pi(Z | X-, U-, g) acting through an action prior, with the gated causal layers of the decoders (Eq. 1, A.3).

        h = tanh(W_f * s + V_f g) . sigmoid(W_g * s + V_g g)

    The target takes the place of the code. Positions are steps of the past, (x_t, u_{t-1}) each; the output at the
    last one is the mean of Z, of whose segment only the first action is executed (A31).

    prior: a trained ActionPrior, copied into the policy and never trained by it; or its configuration.
    """

    def __init__(
        self,
        state_dim: int,
        prior: ActionPrior | Mapping[str, Json],
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (),
        channels: int = 32,
        dilations: Sequence[int] = (1, 2, 4, 2),  # receptive field 10 = H
        target_std: float = 0.1,
        copies: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__(state_dim, target_dim, angles=angles, target_std=target_std, copies=copies)
        self.prior = deepcopy(prior) if isinstance(prior, ActionPrior) else ActionPrior(**prior)  # type: ignore[arg-type]
        self.prior.requires_grad_(False)
        self.action_dim, self.output_dim = len(self.prior.std), self.prior.latent_dim
        self.past_len, self.dilations = (
            max(1 + sum(dilations), self.prior.past_len),
            tuple(dilations),
        )

        generators = _generators(copies, seed)
        self.inlet = BatchedLinear(self.features.dim + self.action_dim, channels, generators)
        taps = [
            BatchedLinear(2 * channels, 2 * channels, generators) for _ in dilations
        ]  # drawn before all the outs
        outs = [BatchedLinear(channels, 2 * channels, generators) for _ in dilations]
        self.layers = nn.ModuleList(map(GatedLayer, taps, outs))
        self.codes = BatchedLinear(
            target_dim, 2 * channels * len(dilations), generators
        )  # V_f, V_g of every layer
        self.head = BatchedLinear(channels, self.output_dim, generators)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Read the past but for its last step; the layers' inputs are then carried from step to step."""
        codes = self.codes(self.goals(past, target))
        past = past.last(self.past_len)
        zeros = codes.new_zeros(*codes.shape[:2], self.inlet.bias.shape[-1])
        cache = [[zeros] * dilation for dilation in self.dilations]

        def read(x: Tensor, u: Tensor) -> Tensor:
            inputs = self.by_copy(torch.cat([self.features(x), u / self.prior.std], dim=-1))
            return advance(self.inlet, self.layers, inputs, codes, cache)  # (M, B, C)

        for x, u in list(zip(past.states.unbind(1), past.actions.unbind(1), strict=True))[:-1]:
            read(x, u)
        actions = deque(past.actions[:, :-1].unbind(1), maxlen=self.prior.past_len)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            z = self.head(F.relu(read(x, u))).flatten(0, 1)  # (R, dz)
            actions.append(u)
            return self.prior.first(
                torch.stack(tuple(actions), dim=1), z if noise is None else z + noise
            )

        return act


def controller(policy: Policy, target: Tensor) -> Controller:
    """The policy at work in an environment, for ``collect``: one action, then asked again. target (R, dg)."""

    @torch.no_grad()
    def control(past: Segment) -> Tensor:
        states, actions, goal = on_device_of(policy, *past, target)
        act = policy.begin(Segment(states, actions), goal)
        return act(states[:, -1], actions[:, -1], None)[:, None].to(past.states.device)

    return control


def _generators(copies: int, seed: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed + m) for m in range(copies)]
