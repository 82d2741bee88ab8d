"""Scores against closed forms, on a linear system whose predictive distribution is known."""

import math

import numpy as np
import pytest
import torch

from reproduction.measures import contacts
from tsmlib.evaluation import prediction, scoring
from tsmlib.models.features import Features
from tsmlib.sampling import standard_normal
from tsmlib.trajectory import Trajectories

N, T, PAST = 300, 25, 3
HORIZON = T - PAST
NOISE = 0.3  # standard deviation added at every step
KEEP = torch.tensor([0.9, 0.5])  # x_{t+1} = KEEP x_t + u_t + noise
VARIANCE = NOISE**2 * (1 - KEEP ** (2 * torch.arange(1, HORIZON + 1)[:, None])) / (1 - KEEP**2)
FEATURES = Features(2, ())
FEATURES.step_std.fill_(1.0)


class Linear:
    """The system itself, as a model; ``breaks``: the share of samples that diverge."""

    segment_len, past_len, breaks = 10, PAST, 0.0

    def predict_segment(self, past, actions, *, generator=None):
        x, states = past.states[:, -1], []
        for u in actions.unbind(1):
            x = KEEP * x + u
            if generator is not None:
                x = x + NOISE * standard_normal(x.shape, generator, x)
            states.append(x)
        predicted = torch.stack(states, 1)
        if self.breaks:
            broken = torch.rand(len(x), generator=generator) < self.breaks
            predicted[broken, 2:] = torch.tensor([torch.nan, torch.inf])
        return predicted


class Mode(Linear):
    """The system without its noise, as a deterministic model."""

    stochastic = False


def episodes(n=N, seed=0):
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=(n, T + 1, 2)), rng.uniform(-1, 1, (n, T, 2))
    for t in range(T):
        noise = NOISE * rng.normal(size=(n, 2))
        states[:, t + 1] = KEEP.numpy() * states[:, t] + actions[:, t] + noise
    return Trajectories(states, actions, "Linear-v0", 0.02, ("a", "b"), ("m", "m"))


def draw(model, data, samples, seed=0):
    drawn = prediction.sample_states(
        model, data, samples=samples, horizon=HORIZON, starts=(PAST,), seed=seed
    )
    return drawn, torch.from_numpy(data.states[:, PAST + 1 :])


def score(model, data, samples=20, **how):
    how = dict(horizon=HORIZON, starts=(PAST,)) | how
    return prediction.score(model, FEATURES, data, episodes(40, seed=1), samples=samples, **how)


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def gaussian(error, variance):
    return -0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum(-1)


@pytest.fixture(scope="module")
def predicted():
    return draw(Linear(), episodes(), samples=400)


@pytest.fixture(scope="module")
def values(predicted):
    fitted = scoring.fit(*draw(Linear(), episodes(seed=1), samples=400, seed=1), copies=400)
    assert fitted.shared == pytest.approx(float(VARIANCE.mean()), rel=0.1)
    torch.testing.assert_close(fitted.horizon, VARIANCE, rtol=0.35, atol=0)
    assert fitted.noise.sqrt().median() < 0.15  # its own noise builds up to 0.3 .. 0.7
    return scoring.measure(*predicted, fitted, 400, torch.Generator().manual_seed(0))[0]


