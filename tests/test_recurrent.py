"""RecurrentTSM: codes in the gates, a hidden state that is carried, and the energy score."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tsmlib.models.base import rollout, stepper
from tsmlib.models.energy import energy_score
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.trajectory import Segment, Window

B, DX, DU, H = 6, 5, 2, 4


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def model(segment_len: int = 100) -> RecurrentTSM:
    torch.manual_seed(0)
    net = RecurrentTSM(
        DX,
        DU,
        hidden=8,
        latent_dim=3,
        past_len=H,
        code_len=H,
        segment_len=segment_len,
    )
    net.features.fit(torch.randn(20, 31, DX, generator=rng()).cumsum(1))
    return net.double()


def window(steps: int) -> Window:
    draw = rng(1)
    parts = (torch.randn(B, n, d, generator=draw).double() for n in (H, steps) for d in (DX, DU))
    past, before, future, actions = parts
    return Window(Segment(past, before), Segment(future, actions))


def test_codes_that_differ_in_the_second_segment_differ_from_there_on() -> None:
    net, (past, future) = model(), window(3 * H)
    z = torch.randn(B, 3, 3, generator=rng()).double()
    other = z.clone()
    other[:, 1] += 1
    ours, theirs = (net.decode(past, future.actions, codes) for codes in (z, other))
    assert torch.equal(ours[:, :H], theirs[:, :H])
    assert (ours[:, H:] != theirs[:, H:]).all()
    assert torch.equal(
        net.decode(past, future.actions, z[:, 0]), net.decode(past, future.actions, z[:, :1])
    )


@pytest.mark.parametrize("seed", [None, 0])
def test_the_hidden_state_is_carried_from_code_to_code(seed: int | None) -> None:
    net, (past, future) = model(), window(20)

    def noise() -> torch.Generator | None:
        return None if seed is None else rng(seed)

    whole = rollout(net, past, future.actions, generator=noise())
    for begun in (net.begin(past, generator=noise()), stepper(net, past, generator=noise())):
        steps = torch.stack([begun(u) for u in future.actions.unbind(1)], dim=1)
        torch.testing.assert_close(steps, whole, rtol=1e-12, atol=1e-12)
    anew = rollout(
        model(segment_len=10), past, future.actions, generator=noise()
    )  # which begins again after ten
    torch.testing.assert_close(anew[:, :10], whole[:, :10], rtol=1e-12, atol=1e-12)
    assert (anew[:, 10:] - whole[:, 10:]).abs().max() > 1e-6


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_energy_score_is_what_a_double_loop_makes_of_it(n: int) -> None:
    samples, truth = (
        torch.randn(n, B, H, DX, generator=rng()).double(),
        torch.randn(B, H, DX, generator=rng(1)).double(),
    )
    found = []
    for b in range(B):
        off = sum(math.dist(x.flatten(), truth[b].flatten()) for x in samples[:, b]) / n
        apart = [
            math.dist(samples[i, b].flatten(), samples[j, b].flatten())
            for i in range(n)
            for j in range(n)
            if i != j
        ]
        found.append(off - sum(apart) / len(apart) / 2 if apart else off)
    assert float(energy_score(samples, truth)) == pytest.approx(sum(found) / B, rel=1e-6)


def test_the_loss_is_the_energy_score_of_two_rollouts() -> None:
    seen = window(2 * H)
    past, future = seen

    def features(net: RecurrentTSM, states: Tensor) -> list[Tensor]:
        return list(net.features(states).split(H, dim=1))

    net = model().requires_grad_(False)
    both = Segment(*(part.repeat(2, 1, 1) for part in past))
    drawn = rollout(net, both, future.actions.repeat(2, 1, 1), generator=rng())
    first, second, mode = *drawn.chunk(2), rollout(net, past, future.actions)
    total = 0.0
    for a, b, x in zip(
        *(features(net, states) for states in (first, second, future.states)), strict=True
    ):
        off = lambda one, other: (one - other).flatten(1).norm(dim=1).mean()  # noqa: E731
        total += float((off(a, x) + off(b, x) - off(a, b)) / 2) / 2
    assert float(net.loss(seen, rng())) == pytest.approx(total, rel=1e-6)
    points = [
        (m - x).flatten(1).norm(dim=1).mean()
        for m, x in zip(features(net, mode), features(net, future.states), strict=True)
    ]
    assert float(net.point_loss(seen, rng())) == pytest.approx(float(sum(points)) / 2, rel=1e-6)
