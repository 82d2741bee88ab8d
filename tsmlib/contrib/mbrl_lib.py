"""mbrl-lib's models behind the planners and scores of this package.

mbrl-lib is not needed to import this module. Its own pins do not install beside today's Gymnasium,
so it is installed without them: ``pip install 'tsmlib[mbrl]'`` and then ``pip install --no-deps
mbrl==0.2.0``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from tsmlib.models.ensemble import Members


class Network(Protocol):
    """What is asked of the network inside: mbrl-lib's ``GaussianMLP`` has it."""

    num_members: int
    elite_models: list[int] | None

    def forward(self, x: Tensor, *, use_propagation: bool) -> tuple[Tensor, Tensor | None]: ...


class Normalizer(Protocol):
    """mbrl-lib's statistics of the inputs."""

    def normalize(self, val: Tensor) -> Tensor: ...


class TransitionModel(Protocol):
    """What is asked of mbrl-lib's model: ``OneDTransitionRewardModel`` has it."""

    model: Network
    input_normalizer: Normalizer | None
    obs_process_fn: Callable[[Tensor], Tensor] | None
    target_is_delta: bool
    no_delta_list: list[int]
    learned_rewards: bool


class MbrlModel(torch.nn.Module, Members):
    """A trained ``mbrl.models.OneDTransitionRewardModel`` with a ``GaussianMLP`` as a model of this
    package.

    Its observations are the states here, in physical units, and its actions those here, in [-1, 1].
    Of a learned reward nothing is used: rewards are functions here. Only the elite members predict,
    where there are some. TypeError naming what another object lacks.
    """

    def __init__(self, model: TransitionModel) -> None:
        super().__init__()
        inner = getattr(model, "model", None)
        missing = [name for name in TransitionModel.__annotations__ if not hasattr(model, name)]
        if inner is not None:
            missing += [
                f"model.{name}" for name in ("num_members", "forward") if not hasattr(inner, name)
            ]
        if missing:
            raise TypeError(
                f"{type(model).__name__} has no {', '.join(missing)}; expected an "
                "mbrl.models.OneDTransitionRewardModel around a GaussianMLP"
            )
        self.theirs = model
        elite = getattr(model.model, "elite_models", None)
        self.elite = list(range(model.model.num_members)) if elite is None else list(elite)
        self.members = len(self.elite)

    def increments(
        self, x: Tensor, u: Tensor, which: slice = slice(None)
    ) -> tuple[Tensor, Tensor | None]:
        theirs, seen, chosen = self.theirs, x, self.elite[which]
        if theirs.obs_process_fn is not None:
            seen = torch.as_tensor(theirs.obs_process_fn(x.flatten(0, 1))).to(x)
            seen = seen.unflatten(0, x.shape[:2])
        inputs = torch.cat([seen, u], dim=-1)
        if theirs.input_normalizer is not None:
            inputs = theirs.input_normalizer.normalize(inputs).to(x.dtype)
        # Every network takes the rows of its own member; others compute for nothing.
        every = inputs.new_zeros(theirs.model.num_members, *inputs.shape[1:])
        every[chosen] = inputs
        mean, log_variance = theirs.model.forward(every, use_propagation=False)
        dx = x.shape[-1]
        mean = mean[chosen][..., :dx]  # the last column is a learned reward
        if theirs.target_is_delta:
            absolute = torch.zeros(dx, dtype=torch.bool, device=x.device)
            absolute[theirs.no_delta_list] = True
            mean = torch.where(absolute, mean - x, mean)
        else:
            mean = mean - x
        return mean, None if log_variance is None else log_variance[chosen][..., :dx]
