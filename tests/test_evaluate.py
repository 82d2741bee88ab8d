"""Scores against closed forms, on a linear system with Gaussian noise whose predictive distribution is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tsmlib.evaluation import contacts, prediction, scoring
from tsmlib.evaluation.scoring import Fitted
from tsmlib.models.base import Adapted, Step
from tsmlib.models.features import Features
from tsmlib.models.tsm import TSM
from tsmlib.sampling import Noise, standard_normal
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

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
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


class Mode(Linear):
    """The system without its noise, as a deterministic model."""

    stochastic = False

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        assert generator is None
        return super().predict_segment(past, actions)


def episodes(n: int = N, seed: int = 0) -> Trajectories:
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=(n, T + 1, 2)), rng.uniform(-1, 1, (n, T, 2))
    for t in range(T):
        states[:, t + 1] = (
            KEEP.numpy() * states[:, t] + actions[:, t] + NOISE * rng.normal(size=(n, 2))
        )
    return Trajectories(
        states.astype(np.float32),
        actions.astype(np.float32),
        "tsm/Linear-v0",
        0.02,
        ("a", "b"),
        ("m", "m"),
        (),
    )


def predictive_variance() -> Tensor:
    """(HORIZON, 2): the variance of x that the noise of k steps has built up."""
    k = torch.arange(1, HORIZON + 1)[:, None]
    return NOISE**2 * (1 - KEEP ** (2 * k)) / (1 - KEEP**2)


OPEN = dict(horizon=HORIZON, starts=(PAST,))
FEATURES = Features(2, ())
FEATURES.step_std.fill_(1.0)


def draw(model: Linear, data: Trajectories, samples: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    return predicted_and_true(model, data, samples=samples, seed=seed, **OPEN)


def predicted_and_true(model: Linear, data: Trajectories, **options: Any) -> tuple[Tensor, Tensor]:
    states = prediction.sample_states(model, data, **options)
    truth = prediction.cut(data.padded(0).states, options["starts"], options["horizon"])
    return prediction.scored(FEATURES, states), prediction.scored(FEATURES, truth)


def measured(samples: Tensor, truth: Tensor, fitted: Fitted, copies: int = 1) -> dict[str, Tensor]:
    return scoring.measure(samples, truth, fitted, copies, torch.Generator().manual_seed(0))[0]


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def crps_of(error: Tensor, deviation: float) -> Tensor:
    """The CRPS of a normal distribution, Gneiting and Raftery (2007)."""
    z, unit = error / deviation, torch.distributions.Normal(0.0, 1.0)
    return deviation * (z * (2 * unit.cdf(z) - 1) + 2 * unit.log_prob(z).exp() - math.pi**-0.5)


@pytest.fixture(scope="module")
def predicted() -> tuple[Tensor, Tensor]:
    return draw(Linear(), episodes(), samples=400)


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return scoring.fit(*draw(Linear(), episodes(seed=1), samples=400, seed=1), copies=400)


@pytest.fixture(scope="module")
def values(predicted: tuple[Tensor, Tensor], fitted: Fitted) -> dict[str, Tensor]:
    return measured(*predicted, fitted)


@pytest.fixture(scope="module")
def mean() -> Tensor:
    return draw(Mode(), episodes(), samples=1)[0][0]


def gaussian(error: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum(-1)


# What is drawn -------------------------------------------------------------------------------------------------------


class Strays(Mode):
    """A model that goes astray by 0.1 where it is asked step by step."""

    def begin(self, past: Segment, *, generator: Noise | None = None) -> Step:
        step = Adapted(self).begin(past)
        return lambda u: step(u) + 0.1


def test_two_ways_of_running_a_model_that_disagree_are_told() -> None:
    past = Segment(torch.zeros(4, PAST, 2), torch.zeros(4, PAST, 2))
    window = Window(
        past, Segment(torch.zeros(4, 8, 2), torch.zeros(4, 8, 2))
    )  # at rest, and no torque
    assert prediction.ways_apart(Strays(), window)["steps"] == pytest.approx(0.1)
    apart = prediction.ways_apart(TSM(2, 2, angles=(), channels=8, segment_len=8), window)
    assert list(apart) == ["steps", "teacher forcing"]
    assert max(apart.values()) < 1e-5


def test_without_noise_the_prediction_is_the_truth() -> None:
    data = episodes(20)
    for t in range(PAST, T):
        data.states[:, t + 1] = KEEP.numpy() * data.states[:, t] + data.actions[:, t]
    samples, truth = draw(Linear(noise=0.0), data, samples=2)
    assert samples.shape == (2, 20, HORIZON, 2)
    torch.testing.assert_close(samples, truth.expand_as(samples), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(truth, data.states[:, PAST + 1 :])


def test_every_model_starts_from_the_same_step_however_little_past_it_needs() -> None:
    class Short(Mode):
        past_len = 1

    for model in (Mode(), Short(past_len=1)):
        samples, truth = predicted_and_true(model, episodes(5), samples=1, horizon=4, starts=(10,))
        np.testing.assert_array_equal(truth, episodes(5).states[:, 11:15])
        expected = KEEP.numpy() * episodes(5).states[:, 10] + episodes(5).actions[:, 10]
        np.testing.assert_allclose(samples[0, :, 0], expected, rtol=1e-5, atol=1e-6)


def test_segments_start_from_the_true_past() -> None:
    samples, truth = predicted_and_true(
        Mode(), episodes(6), samples=1, horizon=5, starts=(5, 10, 20)
    )
    assert truth.shape == (18, 5, 2)
    for row, start in ((0, 5), (1, 10), (2, 20), (17, 20)):
        states, actions = episodes(6).states[row // 3], episodes(6).actions[row // 3]
        np.testing.assert_array_equal(truth[row], states[start + 1 : start + 6])
        expected = KEEP.numpy() * states[start] + actions[start]
        np.testing.assert_allclose(samples[0, row, 0], expected, rtol=1e-5, atol=1e-6)


def test_the_same_seed_draws_the_same_samples() -> None:
    first, second, other = (
        draw(Linear(), episodes(5), samples=3, seed=seed)[0] for seed in (0, 0, 1)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])


@pytest.mark.parametrize(
    "options", [dict(horizon=HORIZON + 1, starts=(PAST,)), dict(horizon=5, starts=(0,))]
)
def test_a_horizon_that_does_not_fit_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(
        ValueError, match=f"at least one step is observed first, and episodes have {T}"
    ):
        predicted_and_true(Linear(), episodes(3), samples=1, **options)


def test_a_model_that_looks_further_back_than_is_observed_sees_the_first_state_repeated() -> None:
    class Recorder(Linear):
        def predict_segment(
            self, past: Segment, actions: Tensor, *, generator: Any = None
        ) -> Tensor:
            seen.append(past)
            return super().predict_segment(past, actions, generator=generator)

    seen: list[Segment] = []
    data = episodes(3)
    predicted_and_true(Recorder(), data, samples=1, horizon=5, starts=(2,))
    states, actions = seen[0]
    assert torch.equal(
        states[:3, : PAST - 2], torch.from_numpy(data.states[:, :1]).expand(-1, PAST - 2, -1)
    )
    assert torch.equal(states[:3, PAST - 2 :], torch.from_numpy(data.states[:, 1:3]))
    assert not actions[:3, : PAST - 2].any()
    assert torch.equal(actions[:3, PAST - 2 :], torch.from_numpy(data.actions[:, :2]))


@pytest.mark.parametrize(
    ("features", "validation", "samples", "message"),
    [
        (FEATURES, {}, 0, "samples is 0, expected at least 1"),
        (
            FEATURES,
            dict(env="tsm/Other-v0"),
            2,
            "test data have env 'tsm/Linear-v0', validation data 'tsm/Other-v0'",
        ),
        (FEATURES, dict(dt=0.01), 2, "test data have dt 0.02, validation data 0.01"),
        (
            Features(3, ()),
            {},
            2,
            "the model's states have 3 dimensions with angles \\[\\], those of tsm/Linear-v0 2",
        ),
        (
            Features(2, (0,)),
            {},
            2,
            "with angles \\[0\\], those of tsm/Linear-v0 2 with angles \\[\\]",
        ),
    ],
)
def test_what_does_not_belong_together_is_not_scored(
    features: Features, validation: dict[str, Any], samples: int, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        prediction.score(
            Linear(),
            features,
            episodes(3),
            replace(episodes(3, seed=1), **validation),
            samples=samples,
            **OPEN,
        )


def test_scores_are_in_units_of_the_training_data_without_what_never_moves() -> None:
    data = episodes(50)
    still = np.full_like(data.states[..., :1], 3.0)
    names = ("a", "b", "still")
    data = Trajectories(
        np.concatenate([100 * data.states, still], -1),
        data.actions,
        data.env,
        data.dt,
        names,
        ("cm", "cm", "m"),
        (),
    )
    features = Features(3, ()).fit(torch.from_numpy(data.states))

    class Copy(Linear):
        """Predicts that nothing changes."""

        def predict_segment(
            self, past: Segment, actions: Tensor, *, generator: Noise | None = None
        ) -> Tensor:
            return past.states[:, -1:].expand(-1, actions.shape[1], -1)

    scores = prediction.score(Copy(), features, data, data, samples=2, **OPEN)
    assert scores.pit.shape == (50, HORIZON, 2)
    in_cm = (data.states[:, PAST + 1 :, :2] - data.states[:, PAST : PAST + 1, :2]) / data.states[
        ..., :2
    ].std((0, 1))
    np.testing.assert_allclose(
        scores.against_horizon()["nrmse"], np.sqrt((in_cm**2).mean((0, 2))), rtol=0.01
    )


# Likelihoods ---------------------------------------------------------------------------------------------------------


def test_the_papers_likelihood_is_the_analytic_one(
    predicted: tuple[Tensor, Tensor], values: dict[str, Tensor], mean: Tensor
) -> None:
    assert values["ll_paper"].shape == (N, HORIZON)
    exact = gaussian(predicted[1] - mean, predictive_variance())
    assert abs(values["ll_paper"].mean(0) - exact.mean(0)).max() < 0.03  # nats, at every step


def test_the_shared_likelihood_is_the_analytic_one(
    predicted: tuple[Tensor, Tensor], values: dict[str, Tensor], fitted: Fitted, mean: Tensor
) -> None:
    assert fitted.shared == pytest.approx(float(predictive_variance().mean()), rel=0.1)
    exact = gaussian(predicted[1] - mean, torch.tensor(fitted.shared))
    assert abs(values["ll_shared"].mean(0) - exact.mean(0)).max() < 0.02
    samples, truth = draw(Linear(), episodes(seed=1), samples=400, seed=1)
    best = measured(samples, truth, fitted)["ll_shared"].mean()
    for share in (0.8, 1.2):
        other = replace(fitted, shared=share * fitted.shared)
        assert measured(samples, truth, other)["ll_shared"].mean() < best


def test_the_likelihood_with_a_variance_per_step_and_dimension_is_the_analytic_one(
    predicted: tuple[Tensor, Tensor], values: dict[str, Tensor], fitted: Fitted, mean: Tensor
) -> None:
    torch.testing.assert_close(
        fitted.horizon, predictive_variance(), rtol=0.35, atol=0
    )  # 300 trajectories: sd 8 %
    assert (fitted.horizon / predictive_variance()).mean() == pytest.approx(1.0, abs=0.1)
    exact = gaussian(predicted[1] - mean, predictive_variance())
    assert values["ll_horizon"].mean() == pytest.approx(exact.mean().item(), abs=0.03)


def test_the_floor_of_a_model_without_noise_is_its_error() -> None:
    error = 0.05 * normal(4000, 3, 2)
    floor = scoring.fit_floor(torch.zeros(5, 4000, 3, 2), error)
    assert floor == pytest.approx(error.square().mean().item(), rel=1e-5)
    assert floor == pytest.approx(0.05**2, rel=0.05)


def test_residual_noise_is_told_apart_from_the_spread_of_the_samples() -> None:
    samples, truth = (
        0.8 * normal(200, 4000, 1, 2),
        math.hypot(0.8, 0.6) * normal(4000, 1, 2, seed=1),
    )
    own = scoring.fit_own(samples, truth)
    torch.testing.assert_close(own, torch.full((1, 2), 0.36), rtol=0.3, atol=0)
    exact = gaussian(truth, torch.ones(2)).mean()
    assert scoring.ll_own(samples, truth, own).mean() == pytest.approx(exact.item(), abs=0.02)
    for share in (0.7, 1.4):
        assert (
            scoring.ll_own(samples, truth, share * own).mean()
            < scoring.ll_own(samples, truth, own).mean()
        )


def test_the_own_density_of_the_system_is_the_analytic_one(
    predicted: tuple[Tensor, Tensor], values: dict[str, Tensor], mean: Tensor
) -> None:
    exact = gaussian(predicted[1] - mean, predictive_variance())
    assert values["ll_own"].mean() == pytest.approx(
        exact.mean().item(), abs=0.05
    )  # a mixture of 400 loses 0.03


def test_thirty_iterations_are_enough() -> None:
    samples, truth = normal(100, 200, 1, 4), 1.1 * normal(200, 1, 4, seed=1)
    short, long = (scoring.fit_own(samples, truth, iterations=n) for n in (30, 200))
    assert (
        scoring.ll_own(samples, truth, long).mean() - scoring.ll_own(samples, truth, short).mean()
        < 0.01
    )


def test_two_modes_are_told_from_one_in_between() -> None:
    side = torch.where(normal(600, 1, 1) > 0, 1.0, -1.0)
    samples = torch.where(normal(100, 600, 1, 1, seed=1) > 0, 1.0, -1.0)
    truth = side + 0.1 * normal(600, 1, 1, seed=2)
    scores = measured(samples, truth, scoring.fit(samples, truth, copies=1))
    exact = math.log(0.5) - 0.5 * (
        1 + math.log(2 * math.pi * 0.1**2)
    )  # half a nat of Gaussian, and which side
    assert scores["ll_own"].mean() == pytest.approx(exact, abs=0.05)
    assert scores["ll_own"].mean() > scores["ll_paper"].mean() + 1


@pytest.mark.parametrize("count", [10, 50, 500])
def test_what_few_samples_cost_in_the_papers_likelihood_is_known(count: int) -> None:
    dims, trials = 10, 200_000 // count
    samples, truth = normal(count, trials, 1, dims), normal(trials, 1, dims, seed=1)
    exact = gaussian(truth, torch.ones(dims))
    loss = (exact - gaussian(truth - samples.mean(0), samples.var(0)))[:, 0]
    error = loss.std().item() / math.sqrt(trials)
    assert loss.mean() == pytest.approx(scoring.fit_loss(count, dims), abs=4 * error)
    assert scoring.fit_loss(1000, dims) == pytest.approx(dims / 1000, rel=0.02)
    assert scoring.fit_loss(3, dims) == math.inf


# Proper scores -------------------------------------------------------------------------------------------------------


def slow_distances(samples: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    n = len(samples)
    energy, crps = torch.zeros(truth.shape[:2]), torch.zeros(truth.shape[:2])
    for a in samples:
        energy += (a - truth).norm(dim=-1) / n
        crps += (a - truth).abs().mean(-1) / n
        for b in samples:  # a pair with itself adds nothing
            energy -= (a - b).norm(dim=-1) / (n * (n - 1)) / 2
            crps -= (a - b).abs().mean(-1) / (n * (n - 1)) / 2
    return energy, crps


def test_energy_score_and_crps_are_those_of_a_double_loop() -> None:
    samples, truth = normal(7, 4, 3, 2), normal(4, 3, 2, seed=1)
    slow = slow_distances(samples, truth)
    for fast, exact in zip(scoring.distances(samples, truth, shifts=6), slow, strict=True):
        torch.testing.assert_close(fast, exact)


def test_a_few_shifts_of_many_samples_are_unbiased() -> None:
    samples, truth = normal(8, 20_000, 1, 3), normal(20_000, 1, 3, seed=1)
    for fast, slow in zip(
        scoring.distances(samples, truth, shifts=2), slow_distances(samples, truth), strict=True
    ):
        difference = (fast - slow)[:, 0]
        assert difference.std() > 0.01
        assert difference.mean() == pytest.approx(
            0, abs=4 * difference.std().item() / math.sqrt(20_000)
        )


def test_the_scores_of_a_normal_are_its_crps() -> None:
    samples, truth = 0.7 * normal(4000, 1, 5, 1), torch.linspace(-1, 1, 5)[None, :, None]
    for score in scoring.distances(samples, truth):
        torch.testing.assert_close(score, crps_of(truth[..., 0], 0.7), rtol=0, atol=0.03)


def test_a_single_sample_is_scored_by_its_distance() -> None:
    energy, crps = scoring.distances(torch.zeros(1, 1, 1, 2), torch.tensor([[[3.0, -4.0]]]))
    assert energy.item() == 5.0
    assert crps.item() == 3.5


def test_the_true_distribution_scores_best(predicted: tuple[Tensor, Tensor]) -> None:
    samples, truth = (part[..., ::5, :] for part in predicted)
    centre = samples.mean(0)
    best = scoring.distances(samples, truth)
    for width in (0.5, 2.0):
        for score, other in zip(
            best, scoring.distances(centre + width * (samples - centre), truth), strict=True
        ):
            assert other.mean() > score.mean()


def test_residual_noise_makes_a_forecast_of_a_point() -> None:
    truth = 0.3 * normal(3000, 2, 1)
    point = torch.zeros(1, 3000, 2, 1)
    fitted = scoring.fit(point, truth, copies=200)
    assert fitted.noise.sqrt().median() == pytest.approx(0.3, rel=0.25)  # the next one of the grid
    scores = measured(point, truth, fitted, copies=200)
    assert scores["energy_score"].mean() == pytest.approx(
        0.3 * math.sqrt(2 / math.pi), rel=0.02
    )  # E|x|
    for metric in ("energy_score_noise", "crps_noise"):
        assert scores[metric].mean() == pytest.approx(
            0.3 / math.sqrt(math.pi), rel=0.03
        )  # of the best normal


def test_samples_that_are_right_get_no_noise_and_narrow_ones_get_what_they_lack(
    fitted: Fitted,
) -> None:
    assert fitted.noise.sqrt().median() < 0.15  # the system's own noise builds up to 0.3 .. 0.7
    samples, truth = 0.8 * normal(60, 3000, 1, 2), normal(3000, 1, 2, seed=1)
    assert scoring.fit_noise(samples, truth, copies=60).sqrt().median() == pytest.approx(
        0.6, rel=0.25
    )


# Coverage ------------------------------------------------------------------------------------------------------------


def test_the_truth_lies_within_the_interval_as_often_as_stated(values: dict[str, Tensor]) -> None:
    for level in (50, 80, 95):
        assert values[f"coverage{level}"].mean() == pytest.approx(level / 100, abs=0.02)


@pytest.mark.parametrize("count", [19, 200])
def test_few_samples_cover_as_often_as_many(count: int) -> None:
    pit = scoring.rank(normal(count, 4000, 1, 4), normal(4000, 1, 4, seed=1), torch.Generator())
    for level in scoring.LEVELS:
        assert scoring.coverage(pit, float(level)).mean() == pytest.approx(
            float(level), abs=1 / (count + 1) + 0.01
        )


def test_overconfidence_shows(predicted: tuple[Tensor, Tensor]) -> None:
    samples, truth = predicted
    centre = samples.mean(0)
    pit = scoring.rank(centre + 0.5 * (samples - centre), truth, torch.Generator())
    inside = math.erf(0.5 * 1.2816 / math.sqrt(2))  # of the 80 % interval at half the width
    assert scoring.coverage(pit, 0.8).mean() == pytest.approx(inside, abs=0.02)


# The whole -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prediction, "ROWS", 160)  # 8 trajectories of 20 samples


def run(model: Linear, data: Trajectories, samples: int = 20, **options: Any) -> prediction.Scores:
    return prediction.score(
        model, FEATURES, data, episodes(40, seed=1), samples=samples, **{**OPEN, **options}
    )


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("model", [Linear(), Mode()])
def test_scoring_block_by_block_is_scoring_all_samples_at_once(model: Linear) -> None:
    scores = run(model, episodes(21))
    samples, truth = draw(model, episodes(21), samples=20)
    whole, pit = scoring.measure(
        samples, truth, scores.fitted, 20, torch.Generator().manual_seed(0)
    )
    torch.testing.assert_close(
        scores.pit, pit, rtol=0, atol=1 / 21
    )  # ranks are drawn between two samples
    assert set(scores.values) == set(whole)
    for metric, value in scores.values.items():
        assert value.shape == (21, HORIZON)
        if metric.endswith("_noise") or metric.startswith("coverage"):  # drawn anew in each block
            assert value.mean() == pytest.approx(whole[metric].mean().item(), rel=0.1)
        else:
            torch.testing.assert_close(value, whole[metric])


@pytest.mark.usefixtures("small_blocks")
def test_a_block_does_not_depend_on_the_others() -> None:
    part, whole = run(Linear(), episodes(21).take(slice(8))), run(Linear(), episodes(21))
    for metric, value in part.values.items():
        assert torch.equal(value, whole.values[metric][:8]), metric


@pytest.mark.parametrize("model", [Linear(), Mode()])
def test_the_same_seed_gives_the_same_bits(model: Linear) -> None:
    first, second = run(model, episodes(10)), run(model, episodes(10))
    for metric, value in first.values.items():
        assert torch.equal(value, second.values[metric])
    assert torch.equal(first.pit, second.pit)


def test_a_deterministic_model_is_scored_as_the_papers_baselines() -> None:
    scores = run(Mode(), episodes())
    curves = scores.against_horizon()
    assert scores.fitted.floor == pytest.approx(scores.fitted.shared)
    torch.testing.assert_close(curves["ll_paper"], curves["ll_shared"])
    torch.testing.assert_close(curves["ll_own"], curves["ll_horizon"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scores.fitted.own, scores.fitted.horizon)
    expected = predictive_variance().mean(1).sqrt()
    torch.testing.assert_close(curves["nrmse"], expected, rtol=0.1, atol=0)
    assert curves["energy_score_noise"].mean() < curves["energy_score"].mean()
    assert curves["coverage80"].mean() == pytest.approx(0.8, abs=0.05)
    assert scores.outside.max() == 0


def test_one_gaussian_for_all_is_worth_less_than_its_own_to_the_system_itself() -> None:
    linear, mode = (
        run(model, episodes(), samples=100).against_horizon() for model in (Linear(), Mode())
    )
    assert linear["ll_paper"].mean() > mode["ll_paper"].mean() + 0.05  # the unequal protocol
    assert linear["ll_shared"].mean() == pytest.approx(mode["ll_shared"].mean().item(), abs=0.02)
    assert linear["energy_score_noise"].mean() < mode["energy_score_noise"].mean()


def test_the_caller_chooses_what_to_average_over() -> None:
    scores = run(Linear(), episodes(30))
    energy = scores.values["energy_score"]
    half = torch.arange(30) < 15
    torch.testing.assert_close(scores.against_horizon(half)["energy_score"], energy[:15].mean(0))
    steps = torch.zeros(30, HORIZON, dtype=torch.bool)
    steps[3:5, 7] = True
    curve = scores.against_horizon(steps)["energy_score"]
    assert curve[7] == pytest.approx(energy[3:5, 7].mean().item())
    assert curve[6].isnan()
    expected = [
        scoring.coverage(scores.pit[3:5, 7:8], float(level)).mean() for level in scoring.LEVELS
    ]
    torch.testing.assert_close(scores.calibration(steps), torch.stack(expected))
    torch.testing.assert_close(
        scores.calibration(half)[9], scoring.coverage(scores.pit[:15], 0.5).mean()
    )


def test_segments_are_scored_as_the_horizon_is() -> None:
    scores = run(Linear(), episodes(), starts=(3, 13), horizon=10)
    assert scores.values["ll_paper"].shape == (2 * N, 10)
    expected = predictive_variance()[:10].mean(1).sqrt()
    torch.testing.assert_close(scores.against_horizon()["nrmse"], expected, rtol=0.1, atol=0)


def test_a_diverged_sample_counts_as_worst_and_is_reported() -> None:
    broken, sound = run(Linear(breaks=0.2), episodes(50)), run(Linear(), episodes(50))
    assert broken.outside.mean() == pytest.approx(
        0.2 * 2, abs=0.1
    )  # three segments, the last of two steps
    assert sound.outside.max() == 0
    for metric, value in broken.values.items():
        assert torch.isfinite(value).all(), metric
        worse = value.mean() - sound.values[metric].mean()
        if metric == "ll_own":
            assert worse < math.log(0.8)  # in a mixture, what a sample can lose is its share
        elif metric.startswith("ll_"):
            assert worse < -1, metric
        elif not metric.startswith("coverage"):
            assert worse > 1e3, metric


def test_a_rollout_that_leaves_the_physical_range_is_reported() -> None:
    class Off(Mode):
        def predict_segment(
            self, past: Segment, actions: Tensor, *, generator: Noise | None = None
        ) -> Tensor:
            states = super().predict_segment(past, actions)
            states[0, 0, 1] = 30.0
            return states

    outside = run(Off(), episodes(5)).outside
    assert outside.tolist() == [1, 0, 0, 0, 0]
    low, high = prediction.physical_range(episodes(5), episodes(40, seed=1))
    states = np.concatenate([episodes(5).states, episodes(40, seed=1).states]).reshape(-1, 2)
    np.testing.assert_allclose(low, 1.5 * states.min(0) - 0.5 * states.max(0), rtol=1e-4)
    turned = replace(episodes(5), angles=(0,))
    low, high = prediction.physical_range(turned)
    assert high[0] > 1e30
    assert high[1] < 30


# Contact -------------------------------------------------------------------------------------------------------------


def test_a_step_touches_if_the_arm_is_at_the_block_before_or_after_it() -> None:
    states = np.zeros((1, 5, 10))  # the arm lies along x
    states[..., 6:8] = 0.0, 0.15
    states[0, 2, 6:8] = 0.1, 0.02
    steps = contacts.contact_steps(states, "tsm/ReacherPush-v1")
    assert steps.tolist() == [[False, True, True, False]]
    assert contacts.after_first(steps).tolist() == [[False, True, True, True]]
    assert prediction.cut(steps, (0, 2), 2).tolist() == [[False, True], [True, False]]
