"""Ensembles of one-step networks of other packages, by trajectory sampling."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from tsmlib.models.base import EnsembleModel
from tsmlib.sampling import Noise, draw_members, standard_normal
from tsmlib.trajectory import Segment


class OneStepEnsemble(EnsembleModel, ABC):
    """M one-step networks as a ``SegmentModel``: trajectory sampling with a fixed member.

    TS-inf of PETS: a row draws its member at the beginning of a segment and keeps it.
    """

    segment_len, past_len, stochastic = 100, 1, True

    @abstractmethod
    def step(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor | None]:
        """(M, R, dx), (M, R, du) -> mean and deviation (or None) of the increments (M, R, dx)."""

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """(B, L, .), (B, K <= segment_len, du) -> states (B, K, dx).

        No generator: every step takes the mean of all members. With one: each row keeps a member
        of its own, and members that state a deviation add the noise.
        """
        n_rows, start = len(actions), past.states[:, -1]
        if generator is None:
            rows = torch.arange(n_rows, device=start.device).expand(self.members, -1)
        else:
            member = draw_members(self.members, n_rows, generator, start)
            groups = [(member == m).nonzero()[:, 0] for m in range(self.members)]
            # (M, R), -1 where a group is shorter.
            rows = pad_sequence(groups, batch_first=True, padding_value=-1)
        real, rows = rows >= 0, rows.clamp(min=0)
        x, states = start[rows], []
        for u in actions.unbind(1):
            mean, std = self.step(x, u[rows])
            if generator is None:
                mean = mean.mean(0).expand_as(mean)
            elif std is not None:
                mean = mean + std * standard_normal(start.shape, generator, start)[rows]
            x = x + mean
            states.append(x)
        predicted = start.new_empty(n_rows, len(states), start.shape[1])
        predicted[rows[real]] = torch.stack(states, dim=2)[real]
        return predicted
