"""Policies: a one-step network and a segment policy that acts through the prior (section 4.3).

Letters in shapes: R episodes, L past length, dx, du, dz, dg size of state, action, code, target.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.checks import as_tensor, require_counts, require_number, require_type
from tsmlib.collection import Controller
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import Model
from tsmlib.models.config import Configured, weights_from
from tsmlib.models.features import Features
from tsmlib.models.layers import GatedLayer, advance, on_device_of
from tsmlib.storage.files import Json
from tsmlib.trajectory import Segment

# x_t (R, dx), the action u_{t-1} (R, du) that led to it, noise (R, output_dim) -> u_t (R, du)
Act = Callable[[Tensor, Tensor, Tensor | None], Tensor]


class Policy(Configured):
    """pi(. | past, target), asked one step at a time: the base of all policies.

    ``features`` standardise its states once they have statistics, by ``fit`` or from the model that
    it learns in.

    Args:
        state_dim: dx.
        target_dim: dg.
        angles: state dimensions in radians.
        target_std: metres, what a target counts in.

    Attributes:
        past_len: L, steps of past that it reads.
        action_dim: du.
        output_dim: size of what is noisy, the action or the code of a segment.
    """

    past_len: int
    action_dim: int
    output_dim: int
    places: tuple[int, ...] = ()

    def __init__(
        self,
        state_dim: int,
        target_dim: int,
        *,
        angles: tuple[int, ...],
        target_std: float,
    ) -> None:
        super().__init__()
        require_counts(state_dim=state_dim, target_dim=target_dim)
        self.state_dim, self.target_dim = state_dim, target_dim
        self.target_std = require_number("target_std", target_std, 0, above=True)
        self.features = Features(state_dim, angles)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Get ready to act after the past; the result is given its last step first.

        Args:
            past: states (R, L, dx) in physical units, and the actions (R, L, du) that led to them.
            target: (R, dg), in the task's unit, metres for places.

        Returns:
            A function: last states, the actions before them, noise or None -> actions (R, du).

        Raises:
            NotImplementedError: the class has no ``begin`` of its own.
        """
        raise NotImplementedError

    def goals(self, past: Segment, target: Tensor) -> Tensor:
        """Scale targets, as the network sees them.

        Args:
            past: states (R, L, dx) in physical units, and the actions (R, L, du) that led to them.
            target: (R, dg), in the task's unit, metres for places.

        Returns:
            Targets (R, dg), in units of ``target_std``.

        Raises:
            ValueError: past or target do not fit the policy.
        """
        (rows, steps, dim), name = past.states.shape, type(self).__name__
        if dim != self.state_dim:
            raise ValueError(
                f"states have {dim} dimensions, this {name} was made for {self.state_dim}; "
                "expected a policy of this environment"
            )
        if steps < self.past_len:
            raise ValueError(
                f"the past holds {steps} steps, {name} needs {self.past_len}; collect or execute "
                f"with past_len={self.past_len}"
            )
        target = as_tensor("target", target, (rows, self.target_dim), dtype=past.states.dtype)
        return target / self.target_std

    def take_statistics(self, model: Model) -> None:
        """Take the statistics of a model's features, where the policy has none of its own.

        Args:
            model: that the policy learns in; one with other angles gives a warning.
        """
        own, known = self.features, getattr(model, "features", None)
        sizes = isinstance(known, Features) and own.step_std.shape == known.step_std.shape
        if own.fitted or not isinstance(known, Features) or not sizes:
            return
        if own.angles == known.angles:
            own.load_state_dict(known.state_dict())
        else:
            warnings.warn(
                f"the policy has the angles {own.angles}, the model {known.angles}, so that it "
                f"learns on states in raw units. Make it with angles={tuple(known.angles)}, or "
                "call policy.features.fit(data)",
                stacklevel=3,
            )


class OneStepPolicy(Policy):
    """pi(u_t | x_t, g): a fully connected network of the present state and target (A.3).

    Its output is squashed to the action bounds by tanh and starts near no torque.

    Args:
        state_dim: dx.
        action_dim: du.
        target_dim: dg.
        angles: state dimensions in radians.
        hidden: units of a layer.
        layers: hidden ones, ReLU.
        target_std: what a target counts in, metres; of a coordinate in the disc of 0.2 m.
        places: first dimensions of places (dg,) in the state that are to meet one after the other,
            and the last of them the target, as fingertip and object: the network sees how far and
            in which direction each is from the next; none without.
        seed: of the weights.

    Raises:
        ValueError: a place that does not lie in the state.
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
        target_std: float = 0.1,
        places: Sequence[int] = (),
        seed: int = 0,
    ) -> None:
        super().__init__(state_dim, target_dim, angles=angles, target_std=target_std)
        require_counts(action_dim=action_dim, hidden=hidden, layers=layers)
        self.action_dim = self.output_dim = action_dim
        if any(type(d) is not int or not 0 <= d <= state_dim - target_dim for d in places):
            raise ValueError(
                f"places is {places!r:.80}; expected dimensions from 0 to "
                f"{state_dim - target_dim}, at each of which a place of {target_dim} numbers begins"
            )
        self.places = tuple(places)
        seen = self.features.dim + target_dim + len(self.places) * (2 * target_dim + 1)
        widths = [seen, *[hidden] * layers, action_dim]
        with weights_from(seed):
            self.net = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise(widths))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(0.1)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Get ready to act on the present state and target.

        Args:
            past: states (R, L, dx) in physical units, and the actions (R, L, du) that led to them.
            target: (R, dg), in the task's unit, metres for places.

        Returns:
            A function: last states, the actions before them, noise or None -> actions (R, du).

        Raises:
            ValueError: past or target do not fit the policy.
        """
        goals = self.goals(past, target)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            mean = self.output(x, goals).tanh()
            return mean if noise is None else (mean + noise).clamp(-1, 1)

        return act

    def output(self, x: Tensor, goals: Tensor) -> Tensor:
        """Ask the network, not squashed.

        Args:
            x: states (R, dx), physical units.
            goals: (R, dg), as ``goals`` gives them.

        Returns:
            (R, du).
        """
        seen, x = [self.features(x), goals], x / self.target_std
        places = [x[:, d : d + self.target_dim] for d in self.places]
        for here, there in pairwise([*places, goals]):
            way = there - here
            length = (way.square().sum(-1, keepdim=True) + 1e-6).sqrt()
            seen += [way, length, way / length]
        s = torch.cat(seen, dim=-1)
        for i, layer in enumerate(self.net):
            s = layer(F.relu(s) if i else s)
        return s


