"""Ensemble of probabilistic one-step networks, PETS (Chua et al., 2018): not in the paper.

x_{t+1} ~ N(mean_m, variance_m)(x_t, u_t), member m drawn once per rollout
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.checks import require_counts, require_flag
from tsmlib.models.base import EnsembleModel, Step
from tsmlib.models.state_model import StateModel
from tsmlib.sampling import Noise, draw_members, random_indices, standard_normal
from tsmlib.trajectory import Segment, Window, states_before


class Members(EnsembleModel):
    """M one-step networks as one model: trajectory sampling with a fixed member (TS-inf of PETS).

    Attributes:
        members: M.
        segment_len: most steps for which a row keeps its member.
        gaussian: whether members may state a variance.
        scale: of the increments, in physical units.
    """

    segment_len, past_len, stochastic, gaussian = 100, 1, True, True
    scale: Tensor | float = 1.0

    def increments(
        self, x: Tensor, u: Tensor, which: slice = slice(None)
    ) -> tuple[Tensor, Tensor | None]:
        """Predict the increments of a step by each member.

        Args:
            x: states (M, R, dx) in physical units.
            u: actions (M, R, du) in [-1, 1].
            which: the members that are asked, M of them.

        Returns:
            Mean and log variance (M, R, dx), in units of ``scale``; None for the log variance of
            members that state none.
        """
        raise NotImplementedError

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Go on from the last state, by the mean of all members or by one member per row.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            generator: None for the mean; else of each row's member and, in the Gaussian form, of
                the noise which that member states.

        Returns:
            A function: actions (B, du) -> the states (B, dx) that they lead to, in physical units.
        """
        return self._begin(past, self.segment_len, generator)

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """Predict the states that ``begin`` steps through, with noise for as many steps.

        Args:
            past: states (B, L, dx) in physical units, and the actions (B, L, du) that led to them.
            actions: (B, K, du) in [-1, 1].
            generator: as of ``begin``.

        Returns:
            States (B, K, dx) in physical units.
        """
        step = self._begin(past, actions.shape[1], generator)
        return torch.stack([step(u) for u in actions.unbind(1)], dim=1)

    def _begin(self, past: Segment, steps: int, generator: Noise | None) -> Step:
        """Rows sorted into a block per member, of equal size: a step is one batched product."""
        x, rows, taken, which = past.states[:, -1], len(past.states), 0, slice(None)
        if generator is None:
            place = torch.arange(rows, device=x.device).repeat(self.members)
            noise = None
            block = rows
        else:
            member = draw_members(self.members, rows, generator, x)
            noise = standard_normal((rows, steps if self.gaussian else 0, x.shape[1]), generator, x)
            which = slice(int(member.min()), int(member.max()) + 1)  # those between which some are
            member = member - which.start
            counts = member.bincount()
            order, block = member.argsort(stable=True), int(counts.max())
            rank = torch.arange(rows, device=x.device) - (counts.cumsum(0) - counts)[member[order]]
            # Of each row.
            slot = torch.empty_like(member).index_copy(0, order, member[order] * block + rank)
            place = torch.zeros(len(counts) * block, dtype=torch.long, device=x.device)
            place = place.index_copy(0, slot[order], order)

        def step(u: Tensor) -> Tensor:
            nonlocal x, taken
            rows_x, rows_u = (
                part.index_select(0, place).unflatten(0, (-1, block)) for part in (x, u)
            )
            mean, log_variance = self.increments(rows_x, rows_u, which)  # (M, block, dx)
            if noise is None:
                change = mean.mean(0)
            else:
                change = mean.flatten(0, 1).index_select(0, slot)
                if log_variance is not None:
                    stated = (0.5 * log_variance.flatten(0, 1).index_select(0, slot)).exp()
                    change = change + stated * noise[:, taken]
            x, taken = x + self.scale * change, taken + 1
            return x

        return step


