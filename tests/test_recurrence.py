"""The recurrence and its backward pass are those of the same equations, written plainly."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tsmlib.models.baselines import LSTM
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.trajectory import Segment

B, L, K, DX, DU = 4, 5, 13, 5, 2
MODELS: dict[str, Any] = {
    "rtsm": lambda angles: RecurrentTSM(
        DX, DU, angles=angles, hidden=6, latent_dim=3, past_len=L, code_len=4
    ),
    "lstm": lambda angles: LSTM(DX, DU, angles=angles, hidden=6, past_len=L),
}
DTYPES = pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
ANGLES = pytest.mark.parametrize("angles", [(0, 1), (), (3, 1)], ids=str)


def plain(net: Any, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
    """The equations of ``models.recurrence``, one operation after the other."""
    layers = net.decoder if isinstance(net, RecurrentTSM) else net

    def advance(
        x: Tensor, u: Tensor, h: Tensor, c: Tensor, code: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        seen = torch.cat([net.features(x), u], dim=-1)
        q = layers.cell(torch.cat([seen, h], dim=-1))
        q = q + layers.codes(code) if hasattr(layers, "codes") else q
        forget, write, read, new = q.chunk(4, dim=-1)
        c = forget.sigmoid() * c + write.sigmoid() * new.tanh()
        h = read.sigmoid() * c.tanh()
        change = (
            layers.head(torch.cat([h, seen], dim=-1)) if hasattr(layers, "head") else layers.out(h)
        )
        return x + net.features.step_std * change, h, c

    h = c = actions.new_zeros(len(actions), net.hidden)
    for x, u in zip(past.states[:, :-1].unbind(1), past.actions[:, 1:].unbind(1), strict=True):
        _, h, c = advance(x, u, h, c, torch.zeros_like(z[:, 0]))
    x, states = past.states[:, -1], []
    for k, u in enumerate(actions.unbind(1)):
        code = z[:, k // 4] if k // 4 < z.shape[1] else torch.zeros_like(z[:, 0])
        x, h, c = advance(x, u, h, c, code)
        states.append(x)
    return torch.stack(states, dim=1)


def fast(net: Any, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
    return (
        net.decode(past, actions, z)
        if isinstance(net, RecurrentTSM)
        else net.predict_segment(past, actions)
    )


def setting(
    name: str, angles: tuple[int, ...], dtype: torch.dtype
) -> tuple[Any, Segment, Tensor, Tensor]:
    torch.manual_seed(0)
    net = MODELS[name](angles)
    net.features.fit(torch.randn(20, 31, DX).cumsum(1))
    net.to(dtype)
    past = Segment(torch.randn(B, L, DX, dtype=dtype), torch.randn(B, L, DU, dtype=dtype))
    return net, past, torch.randn(B, K, DU, dtype=dtype), torch.randn(B, 2, 3, dtype=dtype)


@DTYPES
@ANGLES
@pytest.mark.parametrize("name", MODELS)
def test_values_and_gradients_are_those_of_the_plain_equations(
    name: str, angles: tuple[int, ...], dtype: torch.dtype, atol: float
) -> None:
    net, past, actions, z = setting(name, angles, dtype)
    known = [part.requires_grad_() for part in (*past, actions, z)]
    weights = torch.randn(B, K, DX, dtype=dtype)
    found = []
    for way in (fast, plain):
        states = way(net, past, actions, z)
        whole = [*known, *net.parameters()]
        found.append(
            (states, torch.autograd.grad((weights * states.sin()).sum(), whole, allow_unused=True))
        )
    (ours, ours_d), (theirs, theirs_d) = found
    torch.testing.assert_close(ours, theirs, rtol=atol, atol=atol)
    for one, other in zip(ours_d, theirs_d, strict=True):
        if one is not None or other is not None:  # codes are nothing to the LSTM
            torch.testing.assert_close(one, other, rtol=atol, atol=atol)


@pytest.mark.parametrize("name", MODELS)
def test_weights_alone_have_the_same_gradient_as_beside_actions_and_codes(name: str) -> None:
    net, past, actions, z = setting(name, (0, 1), torch.float64)
    few = torch.autograd.grad(fast(net, past, actions, z).square().sum(), list(net.parameters()))
    for part in (actions, z):
        part.requires_grad_()
    many = torch.autograd.grad(fast(net, past, actions, z).square().sum(), list(net.parameters()))
    for one, other in zip(few, many, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_what_runs_without_gradients_is_what_is_trained(name: str) -> None:
    net, past, actions, z = setting(name, (3, 1), torch.float64)
    with torch.no_grad():
        without = fast(net, past, actions, z)
    assert torch.equal(without, fast(net, past, actions, z))


@pytest.mark.parametrize("name", MODELS)
def test_a_second_backward_pass_finds_what_the_first_found(name: str) -> None:
    net, past, actions, z = setting(name, (0, 1), torch.float64)
    value = fast(net, past, actions, z).square().sum()
    twice = [
        torch.autograd.grad(value, list(net.parameters()), retain_graph=True) for _ in range(2)
    ]
    assert all(torch.equal(*pair) for pair in zip(*twice, strict=True))


@pytest.mark.parametrize("name", MODELS)
def test_a_past_of_one_step_says_nothing_of_what_was_before(name: str) -> None:
    net, past, actions, z = setting(name, (0, 1), torch.float64)
    torch.testing.assert_close(
        fast(net, past.last(1), actions, z), plain(net, past.last(1), actions, z)
    )


@pytest.mark.parametrize("batch", [4, 33, 48])
def test_nothing_depends_on_memory_that_was_never_written(
    batch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    net, *_ = setting("rtsm", (0, 1), torch.float32)
    past, actions = (
        Segment(torch.randn(batch, L, DX), torch.randn(batch, L, DU)),
        torch.randn(batch, K, DU),
    )
    empty, empty_like = torch.Tensor.new_empty, torch.empty_like

    def spoiled(make: Any) -> Any:
        return lambda *given, **more: make(*given, **more).fill_(torch.nan)

    monkeypatch.setattr(torch.Tensor, "new_empty", spoiled(empty))
    monkeypatch.setattr(torch, "empty_like", spoiled(empty_like))
    states = net.decode(past, actions, torch.randn(batch, 2, 3))
    gradients = torch.autograd.grad(states.square().sum(), net.decoder.parameters())
    assert all(torch.isfinite(part).all() for part in (states, *gradients))
