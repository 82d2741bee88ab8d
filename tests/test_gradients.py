"""A gradient that is wrong is found, and a signal is as strong as its noise lets it be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import tsmlib
from reproduction.measures import gradients
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.tsm import TSM
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment


class Lying(torch.autograd.Function):
    """x squared, whose gradient is said to be 2.1 x."""

    @staticmethod
    def forward(ctx: object, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)  # type: ignore[attr-defined]
        return x.square()

    @staticmethod
    def backward(ctx: object, slope: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return 2.1 * x * slope


def test_a_true_gradient_is_confirmed_and_a_wrong_one_is_measured() -> None:
    x = torch.tensor([1.0, -2.0, 3.0], dtype=torch.double, requires_grad=True)
    before = x.detach().clone()
    assert gradients.relative_errors(lambda: x.square().sum(), [x])[0] < 1e-8
    assert gradients.relative_errors(lambda: Lying.apply(x).sum(), [x])[0] == pytest.approx(
        0.1 / 2.1, rel=1e-4
    )
    torch.testing.assert_close(x.detach(), before, rtol=0, atol=1e-15)


def test_a_value_that_does_not_depend_on_a_variable_is_refused() -> None:
    x, y = (torch.ones(3, dtype=torch.double, requires_grad=True) for _ in range(2))
    with pytest.raises(ValueError, match=r"variable 1, \(3,\), has no gradient"):
        gradients.relative_errors(lambda: x.sum(), [x, y])


def some_task(n: int = 3, *, horizon: int = 20) -> Task:
    return replace(tsmlib.load_task("tsm/Reacher-v0").take(n), horizon=horizon)


def prior() -> ActionPrior:
    torch.manual_seed(0)
    return ActionPrior(2, channels=8).fit_scale(0.1 * torch.randn(50, 30, 2))


def test_a_return_is_differentiable_in_codes_torques_and_weights() -> None:
    torch.manual_seed(0)
    model = TSM(6, 2, channels=8)
    model.features.fit(torch.randn(20, 30, 6).cumsum(1) * 0.01)
    net = prior()
    before = {
        name: p.detach().clone() for name, p in [*model.named_parameters(), *net.named_parameters()]
    }
    found = gradients.of_return(some_task(), model, net)
    assert set(found) == {"codes", "torques", "model", "prior"}
    assert 0 < max(found.values()) <= 1e-5
    after = dict([*model.named_parameters(), *net.named_parameters()])
    assert all(torch.equal(before[name], p) and p.dtype == torch.float for name, p in after.items())


class Pushed:
    """A world whose fingertip goes where it is pushed, and meets a wind of a strength that samples
    disagree on.
    """

    segment_len, past_len = 10, 1

    def __init__(self, wind: float) -> None:
        self.wind = wind

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        assert generator is not None
        strength = 1 + self.wind * standard_normal((len(actions), 1, 1), generator, actions)
        tip = past.states[:, -1:, 4:6] + 0.01 * (strength * actions).cumsum(1)
        still = past.states[:, -1:].expand(-1, actions.shape[1], -1)
        return torch.cat([still[..., :4], tip, still[..., 6:]], dim=-1)


def test_more_noise_in_the_world_is_less_signal_and_none_is_all() -> None:
    task, space = some_task(horizon=10), DirectActions(10, rms=0.1)
    strong, weak = (gradients.signal(task, Pushed(wind), space, samples=200) for wind in (0.1, 1.0))
    assert strong.shape == weak.shape == (3,)
    assert (strong > 5 * weak).all()
    certain = gradients.signal(task, Pushed(0.0), space, samples=4)
    np.testing.assert_allclose(certain, 1 / gradients.ROUNDING)


def test_the_signal_of_a_gradient_is_its_mean_over_its_deviation() -> None:
    """The return is minus the distance, far along one axis, so that its slope is that of the
    fingertip: known.
    """
    task = some_task(1, horizon=1)
    task.target[:] = torch.tensor([0.2, 0.0])
    task.start[:, 4:6] = [-0.2, 0.0]

    class Silent(DirectActions):
        """Zero torque, along the axis alone: no penalty."""

        shape = (1, 1)

        def __init__(self) -> None:
            self.scale = 0.0

        def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
            return torch.zeros(n, n_targets, 1, 1)

        def decode(self, parameters: Tensor) -> Tensor:
            return torch.cat([parameters.tanh(), torch.zeros_like(parameters)], dim=-1)

    found = gradients.signal(task, Pushed(0.5), Silent(), samples=4000)
    assert float(found) == pytest.approx(1 / 0.5, rel=0.05)


def test_a_signal_can_be_had_for_codes_and_is_a_function_of_its_seed() -> None:
    task, space = some_task(), LatentActions(prior(), 20)
    one, again, other = (
        gradients.signal(task, Pushed(0.5), space, samples=3, seed=seed) for seed in (0, 0, 1)
    )
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert all(math.isfinite(value) for value in one)
