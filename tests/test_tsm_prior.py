"""The learned prior of TSM's codes: what it sees, what it is worth, what it says without a plan."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from reproduction.measures import latent
from tsmlib import TSM
from tsmlib.models.base import rollout, stepper
from tsmlib.models.layers import kl_divergence, kl_from_standard_normal
from tsmlib.trajectory import Segment, Window

H, DX, DU, N = 4, 3, 2, 6


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def model(**options: object) -> TSM:
    torch.manual_seed(0)
    arguments = dict(segment_len=H, latent_dim=2, channels=8, prior="learned", full_encoder=True)
    net = TSM(DX, DU, **arguments | options)
    net.features.fit(torch.randn(20, 9, DX, generator=draw()).cumsum(1))
    return net


def awake(net: TSM) -> TSM:
    """With a prior that says something of the past and of each planned action."""
    torch.nn.init.normal_(net.code_prior.project.weight, std=0.5, generator=draw(3))
    return net


def window(n: int = N, segments: int = 1, seed: int = 1) -> Window:
    states = torch.randn(n, H * (1 + segments), DX, generator=draw(seed)).cumsum(1)
    actions = torch.rand(n, H * (1 + segments), DU, generator=draw(seed + 1)) * 2 - 1
    return Window(Segment(states[:, :H], actions[:, :H]), Segment(states[:, H:], actions[:, H:]))


def test_the_divergence_of_two_gaussians_is_the_textbook_s() -> None:
    mean, log_variance, m, log_v = torch.randn(4, 5, 3, generator=draw())
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(
        normal(mean, (log_variance / 2).exp()), normal(m, (log_v / 2).exp())
    )
    torch.testing.assert_close(
        kl_divergence(mean, log_variance, m, log_v), expected.sum(1), rtol=1e-4, atol=1e-5
    )
    by_dimension = latent.kl_by_dimension(mean, log_variance, m, log_v)
    torch.testing.assert_close(by_dimension, expected, rtol=1e-4, atol=1e-5)


def test_an_untrained_prior_is_the_papers() -> None:
    net, (past, future) = model(), window()
    for part in net.prior(past, future.actions):
        assert not part.any()
    z = net.draw(past, future.actions, generator=draw())
    assert torch.equal(z, torch.randn(N, 2, generator=draw()))
    mean, log_variance = net.posterior(past, future)
    torch.testing.assert_close(
        kl_divergence(mean, log_variance, *net.prior(past, future.actions)),
        kl_from_standard_normal(mean, log_variance),
    )


def test_one_action_after_the_other_is_the_whole_segment_where_its_plan_is_told() -> None:
    net, (past, future) = awake(model()), window()
    whole = net.predict_segment(past, future.actions, generator=draw())
    step = net.begin(past, planned=future.actions, generator=draw())
    torch.testing.assert_close(torch.stack([step(u) for u in future.actions.unbind(1)], 1), whole)


@pytest.mark.parametrize("k", range(H + 1))
def test_a_part_of_a_plan_is_that_plan_with_the_rest_hidden(k: int) -> None:
    net, (past, future) = awake(model()), window()
    hidden = net.prior(past, future.actions, k=torch.full((N, 1), k))
    for part, expected in zip(net.prior(past, future.actions[:, :k]), hidden, strict=True):
        torch.testing.assert_close(part, expected)
    other = future.actions.clone()
    other[:, k:] += 1
    for part, expected in zip(net.prior(past, other, k=torch.full((N, 1), k)), hidden, strict=True):
        assert torch.equal(part, expected)


def test_a_rollout_that_ends_within_a_segment_draws_its_code_from_what_is_planned() -> None:
    net, (past, future) = awake(model()), window(segments=2)
    actions = future.actions[:, : H + 1]
    states = rollout(net, past, actions)
    second = past.then(Segment(states[:, :H], actions[:, :H])).last(H)
    torch.testing.assert_close(states[:, H:], net.predict_segment(second, actions[:, H:]))


def test_who_decides_step_by_step_has_the_code_of_the_past_alone() -> None:
    net, (past, future) = awake(model()), window()
    step = stepper(net, past, generator=draw())
    states = torch.stack([step(u) for u in future.actions.unbind(1)], 1)
    z = net.draw(past, generator=draw())
    torch.testing.assert_close(states, net.decode(past, future.actions, z))


def test_of_a_hidden_plan_the_posterior_learns_nothing() -> None:
    """So that hiding it costs the codes nothing: only the prior has a gradient of that part."""
    net, (past, future) = awake(model(beta=1.0)), window()
    mean, log_variance = net.posterior(past, future)
    _, kl = net._posterior_code(past, future, draw())
    shown = kl_divergence(mean, log_variance, *net.prior(past, future.actions))
    encoder = list(net.encoder.parameters())
    both, alone = (torch.autograd.grad(x.sum(), encoder, retain_graph=True) for x in (kl, shown))
    for found, expected in zip(both, alone, strict=True):
        torch.testing.assert_close(found, expected)
    assert (kl > shown).all()


def coins(n: int, seed: int) -> Window:
    """Two things that go the way of a coin each: one is thrown by the plan, one by the world."""
    toss = torch.randint(2, (n, 2), generator=draw(seed)).float() * 2 - 1
    actions = torch.zeros(n, 2 * H, 1)
    actions[:, H:] = toss[:, None, :1]
    ways = torch.arange(1, H + 1)[:, None] * toss[:, None]  # (N, H, 2)
    states = torch.cat([torch.zeros(n, H, 2), ways], 1)
    return Window(Segment(states[:, :H], actions[:, :H]), Segment(states[:, H:], actions[:, H:]))


def test_a_code_carries_what_nobody_can_know_and_no_more() -> None:
    """Of a coin that the plan shows nothing; of one that only the world has thrown its one bit."""
    torch.manual_seed(0)
    options = dict(segment_len=H, latent_dim=1, channels=16, full_encoder=True, beta=0.05)
    net = TSM(2, 1, prior="learned", dilations=(1, 2), **options)
    net.features.fit(coins(200, 0).future.states)
    optimizer, noise = torch.optim.Adam(net.parameters(), 1e-2), draw()
    for step in range(300):
        optimizer.zero_grad()
        net.loss(coins(64, 100 + step), noise).backward()
        optimizer.step()
    past, future = coins(200, 1)
    nats = kl_divergence(*net.posterior(past, future), *net.prior(past, future.actions)).mean()
    assert 0.5 * math.log(2) < nats < 4 * math.log(2)
    ends: Tensor = net.predict_segment(past, future.actions, generator=draw())[:, -1]
    told = (ends[:, 0] - future.states[:, -1, 0]).abs() < 0.5 * H
    assert told.float().mean() > 0.85
    up = (ends[:, 1] > 0).float().mean()
    assert 0.2 < up < 0.8
    assert (ends[:, 1].abs() > 0.5 * H).float().mean() > 0.8


def test_a_decoder_that_is_taken_predicts_as_before_until_codes_come_alive() -> None:
    first = model(prior="normal", full_encoder=False)
    with torch.no_grad():
        first.decoder.codes.weight.zero_()  # dead codes
    net, (past, future) = model(), window()
    v = net.decoder.codes.weight.clone()
    net.take_decoder(first)
    expected = first.predict_segment(past, future.actions)
    torch.testing.assert_close(net.predict_segment(past, future.actions), expected)
    torch.testing.assert_close(net.decoder.codes.weight, 0.2 * v)
    with pytest.raises(ValueError, match="the decoders differ in size"):
        net.take_decoder(model(channels=4))


def test_a_wrong_word_and_an_encoder_that_sees_more_are_named() -> None:
    with pytest.raises(ValueError, match="normal.*learned"):
        TSM(DX, DU, prior="learnt")
    with pytest.raises(ValueError, match=r"call model.posterior\(past, future\)"):
        model().encode(window().future.states)
