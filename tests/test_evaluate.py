"""Scores against closed forms, on a linear system with Gaussian noise whose predictive distribution is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from tsmlib import evaluate
from tsmlib.nets import Features, Noise, standard_normal
from tsmlib.trajectory import Segment, Trajectories, Window

N, T, PAST = 300, 25, 3
HORIZON = T - PAST
NOISE = 0.3  # standard deviation added at every step
KEEP = torch.tensor([0.9, 0.5])  # x_{t+1} = KEEP x_t + u_t + noise


@dataclass
class Linear:
    """The system itself, as a model; ``breaks``: the share of samples that diverge."""

    noise: float = NOISE
    breaks: float = 0.0
    segment_len: int = 10
    past_len: int = PAST

    def loss(self, window: Window, generator: Noise) -> Tensor:
        raise NotImplementedError

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        x, states = past.states[:, -1], []
        for u in actions.unbind(1):
            x = KEEP * x + u
            if generator is not None:
                x = x + self.noise * standard_normal(x.shape, generator, x)
            states.append(x)
        predicted = torch.stack(states, 1)
        if self.breaks:
            broken = torch.rand(len(x), generator=generator) < self.breaks
            predicted[broken, 2:] = torch.tensor([torch.nan, torch.inf])
        return predicted


def episodes(n: int = N, seed: int = 0) -> Trajectories:
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=(n, T + 1, 2)), rng.uniform(-1, 1, (n, T, 2))
    for t in range(T):
        states[:, t + 1] = KEEP.numpy() * states[:, t] + actions[:, t] + NOISE * rng.normal(size=(n, 2))
    return Trajectories(
        states.astype(np.float32), actions.astype(np.float32), "tsm/Linear-v0", 0.02, ("a", "b"), ("m", "m"), ()
    )


def predictive_variance() -> Tensor:
    """(HORIZON, 2): the variance of x that the noise of k steps has built up."""
    k = torch.arange(1, HORIZON + 1)[:, None]
    return NOISE**2 * (1 - KEEP ** (2 * k)) / (1 - KEEP**2)


@pytest.fixture(scope="module")
def predicted() -> tuple[Tensor, Tensor]:
    return evaluate.predict(Linear(), Features(2, ()), episodes(), samples=400, horizon=HORIZON)


@pytest.fixture(scope="module")
def mean() -> Tensor:
    samples, _ = evaluate.predict(Linear(noise=0.0), Features(2, ()), episodes(), samples=1, horizon=HORIZON)
    return samples[0]


def gaussian(error: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum(-1)


def test_without_noise_the_prediction_is_the_truth() -> None:
    data = episodes(20)
    for t in range(PAST, T):
        data.states[:, t + 1] = KEEP.numpy() * data.states[:, t] + data.actions[:, t]
    samples, truth = evaluate.predict(Linear(noise=0.0), Features(2, ()), data, samples=2, horizon=HORIZON)
    assert samples.shape == (2, 20, HORIZON, 2)
    torch.testing.assert_close(samples, truth.expand_as(samples), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(truth, data.states[:, PAST + 1 :])


def test_the_papers_likelihood_is_the_analytic_one(predicted: tuple[Tensor, Tensor], mean: Tensor) -> None:
    samples, truth = predicted
    estimate = evaluate.ll_paper(samples, truth, floor=0.0)
    assert estimate.shape == (N, HORIZON)
    exact = gaussian(truth - mean, predictive_variance())
    assert abs(estimate.mean(0) - exact.mean(0)).max() < 0.02  # nats, at every step


def test_the_shared_likelihood_is_the_analytic_one(predicted: tuple[Tensor, Tensor], mean: Tensor) -> None:
    samples, truth = predicted
    variance = evaluate.fit_shared(samples, truth)
    assert variance == pytest.approx(float(predictive_variance().mean()), rel=0.05)
    estimate = evaluate.ll_shared(samples, truth, variance)
    assert abs(estimate.mean(0) - gaussian(truth - mean, torch.tensor(variance)).mean(0)).max() < 0.02
    for other in (0.8 * variance, 1.2 * variance):
        assert evaluate.ll_shared(samples, truth, other).mean() < estimate.mean()


def test_the_floor_of_a_model_without_noise_is_its_error() -> None:
    error = 0.05 * torch.randn(4000, 3, 2, generator=torch.Generator().manual_seed(0))
    floor = evaluate.fit_floor(torch.zeros(5, 4000, 3, 2), error)
    assert floor == pytest.approx(0.05**2, rel=0.15)
    best = evaluate.ll_paper(torch.zeros(5, 4000, 3, 2), error, floor).mean()
    assert best == pytest.approx(gaussian(error, torch.tensor(0.05**2)).mean().item(), abs=0.02)


def test_the_energy_score_is_that_of_a_double_loop() -> None:
    draw = torch.Generator().manual_seed(0)
    samples, truth = torch.randn(7, 4, 3, 2, generator=draw), torch.randn(4, 3, 2, generator=draw)
    slow = torch.zeros(4, 3)
    for a in samples:
        slow += (a - truth).norm(dim=-1) / 7
        for b in samples:
            slow -= (a - b).norm(dim=-1) / (7 * 6) / 2  # a pair with itself adds nothing
    torch.testing.assert_close(evaluate.energy_score(samples, truth), slow)


def test_the_energy_score_of_a_normal_is_its_crps() -> None:
    samples = 0.7 * torch.randn(1500, 1, 5, 1, generator=torch.Generator().manual_seed(0))
    truth = torch.linspace(-1, 1, 5)[None, :, None]
    z, normal = truth[..., 0] / 0.7, torch.distributions.Normal(0.0, 1.0)
    crps = 0.7 * (z * (2 * normal.cdf(z) - 1) + 2 * normal.log_prob(z).exp() - math.pi**-0.5)
    torch.testing.assert_close(evaluate.energy_score(samples, truth), crps, rtol=0, atol=0.04)


def test_the_true_distribution_scores_best(predicted: tuple[Tensor, Tensor]) -> None:
    samples, truth = (part[..., ::5, :] for part in predicted)
    samples = samples[:60]
    best, centre = evaluate.energy_score(samples, truth).mean(), samples.mean(0)
    for spread in (0.5, 2.0):
        assert evaluate.energy_score(centre + spread * (samples - centre), truth).mean() > best


@pytest.mark.parametrize("level", [0.5, 0.8])
def test_the_truth_lies_within_the_interval_as_often_as_stated(predicted: tuple[Tensor, Tensor], level: float) -> None:
    assert evaluate.coverage(*predicted, level).mean() == pytest.approx(level, abs=0.02)


def test_the_root_mean_squared_error_is_the_predictive_deviation(predicted: tuple[Tensor, Tensor]) -> None:
    expected = predictive_variance().mean(1).sqrt()
    torch.testing.assert_close(evaluate.nrmse(*predicted), expected, rtol=0.1, atol=0)


def test_scores_are_in_units_of_the_training_data_without_what_never_moves() -> None:
    data = episodes(50)
    still = np.full_like(data.states[..., :1], 3.0)
    names = ("a", "b", "still")
    data = Trajectories(
        np.concatenate([100 * data.states, still], -1), data.actions, data.env, data.dt, names, ("cm", "cm", "m"), ()
    )
    features = Features(3, ()).fit(torch.from_numpy(data.states))

    class Copy(Linear):
        """Predicts that nothing changes."""

        def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
            return past.states[:, -1:].expand(-1, actions.shape[1], -1)

    samples, truth = evaluate.predict(Copy(), features, data, samples=2, horizon=HORIZON)
    assert truth.shape == (50, HORIZON, 2)
    assert truth.std() == pytest.approx(1.0, abs=0.15)
    in_cm = (data.states[:, PAST + 1 :, :2] - data.states[:, PAST : PAST + 1, :2]) / data.states[..., :2].std((0, 1))
    np.testing.assert_allclose(evaluate.nrmse(samples, truth), np.sqrt((in_cm**2).mean((0, 2))), rtol=0.01)


def test_the_same_seed_draws_the_same_samples() -> None:
    first, second, other = (
        evaluate.predict(Linear(), Features(2, ()), episodes(5), samples=3, horizon=HORIZON, seed=seed)[0]
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])


def test_a_diverged_sample_counts_as_worst(predicted: tuple[Tensor, Tensor]) -> None:
    samples, truth = predicted
    samples = samples[:20]
    floor = evaluate.fit_floor(samples, truth)
    broken, _ = evaluate.predict(Linear(breaks=0.2), Features(2, ()), episodes(), samples=20, horizon=HORIZON)
    assert torch.isfinite(broken).all()
    wrong = samples + 10
    assert evaluate.nrmse(broken, truth).max() > 100 * evaluate.nrmse(wrong, truth).max()
    assert evaluate.energy_score(broken, truth).mean() > 100 * evaluate.energy_score(wrong, truth).mean()
    assert evaluate.ll_shared(broken, truth, 1.0).mean() < 100 * evaluate.ll_shared(wrong, truth, 1.0).mean()
    assert evaluate.ll_paper(broken, truth, floor).mean() < evaluate.ll_paper(samples, truth, floor).mean() - 10


def test_a_horizon_beyond_the_episodes_is_refused() -> None:
    with pytest.raises(
        ValueError,
        match=f"horizon is {HORIZON + 1}; episodes of {T} steps with {PAST} observed first leave 1 to {HORIZON}",
    ):
        evaluate.predict(Linear(), Features(2, ()), episodes(3), samples=1, horizon=HORIZON + 1)
