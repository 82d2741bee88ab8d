"""The plain path of the benchmarks is the oracle of the fast one: the same outputs and gradients, on both its paths."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from _plain import PlainDecoder, PlainPrior, PlainTSM
from torch import Tensor

from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import predict_segment
from tsmlib.models.layers import CausalDecoder
from tsmlib.models.tsm import TSM
from tsmlib.trajectory import Segment, Window

B, H, DX, DU = 5, 10, 6, 2
HEADS: dict[str, dict[str, int]] = {"basic": {}, "contacts": {"head_channels": 12}, "state skip": {"state_skip": 12}}
DTYPES = pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])


def gradients(value: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    return list(torch.autograd.grad(value.square().sum(), inputs))


@DTYPES
@pytest.mark.parametrize("head", HEADS)
def test_all_positions_at_once_are_eq_1(head: str, dtype: torch.dtype, atol: float) -> None:
    torch.manual_seed(0)
    decoder = CausalDecoder(8, DX, 4, channels=16, **HEADS[head]).to(dtype)
    plain = PlainDecoder(decoder).to(dtype)
    inputs = torch.randn(B, 23, 8, dtype=dtype, requires_grad=True)
    z = torch.randn(B, 4, dtype=dtype, requires_grad=True)
    fast, slow = decoder(inputs, z), plain(inputs, z)
    torch.testing.assert_close(fast, slow, rtol=atol, atol=atol)
    for ours, theirs in zip(gradients(fast, [inputs, z]), gradients(slow, [inputs, z]), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=10 * atol, atol=10 * atol)
    taps = gradients(decoder(inputs, z), [decoder.layers[1].taps.weight])[0]
    parts = gradients(plain(inputs, z), [plain.layers[1].filter.weight, plain.layers[1].gate.weight])
    side_by_side = torch.cat([torch.cat([part[..., 0], part[..., 1]], dim=1) for part in parts])
    torch.testing.assert_close(taps, side_by_side, rtol=10 * atol, atol=10 * atol)


@DTYPES
@pytest.mark.parametrize("head", HEADS)
def test_one_position_after_the_other_is_eq_1(head: str, dtype: torch.dtype, atol: float) -> None:
    torch.manual_seed(0)
    decoder = CausalDecoder(8, DX, 4, channels=16, **HEADS[head]).to(dtype)
    plain = PlainDecoder(decoder).to(dtype)
    inputs, z = torch.randn(B, 23, 8, dtype=dtype), torch.randn(B, 4, dtype=dtype)
    cache = plain.begin(inputs[:, :9], z)
    steps = [plain.step(x, z, cache) for x in inputs[:, 9:].unbind(1)]
    torch.testing.assert_close(decoder(inputs, z)[:, 9:], torch.stack(steps, dim=1), rtol=atol, atol=atol)


@pytest.mark.parametrize("loss", ["teacher_forced_loss", "loss", "energy_loss"])
@pytest.mark.parametrize("head", HEADS)
def test_training_minimises_what_it_says_plainly(head: str, loss: str) -> None:
    torch.manual_seed(0)
    model = TSM(DX, DU, channels=16, **HEADS[head]).double()
    model.features.fit(torch.randn(20, 31, DX, dtype=torch.float64).cumsum(1))
    plain = PlainTSM(model).double()
    drawn = Segment(torch.randn(B, 3 * H, DX).double(), torch.randn(B, 3 * H, DU).double())
    window = Window(Segment(*(p[:, :H] for p in drawn)), Segment(*(p[:, H:] for p in drawn)))
    fast, slow = (getattr(net, loss)(window, torch.Generator().manual_seed(1)) for net in (model, plain))
    torch.testing.assert_close(fast, slow)
    inlets = [gradients(value, [net.decoder.inlet.weight])[0] for value, net in ((fast, model), (slow, plain))]
    torch.testing.assert_close(*inlets)


@pytest.mark.parametrize("seed", [None, 3])
def test_predictions_are_the_plain_ones(seed: int | None) -> None:
    torch.manual_seed(0)
    model = TSM(DX, DU, channels=16, head_channels=12).double()
    plain = PlainTSM(model).double()
    past = Segment(torch.randn(B, H, DX).double(), torch.randn(B, H, DU).double())
    actions = torch.randn(B, H, DU).double()

    def noise() -> Any:
        return None if seed is None else torch.Generator().manual_seed(seed)

    ours, theirs = (predict_segment(net, past, actions, generator=noise()) for net in (model, plain))
    torch.testing.assert_close(ours, theirs)


def test_codes_decode_to_the_plain_torques() -> None:
    torch.manual_seed(0)
    prior = ActionPrior(DU, channels=16).double()
    prior.fit_scale(torch.randn(20, 30, DU).double())
    past, codes = torch.zeros(B, H, DU).double(), torch.randn(B, 3, prior.latent_dim).double()
    torch.testing.assert_close(prior.plan(past, codes), PlainPrior(prior).double().plan(past, codes))