class SegmentPolicy(Policy):
    """pi(Z | X-, U-, g) acting through an action prior, with gated causal layers (Eq. 1, A.3).

        h = tanh(W_f * s + V_f g) . sigmoid(W_g * s + V_g g)

    The target takes the place of the code. Positions are steps of the past, (x_t, u_{t-1}) each;
    the output at the last one is the mean of Z, of whose segment only the first action is executed
    (A31).

    Args:
        state_dim: dx.
        prior: a trained ActionPrior, copied into the policy and never trained by it; or its
            configuration.
        target_dim: dg.
        angles: state dimensions in radians.
        channels: of every layer.
        dilations: of the layers; their sum and one is the receptive field, H by default.
        target_std: what a target counts in, metres.
        seed: of the weights.
    """

    def __init__(
        self,
        state_dim: int,
        prior: ActionPrior | Mapping[str, Json],
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (),
        channels: int = 32,
        dilations: Sequence[int] = (1, 2, 4, 2),
        target_std: float = 0.1,
        seed: int = 0,
    ) -> None:
        super().__init__(state_dim, target_dim, angles=angles, target_std=target_std)
        hint = 'an ActionPrior, such as tsmlib.load_pretrained("prior", env=env)'
        require_type("prior", prior, (ActionPrior, Mapping), hint)
        require_counts(channels=channels)
        self.prior = deepcopy(prior) if isinstance(prior, ActionPrior) else ActionPrior(**prior)  # type: ignore[arg-type]
        self.prior.requires_grad_(False)
        self.action_dim, self.output_dim = len(self.prior.std), self.prior.latent_dim
        self.past_len = max(1 + sum(dilations), self.prior.past_len)
        self.dilations = tuple(dilations)

        with weights_from(seed):
            self.inlet = nn.Linear(self.features.dim + self.action_dim, channels)
            self.layers = nn.ModuleList(GatedLayer(channels) for _ in dilations)
            # V_f, V_g of every layer.
            self.codes = nn.Linear(target_dim, 2 * channels * len(dilations))
            self.head = nn.Linear(channels, self.output_dim)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Read the past but for its last step; inputs of layers are carried from step to step.

        Args:
            past: states (R, L, dx) in physical units, and the actions (R, L, du) that led to them.
            target: (R, dg), in the task's unit, metres for places.

        Returns:
            A function: last states, the actions before them, noise or None -> actions (R, du).

        Raises:
            ValueError: past or target do not fit the policy.
        """
        codes = self.codes(self.goals(past, target))
        past = past.last(self.past_len)
        zeros = codes.new_zeros(len(codes), self.inlet.out_features)
        cache = [[zeros] * dilation for dilation in self.dilations]

        def read(x: Tensor, u: Tensor) -> Tensor:
            inputs = torch.cat([self.features(x), u / self.prior.std], dim=-1)
            return advance(self.inlet, self.layers, inputs, codes, cache)  # (R, C)

        for x, u in list(zip(past.states.unbind(1), past.actions.unbind(1), strict=True))[:-1]:
            read(x, u)
        actions = deque(past.actions[:, :-1].unbind(1), maxlen=self.prior.past_len)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            z = self.head(F.relu(read(x, u)))  # (R, dz)
            actions.append(u)
            return self.prior.first(
                torch.stack(tuple(actions), dim=1), z if noise is None else z + noise
            )

        return act


def controller(policy: Policy, target: Tensor) -> Controller:
    """The policy at work in an environment: one action, then asked again.

    Args:
        policy: that acts, without noise.
        target: (R, dg), one for each episode.

    Returns:
        The controller, for ``execute`` and ``collect``.
    """
    require_type("policy", policy, Policy, "tsmlib.OneStepPolicy(...) or SegmentPolicy(...)")
    target = as_tensor("target", target, ("R", policy.target_dim))

    @torch.no_grad()
    def control(past: Segment) -> Tensor:
        states, actions, goal = on_device_of(policy, *past, target)
        act = policy.begin(Segment(states, actions), goal)
        return act(states[:, -1], actions[:, -1], None)[:, None].to(past.states.device)

    return control
