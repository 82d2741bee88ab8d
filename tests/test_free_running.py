"""A free-running segment and its backward pass are those of the decoder's steps, one by one."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tsmlib.models.tsm import TSM
from tsmlib.trajectory import Segment

B, K, DX, DU = 4, 13, 5, 2
OPTIONS: dict[str, Any] = {
    "paper's": {},
    "wide head": {"head_channels": 7},
    "plain": {"plain": True},
    "one layer": {"dilations": (3,)},
    "long": {"dilations": (1, 2, 4, 8, 16, 8)},
    "not ordered": {"dilations": (5, 1, 2)},
}
DTYPES = pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
SETTINGS = pytest.mark.parametrize("name", OPTIONS)


def plain(net: TSM, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
    """One step after the other, by autograd."""
    step = net._begin(past, z)
    return torch.stack([step(u) for u in actions.unbind(1)], dim=1)


def setting(
    name: str,
    dtype: torch.dtype,
    *,
    angles: tuple[int, ...] = (0, 1),
    seen: int = 10,
    n: int = B,
) -> tuple[TSM, Segment, Tensor, Tensor]:
    torch.manual_seed(0)
    net = TSM(DX, DU, angles=angles, latent_dim=3, channels=6, **OPTIONS[name])
    net.features.fit(torch.randn(20, 31, DX).cumsum(1))
    net.to(dtype)
    past = Segment(torch.randn(n, seen, DX, dtype=dtype), torch.randn(n, seen, DU, dtype=dtype))
    return net, past, torch.randn(n, K, DU, dtype=dtype), torch.randn(n, 3, dtype=dtype)


def assert_same(net: TSM, past: Segment, actions: Tensor, z: Tensor, atol: float) -> None:
    whole = [part.requires_grad_() for part in (*past, actions, z)] + [*net.decoder.parameters()]
    weights, found = torch.randn(*actions.shape[:2], DX, dtype=z.dtype), []
    for way in (net.decode, lambda *given: plain(net, *given)):
        states = way(past, actions, z)
        found.append((states, torch.autograd.grad((weights * states.sin()).sum(), whole)))
    (ours, ours_d), (theirs, theirs_d) = found
    torch.testing.assert_close(ours, theirs, rtol=atol, atol=atol)
    for one, other in zip(ours_d, theirs_d, strict=True):
        torch.testing.assert_close(one, other, rtol=atol, atol=atol)


@DTYPES
@SETTINGS
def test_values_and_gradients_are_those_of_single_steps(
    name: str, dtype: torch.dtype, atol: float
) -> None:
    assert_same(*setting(name, dtype), atol)


@pytest.mark.parametrize("angles", [(), (3, 1)], ids=str)
def test_angles_may_stand_anywhere(angles: tuple[int, ...]) -> None:
    assert_same(*setting("wide head", torch.float64, angles=angles), 1e-10)


@pytest.mark.parametrize("seen", [1, 2, 3, 9, 40])
@pytest.mark.parametrize("name", ["paper's", "plain", "one layer"])
def test_a_past_may_be_short_or_long(name: str, seen: int) -> None:
    assert_same(*setting(name, torch.float64, seen=seen), 1e-10)


@SETTINGS
@pytest.mark.parametrize("seen", [1, 10])
def test_what_runs_without_gradients_is_what_is_trained(name: str, seen: int) -> None:
    net, past, actions, z = setting(name, torch.float64, seen=seen)
    with torch.no_grad():
        without = net.decode(past, actions, z)
    torch.testing.assert_close(without, net.decode(past, actions, z), rtol=1e-12, atol=1e-12)


def test_a_second_backward_pass_finds_what_the_first_found() -> None:
    net, past, actions, z = setting("wide head", torch.float64)
    value, weights = net.decode(past, actions, z).square().sum(), list(net.decoder.parameters())
    twice = [torch.autograd.grad(value, weights, retain_graph=True) for _ in range(2)]
    assert all(torch.equal(*pair) for pair in zip(*twice, strict=True))


def test_a_gradient_of_a_gradient_is_refused() -> None:
    net, past, actions, z = setting("paper's", torch.float64)
    value = net.decode(past, actions.requires_grad_(), z).square().sum()
    (slope,) = torch.autograd.grad(value, actions, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


@SETTINGS
@pytest.mark.parametrize("seen", [1, 10])
def test_nothing_depends_on_memory_that_was_never_written(
    name: str, seen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    net, past, actions, z = setting(name, torch.float32, seen=seen, n=33)
    empty, empty_like = torch.Tensor.new_empty, torch.empty_like

    def spoiled(make: Any) -> Any:
        return lambda *given, **more: make(*given, **more).fill_(torch.nan)

    monkeypatch.setattr(torch.Tensor, "new_empty", spoiled(empty))
    monkeypatch.setattr(torch, "empty_like", spoiled(empty_like))
    states = net.decode(past, actions, z)
    gradients = torch.autograd.grad(states.square().sum(), list(net.decoder.parameters()))
    assert all(torch.isfinite(part).all() for part in (states, *gradients))