def test_segments_start_from_the_true_past():
    data = episodes(6)
    states = prediction.sample_states(Mode(), data, samples=1, horizon=5, starts=(5, 10, 20))
    for row, start in ((0, 5), (1, 10), (2, 20), (17, 20)):
        expected = KEEP.numpy() * data.states[row // 3, start] + data.actions[row // 3, start]
        np.testing.assert_allclose(states[0, row, 0], expected, rtol=1e-5, atol=1e-6)


# Likelihoods


@pytest.mark.parametrize("name", ["ll_paper", "ll_horizon", "ll_own", "ll_shared"])
def test_a_likelihood_is_the_analytic_one(name, predicted, values):
    error = predicted[1] - draw(Mode(), episodes(), samples=1)[0][0]
    exact = gaussian(error, VARIANCE.mean() if name == "ll_shared" else VARIANCE)
    assert values[name].mean() == pytest.approx(exact.mean().item(), abs=0.05)  # nats


def test_residual_noise_is_told_apart_from_the_spread_of_the_samples():
    samples, truth = 0.8 * normal(200, 4000, 1, 2), normal(4000, 1, 2, seed=1)
    own = scoring.fit_own(samples, truth)
    torch.testing.assert_close(own, torch.full((1, 2), 0.36), rtol=0.3, atol=0)
    exact = gaussian(truth, torch.ones(2)).mean()
    assert scoring.ll_own(samples, truth, own).mean() == pytest.approx(exact.item(), abs=0.02)
    lacking = scoring.fit_noise(samples[:60, :3000], truth[:3000], copies=60)
    assert lacking.sqrt().median() == pytest.approx(0.6, rel=0.25)


def test_two_modes_are_told_from_one_in_between():
    side, samples = normal(600, 1, 1).sign(), normal(100, 600, 1, 1, seed=1).sign()
    truth = side + 0.1 * normal(600, 1, 1, seed=2)
    fitted = scoring.fit(samples, truth, copies=1)
    scores, _ = scoring.measure(samples, truth, fitted, 1, torch.Generator())
    exact = math.log(0.5) - 0.5 * (1 + math.log(2 * math.pi * 0.1**2))
    assert scores["ll_own"].mean() == pytest.approx(exact, abs=0.05)
    assert scores["ll_own"].mean() > scores["ll_paper"].mean() + 1


# Proper scores


def slow_distances(samples, truth):
    n = len(samples)
    energy, crps = torch.zeros(truth.shape[:2]), torch.zeros(truth.shape[:2])
    for a in samples:
        energy += (a - truth).norm(dim=-1) / n
        crps += (a - truth).abs().mean(-1) / n
        for b in samples:  # a pair with itself adds nothing
            energy -= (a - b).norm(dim=-1) / (n * (n - 1)) / 2
            crps -= (a - b).abs().mean(-1) / (n * (n - 1)) / 2
    return energy, crps


def test_energy_score_and_crps_are_those_of_a_double_loop():
    samples, truth = normal(7, 4, 3, 2), normal(4, 3, 2, seed=1)
    slow = slow_distances(samples, truth)
    for fast, exact in zip(scoring.distances(samples, truth, shifts=6), slow, strict=True):
        torch.testing.assert_close(fast, exact)


def test_the_scores_of_a_normal_are_its_crps():
    samples, truth = 0.7 * normal(4000, 1, 5, 1), torch.linspace(-1, 1, 5)[None, :, None]
    z, unit = truth[..., 0] / 0.7, torch.distributions.Normal(0.0, 1.0)
    crps = 0.7 * (z * (2 * unit.cdf(z) - 1) + 2 * unit.log_prob(z).exp() - math.pi**-0.5)
    for found in scoring.distances(samples, truth):
        torch.testing.assert_close(found, crps, rtol=0, atol=0.03)


def test_a_single_sample_is_scored_by_its_distance():
    energy, crps = scoring.distances(torch.zeros(1, 1, 1, 2), torch.tensor([[[3.0, -4.0]]]))
    assert (energy.item(), crps.item()) == (5.0, 3.5)


def test_residual_noise_makes_a_forecast_of_a_point():
    point, truth = torch.zeros(1, 3000, 2, 1), 0.3 * normal(3000, 2, 1)
    fitted = scoring.fit(point, truth, copies=200)
    assert fitted.floor == pytest.approx(truth.square().mean().item(), rel=1e-5)
    scores, _ = scoring.measure(point, truth, fitted, 200, torch.Generator())
    assert scores["energy_score"].mean() == pytest.approx(0.3 * math.sqrt(2 / math.pi), rel=0.02)
    best = 0.3 / math.sqrt(math.pi)  # of the best normal
    assert scores["energy_score_noise"].mean() == pytest.approx(best, rel=0.03)


# Coverage


@pytest.mark.parametrize("level", [50, 80, 95])
def test_the_truth_lies_within_the_interval_as_often_as_stated(level, values):
    assert values[f"coverage{level}"].mean() == pytest.approx(level / 100, abs=0.02)


@pytest.mark.parametrize("count", [19, 200])
def test_few_samples_cover_as_often_as_many(count):
    pit = scoring.rank(normal(count, 4000, 1, 4), normal(4000, 1, 4, seed=1), torch.Generator())
    for level in scoring.LEVELS.tolist():
        found = scoring.coverage(pit, level).mean()
        assert found == pytest.approx(level, abs=1 / (count + 1) + 0.01)


def test_overconfidence_shows(predicted):
    samples, truth = predicted
    narrow = samples.mean(0) + 0.5 * (samples - samples.mean(0))
    inside = math.erf(0.5 * 1.2816 / math.sqrt(2))  # of the 80 % interval at half the width
    pit = scoring.rank(narrow, truth, torch.Generator())
    assert scoring.coverage(pit, 0.8).mean() == pytest.approx(inside, abs=0.02)


# The whole


@pytest.mark.parametrize("model", [Linear(), Mode()])
def test_scoring_block_by_block_is_scoring_all_samples_at_once(model, monkeypatch):
    monkeypatch.setattr(prediction, "ROWS", 160)  # 8 trajectories of 20 samples
    found, (samples, truth) = score(model, episodes(21)), draw(model, episodes(21), samples=20)
    whole, _ = scoring.measure(samples, truth, found.fitted, 20, torch.Generator())
    for metric, value in found.values.items():
        if not metric.endswith("_noise") and not metric.startswith("coverage"):  # drawn anew
            torch.testing.assert_close(value, whole[metric])
    part = score(model, episodes(21).take(slice(8)))  # blocks do not depend on each other
    assert all(torch.equal(part.values[name], found.values[name][:8]) for name in part.values)


def test_a_deterministic_model_is_scored_as_the_papers_baselines():
    found = score(Mode(), episodes())
    curves = found.against_horizon()
    torch.testing.assert_close(curves["ll_paper"], curves["ll_shared"])
    torch.testing.assert_close(curves["ll_own"], curves["ll_horizon"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(curves["nrmse"], VARIANCE.mean(1).sqrt(), rtol=0.1, atol=0)
    assert curves["energy_score_noise"].mean() < curves["energy_score"].mean()
    assert curves["coverage80"].mean() == pytest.approx(0.8, abs=0.05)


def test_the_caller_chooses_what_to_average_over():
    found, steps = score(Linear(), episodes(30)), torch.zeros(30, HORIZON, dtype=torch.bool)
    steps[3:5, 7] = True
    curve = found.against_horizon(steps)["energy_score"]
    assert curve[7] == pytest.approx(found.values["energy_score"][3:5, 7].mean().item())
    assert curve[6].isnan()


def test_a_diverged_sample_counts_as_worst_and_is_reported():
    breaking = Linear()
    breaking.breaks = 0.2
    broken, sound = score(breaking, episodes(50)), score(Linear(), episodes(50))
    assert broken.outside.mean() == pytest.approx(0.2 * 2, abs=0.1)  # of three segments two count
    assert sound.outside.max() == 0
    for metric in ("energy_score", "crps", "squared_error"):
        assert broken.values[metric].mean() - sound.values[metric].mean() > 1e3
    assert all(torch.isfinite(value).all() for value in broken.values.values())


def test_a_step_touches_if_the_arm_is_at_the_block_before_or_after_it():
    states = np.zeros((1, 5, 10))  # the arm lies along x
    states[..., 6:8] = 0.0, 0.15
    states[0, 2, 6:8] = 0.1, 0.02
    steps = contacts.contact_steps(states, "tsm/ReacherPush-v1")
    assert steps.tolist() == [[False, True, True, False]]
    assert contacts.after_first(steps).tolist() == [[False, True, True, True]]