class Ensemble(StateModel, Members):
    """PETS: networks that differ in their first weights and in the order of their data.

    ``Ensemble.for_data(data)`` makes one that fits the data. Each member states a Gaussian.

    Args:
        state_dim: dx, dimensions of a state.
        action_dim: du, dimensions of an action.
        angles: indices of state dimensions that are angles in radians; the model sees their cosine
            and sine.
        gaussian: whether each member states a variance and is trained by likelihood, as in PETS; if
            not, by squared error, and only the choice of the member is random.
        members: M, number of networks; 5 in PETS.
        hidden: size of each hidden layer; 200 in PETS.
        layers: hidden layers; 3 in PETS.
        segment_len: most steps for which a row keeps its member; 100, an episode of section 5.1,
            which makes it trajectory sampling with a fixed member.
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        angles: Sequence[int] = (),
        gaussian: bool = True,
        members: int = 5,
        hidden: int = 200,
        layers: int = 3,
        segment_len: int = 100,
    ) -> None:
        super().__init__(state_dim, action_dim, angles)
        require_counts(members=members, hidden=hidden, layers=layers, segment_len=segment_len)
        self.gaussian = require_flag("gaussian", gaussian)
        self.members, self.segment_len = members, segment_len
        widths = [
            self.features.dim + action_dim,
            *[hidden] * layers,
            state_dim * (2 if gaussian else 1),
        ]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for i, o in pairwise(widths):
            drawn = [nn.Linear(i, o) for _ in range(members)]
            # (M, i, o)
            self.weights.append(
                nn.Parameter(torch.stack([linear.weight.detach().T for linear in drawn]))
            )
            # (M, 1, o)
            self.biases.append(
                nn.Parameter(torch.stack([linear.bias.detach()[None] for linear in drawn]))
            )
        self.output_layers = (f"weights.{layers}", f"biases.{layers}")
        if gaussian:  # limits of the stated log variance, learned as in PETS
            self.log_variance_max = nn.Parameter(torch.full((state_dim,), 0.5))
            self.log_variance_min = nn.Parameter(torch.full((state_dim,), -10.0))

    @property
    def scale(self) -> Tensor:  # type: ignore[override]
        """The deviation of one step."""
        return self.features.step_std

    def increments(
        self, x: Tensor, u: Tensor, which: slice = slice(None)
    ) -> tuple[Tensor, Tensor | None]:
        """Predict the increments of a step by each member, see ``Members``."""
        s = torch.cat([self.features(x), u], dim=-1)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            s = torch.baddbmm(bias[which], F.silu(s) if i else s, weight[which])
        if not self.gaussian:
            return s, None
        mean, log_variance = s.chunk(2, dim=-1)
        log_variance = self.log_variance_max - F.softplus(self.log_variance_max - log_variance)
        return mean, self.log_variance_min + F.softplus(log_variance - self.log_variance_min)

    def loss(self, window: Window, generator: torch.Generator) -> Tensor:
        """Compute the negative log-likelihood, or squared error, of one-step increments.

        Args:
            window: past (B, L, .) and future (B, K, .), in physical units; actions in [-1, 1].
            generator: of the tuples of the batch, dealt out to the members at random.

        Returns:
            The mean over members, a scalar without unit.
        """
        future = window.future
        tuples = [
            part.flatten(0, 1) for part in (states_before(window), future.actions, future.states)
        ]
        share = -(-len(tuples[0]) // self.members)
        index = random_indices(len(tuples[0]), (self.members, share), generator, tuples[0].device)
        x, u, after = (part[index] for part in tuples)
        mean, log_variance = self.increments(x, u)
        error = (self.features.increments(after, x) - self.features.moving_part(mean)).square()
        if log_variance is None:
            return error.sum(-1).mean()
        log_variance = self.features.moving_part(log_variance)
        likelihood = 0.5 * (error * (-log_variance).exp() + log_variance).sum(-1).mean()
        return (
            likelihood
            + 0.01 * self.features.moving_part(self.log_variance_max - self.log_variance_min).sum()
        )
