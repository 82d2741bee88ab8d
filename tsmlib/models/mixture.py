"""Several trained models as one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tsmlib.models.base import EnsembleModel, Model, Step, as_dynamics, rollout, stepper
from tsmlib.models.features import Features
from tsmlib.sampling import Noise, NoNoise, SeparateNoise, SharedNoise, draw_members
from tsmlib.trajectory import Segment


@dataclass(frozen=True)
class Share:
    """Rows of a batch (n,), the member that predicts them, and its noise."""

    rows: Tensor
    member: int
    noise: Noise | None


class Mixture(EnsembleModel):
    """An equal mixture of models of one environment: a sample is a rollout of one of them, drawn once per rollout.

    Its mode is the mean of theirs; planners judge a candidate by its mean return over the modes of all
    (``model_predictor``), which is harder to exploit than one model. Models may be of any kinds and have segments of
    any lengths; one that stands there twice counts twice. It is not trained: its models are.

    segment_len: steps for which a model is kept, at least a horizon. ValueError for no models, or for states of other
    sizes.
    """

    def __init__(self, models: Sequence[Model], *, segment_len: int = 1000) -> None:
        if not models:
            raise ValueError("a mixture of no models; give at least one, as in Mixture([one, another])")
        if segment_len < 1:
            raise ValueError(f"segment_len is {segment_len}, expected a positive number of steps")
        known = [model.features for model in map(as_dynamics, models) if hasattr(model, "features")]
        if len(sizes := sorted({len(features.step_std) for features in known})) > 1:
            raise ValueError(
                f"models predict states of {' and '.join(map(str, sizes))} dimensions; expected models of one "
                "environment"
            )
        self.models, self.members, self.segment_len = tuple(models), len(models), segment_len
        self.past_len = max(as_dynamics(model).past_len for model in models)
        self.stochastic = self.members > 1 or as_dynamics(models[0]).stochastic

    @property
    def features(self) -> Features:
        """Statistics of the first model's training data, in whose units scores are; AttributeError without them."""
        return as_dynamics(self.models[0]).features

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        """Read the past (B, L, .). No generator: the mode; with one: a sample."""
        shares = list(self._shares(past.states, generator))
        steps = [
            stepper(self.models[share.member], Segment(*(part[share.rows] for part in past)), generator=share.noise)
            for share in shares
        ]
        return lambda u: self._joined(
            [step(u[share.rows]) for step, share in zip(steps, shares, strict=True)], shares, generator
        )

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        """States (B, K, dx) under ``actions`` (B, K, du)."""
        shares = list(self._shares(past.states, generator))
        states = [
            rollout(
                self.models[share.member], Segment(*(part[share.rows] for part in past)), actions[share.rows],
                generator=share.noise,
            )
            for share in shares
        ]  # fmt: skip
        return self._joined(states, shares, generator)

    def _shares(self, like: Tensor, noise: Noise | None) -> Iterator[Share]:
        """The rows of each member, for the mode all of them."""
        rows = torch.arange(len(like), device=like.device)
        if noise is None:
            yield from (Share(rows, k, None) for k in range(self.members))
        elif isinstance(noise, SeparateNoise):
            for part, own in zip(rows.split(len(rows) // len(noise.generators)), noise.generators, strict=True):
                yield from (Share(part[share.rows], share.member, own) for share in self._shares(like[part], own))
        else:
            member = draw_members(self.members, len(rows), noise, like[:, 0])
            for k in member.unique().tolist():
                yield Share(rows[member == k], k, _of_share(noise, member == k))

    def _joined(self, states: Iterable[Tensor], shares: Sequence[Share], noise: Noise | None) -> Tensor:
        """The members' states as rows (B, ..., dx)."""
        if noise is None:
            return torch.stack(list(states)).mean(0)
        return torch.cat(list(states))[torch.cat([share.rows for share in shares]).argsort()]


def _of_share(noise: Noise, chosen: Tensor) -> Noise | None:
    """The noise of some rows: members predict by their modes without any, and share it where all rows do."""
    if isinstance(noise, NoNoise):
        return None
    return SharedNoise(noise.generator, int(chosen[: noise.period].sum())) if isinstance(noise, SharedNoise) else noise
