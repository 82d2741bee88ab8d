"""Errors are to the true state, filters do what textbooks say, and tables say what the rows say."""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from untrained import in_units

from tsmlib import plots as figures, study
from tsmlib.envs import imperfect
from tsmlib.envs.geometry import HALF_RANGE, fingertip
from tsmlib.envs.spec import DELAY, NOISE
from tsmlib.evaluation import filtering
from tsmlib.evaluation.filtering import KalmanFilter, errors, rmse
from tsmlib.plots.method import Method
from tsmlib.models.base import rollout
from tsmlib.models.baselines import OneStep
from tsmlib.models.tsm import TSM
from tsmlib.sampling import Noise
from tsmlib.storage import tables
from tsmlib import zoo
from reproduction.predictions import WithoutPastActions
from reproduction.results import robustness as robustness_results
from reproduction.results import table
from tsmlib.trajectory import Segment, Trajectories

REACHER = "tsm/Reacher-v0"
NOISY, LATE = imperfect(REACHER, noise=NOISE), imperfect(REACHER, delay=5)
UNIT = np.array(HALF_RANGE[:6])
Pair = tuple[Trajectories, Trajectories]


def episodes(states: np.ndarray, actions: np.ndarray, env: str = REACHER) -> Trajectories:
    dims = states.shape[-1]
    return Trajectories(
        states.astype(np.float32),
        actions.astype(np.float32),
        env,
        0.02,
        ("x",) * dims,
        ("m",) * dims,
    )


def drawn(n: int, seed: int) -> Pair:
    """The same episodes with and without noise."""
    return study.random_data(NOISY, n, seed=seed), study.random_data(REACHER, n, seed=seed)


@pytest.fixture(scope="module")
def held_out() -> Pair:
    return drawn(20, seed=1)


@pytest.fixture(scope="module")
def test_data() -> Pair:
    return drawn(40, seed=2)


@pytest.fixture(scope="module")
def kalman() -> KalmanFilter:
    return KalmanFilter.fitted(study.random_data(REACHER, 60, seed=0), NOISE)


# Errors --------------------------------------------------------------------------------------------------------------


def test_angles_are_compared_on_the_circle_and_nothing_else_is() -> None:
    clean = np.array([math.pi - 0.1, -3.0, 1.0, 2.0, 0.1, 0.2])
    found = errors(clean + np.array([0.3, 0.0, 2 * math.pi, 0.0, 0.0, 0.0]), clean)
    np.testing.assert_allclose(found * UNIT, [0.3, 0, 2 * math.pi, 0, 0, 0], atol=1e-12)
    turned = errors(
        np.array([-math.pi + 0.1, 3.1, 0, 0, 0, 0]),
        np.array([math.pi - 0.1, 3.1 - 6 * math.pi] + [0] * 4),
    )
    np.testing.assert_allclose(turned, [0.2, 0, 0, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("dims", [6, 10])
def test_errors_count_in_half_ranges(dims: int) -> None:
    clean = np.random.default_rng(0).normal(size=(2, 3, dims))
    off = 0.25 * np.array(HALF_RANGE[:dims])
    before = clean.copy()
    np.testing.assert_allclose(errors(clean + off, clean), 0.25)
    assert rmse(errors(clean - off, clean)) == pytest.approx(0.25)
    np.testing.assert_array_equal(clean, before)


def test_the_raw_observation_is_off_by_the_noise(test_data: Pair) -> None:
    noisy, clean = test_data
    assert rmse(errors(noisy.states, clean.states)) == pytest.approx(NOISE, rel=0.02)


# Words ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "delay", "word"),
    [
        (0.0, 0, "clean"),
        (0.25, 0, "noise"),
        (0.0, 5, "delay"),
        (0.25, 5, "noise, delay"),
        (0.1, 0, "noise 0.1"),
        (0.0, 3, "delay 3"),
        (0.1, 5, "noise 0.1, delay"),
        (0.25, 12, "noise, delay 12"),
    ],
)
def test_a_world_is_named_by_what_is_imperfect(noise: float, delay: int, word: str) -> None:
    assert robustness_results.world(noise, delay) == word


def test_rows_of_an_imperfect_arm_name_the_plain_one_and_what_is_imperfect() -> None:
    obstacle = imperfect("tsm/ReacherObstacle-v0", noise=0.1, delay=5)
    assert table.place(obstacle) == dict(
        env="tsm/ReacherObstacle-v0", sim="mujoco", noise=0.1, delay=5
    )
    assert table.place(REACHER) == dict(env=REACHER, sim="mujoco", noise=None, delay=None)


# Past actions --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Remembering:
    """A model whose next states are the last one and the sum of all past torques, and of those it is told."""

    segment_len: int = 5
    past_len: int = 4
    features: str = "of its own"
    stochastic: bool = False
    weight: float = 1.0  # of past torques

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        remembered = self.weight * past.actions.sum((1, 2))[:, None, None]
        return past.states[:, -1:] + actions.cumsum(1).sum(-1, keepdim=True) + remembered


def some_past(dims: int = 6) -> tuple[Segment, Tensor]:
    draw = torch.Generator().manual_seed(0)
    past = Segment(torch.randn(3, 10, dims, generator=draw), torch.randn(3, 10, 2, generator=draw))
    return past, torch.randn(3, 15, 2, generator=draw)


def test_without_past_actions_a_model_that_relies_on_them_is_blind() -> None:
    past, actions = some_past()
    model, before = Remembering(), past.actions.clone()
    blind: Any = WithoutPastActions(model)
    assert (blind.segment_len, blind.past_len, blind.features, blind.stochastic) == (
        5,
        4,
        "of its own",
        False,
    )
    assert not torch.allclose(
        model.predict_segment(past, actions[:, :5]), blind.predict_segment(past, actions[:, :5])
    )
    expected = past.states[:, -1:] + actions.cumsum(1).sum(
        -1, keepdim=True
    )  # also past torques of its own are hidden
    torch.testing.assert_close(rollout(blind, past, actions), expected)
    assert torch.equal(past.actions, before)


def test_a_model_that_looks_at_past_actions_says_otherwise_without_them() -> None:
    torch.manual_seed(0)
    past, actions = some_past()
    model = in_units(TSM(6, 2, channels=8))
    assert not torch.allclose(
        rollout(model, past, actions), rollout(WithoutPastActions(model), past, actions)
    )  # type: ignore[arg-type]


def test_a_model_that_ignores_past_actions_says_the_same_without_them() -> None:
    torch.manual_seed(0)
    past, actions = some_past()
    for model in (Remembering(weight=0.0), in_units(OneStep(6, 2, hidden=16))):
        blind: Any = WithoutPastActions(model)
        whole, seen = (
            rollout(m, past, actions, generator=torch.Generator().manual_seed(1))
            for m in (model, blind)
        )
        assert torch.equal(whole, seen)


# Kalman filter -------------------------------------------------------------------------------------------------------


def linear_arm(
    n: int = 4, steps: int = 30, noise: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, Trajectories]:
    """Episodes of s' = A [s, u, 1] + N(0, noise^2), without the kinematics of any arm, and that A (7, 4)."""
    draw = np.random.default_rng(seed)
    transition = np.concatenate(
        [0.9 * np.linalg.qr(draw.normal(size=(4, 4)))[0], draw.normal(size=(3, 4))]
    )
    states, actions = np.zeros((n, steps + 1, 6)), draw.uniform(-1, 1, (n, steps, 2))
    states[:, 0, :4] = draw.normal(size=(n, 4))
    for t in range(steps):
        told = np.concatenate([states[:, t, :4], actions[:, t], np.ones((n, 1))], 1)
        states[:, t + 1, :4] = told @ transition + noise * draw.normal(size=(n, 4))
    return transition, episodes(states, actions)


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_without_a_fingertip_the_filter_is_the_textbooks(
    monkeypatch: pytest.MonkeyPatch, weight: float
) -> None:
    scale = np.array([1.0, 2.0, 3.0, 4.0])
    monkeypatch.setattr(
        filtering, "HALF_RANGE", (*scale, 1e5, 1e5)
    )  # of the fingertip nothing is learned
    transition, clean = linear_arm()
    spread = np.random.default_rng(1).normal(size=(4, 4))
    process, sigma = 0.1 * spread @ spread.T, 0.3
    noise = (
        sigma
        * np.array([*scale, 0.0, 0.0])
        * np.random.default_rng(2).normal(size=clean.states.shape)
    )
    noisy = episodes(clean.states + noise, clean.actions)
    found = KalmanFilter(transition, process, sigma, weight).means(noisy)

    a, b, c = transition[:4].T, transition[4:6].T, transition[6]
    seen = np.linalg.inv(np.diag((sigma * scale) ** 2))  # information of one observation
    for observed, actions, means in zip(
        noisy.states[..., :4].astype(float), noisy.actions, found, strict=True
    ):
        x, covariance = observed[0], np.linalg.inv(seen)
        for t, u in enumerate(actions):
            np.testing.assert_allclose(means[t], x, rtol=1e-5, atol=1e-5)
            x, covariance = a @ x + b @ u + c, a @ covariance @ a.T + weight * process
            prior = np.linalg.inv(covariance)
            covariance = np.linalg.inv(prior + seen)
            x = covariance @ (prior @ x + seen @ observed[t + 1])
        np.testing.assert_allclose(means[-1], x, rtol=1e-5, atol=1e-5)


def test_with_a_fingertip_the_filter_is_the_extended_one(
    kalman: KalmanFilter, test_data: Pair
) -> None:
    noisy = test_data[0].take(slice(2))
    kalman = dataclasses.replace(kalman, weight=3.0)
    found = kalman.means(noisy)

    def told(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, fingertip(x[:2])])

    noise = np.diag((NOISE * UNIT) ** 2)
    for observed, actions, means in zip(
        noisy.states.astype(float), noisy.actions, found, strict=True
    ):
        x, covariance = observed[0, :4], noise[:4, :4]
        for t, u in enumerate(actions):
            x = np.array([*x, *u, 1.0]) @ kalman.transition
            a = kalman.transition[:4].T
            covariance = a @ covariance @ a.T + 3.0 * kalman.process
            h = np.stack(
                [(told(x + 1e-6 * e) - told(x - 1e-6 * e)) / 2e-6 for e in np.eye(4)], 1
            )  # (6, 4)
            gain = np.linalg.solve(h @ covariance @ h.T + noise, h @ covariance).T
            x = x + gain @ (observed[t + 1] - told(x))
            kept = np.eye(4) - gain @ h
            covariance = kept @ covariance @ kept.T + gain @ noise @ gain.T  # Joseph's form
            np.testing.assert_allclose(means[t + 1], x, rtol=1e-6, atol=1e-6)


def test_dynamics_are_those_of_the_clean_episodes() -> None:
    transition, clean = linear_arm()
    found = KalmanFilter.fitted(clean, 0.3)
    np.testing.assert_allclose(found.transition, transition, atol=1e-5)
    assert np.abs(found.process).max() < 1e-10
    transition, clean = linear_arm(n=400, noise=0.2)
    found = KalmanFilter.fitted(clean, 0.3)
    np.testing.assert_allclose(found.transition, transition, atol=0.02)
    np.testing.assert_allclose(found.process, 0.04 * np.eye(4), atol=0.002)
    assert (found.sigma, found.weight) == (0.3, 1.0)


def test_a_filter_that_knows_everything_is_never_wrong_now_or_ahead() -> None:
    draw, dt = np.random.default_rng(0), 0.02
    actions, x = draw.uniform(-1, 1, (5, 100, 2)), draw.normal(size=(5, 4))
    a = np.array(
        [
            [1, 0, 0, 0],
            [0, 1, 0, 0],
            [dt, 0, 1, 0],
            [0, dt, 0, 1],
            [0, 0, 2, 0],
            [0, 0, 0, 2],
            [0, 0, 0, 0.0],
        ]
    )
    states = [x]
    for u in actions.swapaxes(0, 1):
        states.append(np.concatenate([states[-1], u, np.ones((5, 1))], 1) @ a)
    known = np.stack(states, 1)
    data = episodes(np.concatenate([known, fingertip(known[..., :2])], -1), actions)
    now, ahead = filtering.filter_errors(KalmanFilter(a, 1e-9 * np.eye(4), 0.01), data, data)
    assert (now.shape, ahead.shape) == ((45, 6), (45, 10, 6))
    np.testing.assert_allclose(now, 0, atol=1e-5)
    np.testing.assert_allclose(ahead, 0, atol=1e-5)


def test_on_an_arm_the_filter_beats_averages_and_averages_beat_the_raw_observation(
    kalman: KalmanFilter, held_out: Pair, test_data: Pair
) -> None:
    now, ahead = filtering.filter_errors(kalman.tuned(*held_out), *test_data)
    average = filtering.exponential_errors(filtering.tuned_exponential(*held_out), *test_data)
    raw = filtering.exponential_errors(0.0, *test_data)
    assert rmse(now) < 0.8 * rmse(average) < 0.8 * rmse(raw)
    assert rmse(ahead[:, 0]) < rmse(average)
    assert rmse(now) < rmse(ahead[:, 0]) < rmse(ahead[:, 9])


def test_the_weight_is_the_best_of_five_on_validation(kalman: KalmanFilter, held_out: Pair) -> None:
    tried = {
        w: rmse(filtering.filter_errors(dataclasses.replace(kalman, weight=w), *held_out)[0])
        for w in (0.1, 0.3, 1.0, 3.0, 10.0)
    }
    assert kalman.tuned(*held_out).weight == min(tried, key=lambda w: tried[w])
    assert len({round(value, 6) for value in tried.values()}) == 5


# Exponential filter --------------------------------------------------------------------------------------------------


def test_an_exponential_filter_that_keeps_nothing_is_the_raw_observation(test_data: Pair) -> None:
    noisy, clean = test_data
    found = filtering.exponential_errors(0.0, noisy, clean)
    raw = np.concatenate([errors(noisy.states[:, t], clean.states[:, t]) for t in filtering.STARTS])
    np.testing.assert_array_equal(found, raw)


def test_an_exponential_filter_is_its_sum(test_data: Pair) -> None:
    noisy, clean = (data.take(slice(3)) for data in test_data)
    x, keep = noisy.states.astype(float), 0.7
    for row, t in enumerate(filtering.STARTS):
        mean = keep**t * x[:, 0] + sum(
            (1 - keep) * keep ** (t - s) * x[:, s] for s in range(1, t + 1)
        )
        found = filtering.exponential_errors(keep, noisy, clean)[3 * row : 3 * row + 3]
        np.testing.assert_allclose(found, errors(mean, clean.states[:, t]), atol=1e-6)


def test_what_is_kept_is_the_best_of_eleven_on_validation(held_out: Pair) -> None:
    tried = {
        keep: rmse(filtering.exponential_errors(keep, *held_out))
        for keep in np.linspace(0, 0.9, 11)
    }
    best = filtering.tuned_exponential(*held_out)
    assert best == min(tried, key=lambda keep: tried[keep])
    assert 0 < best < 0.9
    clean = held_out[1]
    assert filtering.tuned_exponential(clean, clean) == 0  # nothing to filter


# Models --------------------------------------------------------------------------------------------------------------


class Knows:
    """A model that knows the true episodes by their torques, and adds ``off`` (dx,) and noise to them."""

    segment_len, past_len = 10, 10

    def __init__(self, clean: Trajectories, off: float = 0.0, noise: float = 0.0) -> None:
        self.truth = {
            clean.actions[i, t : t + 10].tobytes(): clean.states[i, t + 1 : t + 11]
            for i in range(len(clean))
            for t in filtering.STARTS
        }
        self.off, self.noise, self.stochastic = torch.from_numpy(off * UNIT), noise, noise > 0

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        states = (
            torch.from_numpy(np.stack([self.truth[u.numpy().tobytes()] for u in actions]))
            + self.off
        )
        if self.noise:
            states = states + self.noise * torch.from_numpy(UNIT) * torch.randn(
                states.shape, generator=generator
            )  # type: ignore[arg-type]
        return states.float()


def test_a_model_that_knows_the_truth_makes_no_errors(test_data: Pair) -> None:
    noisy, clean = test_data
    found = filtering.model_errors(Knows(clean), noisy, clean)  # type: ignore[arg-type]
    assert found.shape == (9 * 40, 10, 6)
    np.testing.assert_allclose(found, 0, atol=1e-6)
    off = filtering.model_errors(Knows(clean, off=0.1), noisy, clean)  # type: ignore[arg-type]
    np.testing.assert_allclose(off, 0.1, atol=1e-5)


def test_errors_are_those_of_the_samples_mean(test_data: Pair) -> None:
    noisy, clean = test_data
    found = filtering.model_errors(Knows(clean, noise=0.3), noisy, clean, samples=16)  # type: ignore[arg-type]
    assert rmse(found) == pytest.approx(0.3 / 4, rel=0.03)


def test_other_episodes_are_refused(kalman: KalmanFilter, held_out: Pair, test_data: Pair) -> None:
    noisy, (_, clean) = test_data[0].take(slice(20)), held_out
    for call in (
        lambda: filtering.model_errors(Knows(clean), noisy, clean),  # type: ignore[arg-type]
        lambda: filtering.filter_errors(kalman, noisy, clean),
        lambda: filtering.exponential_errors(0.5, noisy, clean),
        lambda: kalman.tuned(noisy, clean),
        lambda: filtering.tuned_exponential(noisy, clean.take(slice(5))),
    ):
        with pytest.raises(
            ValueError, match=f"episodes of {NOISY} and of {REACHER} hold other torques"
        ):
            call()


# Rows ----------------------------------------------------------------------------------------------------------------


def by(rows: list[dict[str, Any]]) -> dict[tuple[str, Any], float]:
    return {(row["metric"], row.get("steps_ahead", "")): row["value"] for row in rows}


def test_rows_of_errors_tell_steps_and_parts_apart() -> None:
    ahead = np.zeros((2, 3, 6))
    ahead[:, 1, 2:4] = [[0.3, 0.4], [0.0, 0.5]]  # the velocities, two steps ahead
    now = np.full((2, 6), 0.2)
    rows = robustness_results.error_rows(NOISY, "lstm", ahead, now, seed=3, scale="smoke")
    found = by(rows)
    assert len(rows) == len(found) == 4 * (1 + 1 + 3)
    whole = math.sqrt(0.5 / 12)  # 0.09 + 0.16 + 0.25 over two episodes of six dimensions
    assert found["rmse_clean", 2] == pytest.approx(whole)
    assert found["rmse_clean", ""] == pytest.approx(math.sqrt(0.5 / 36))
    assert found["rmse_clean_velocities", 2] == pytest.approx(math.sqrt(0.5 / 4))
    assert found["rmse_clean_velocities", ""] == pytest.approx(math.sqrt(0.5 / 12))
    for part in ("", "_angles", "_velocities", "_fingertip"):
        assert found[f"rmse_clean{part}", 0] == pytest.approx(0.2)
        assert found[f"rmse_clean{part}", 1] == found[f"rmse_clean{part}", 3] == 0
    assert found["rmse_clean_angles", 2] == found["rmse_clean_fingertip", 2] == 0
    about = dict(
        env=REACHER, sim="mujoco", model="lstm", planner="none", noise=NOISE, unit="half range", n=2
    )
    assert all(row.items() >= {**about, "seed": 3, "scale": "smoke"}.items() for row in rows)


def test_what_was_not_measured_has_no_rows() -> None:
    now = np.full((2, 6), 0.2)
    assert {
        row["steps_ahead"] for row in robustness_results.error_rows(LATE, "exponential", None, now)
    } == {0}
    assert 0 not in {
        row.get("steps_ahead") for row in robustness_results.error_rows(LATE, "tsm", now[:, None])
    }


def policy_header(env: str = NOISY, last: int = 880) -> dict[str, Any]:
    return {
        "fingerprint": {"env": env},
        "made_from": {"task": "reach"},
        "model": "tsm",
        "search_space": "latent",
        "seed": 4,
        "scale": "smoke",
        "curve": {"iteration": [0, last]},
    }


def test_a_target_is_reached_within_five_centimetres() -> None:
    distances = torch.tensor([[0.01, 0.06, 0.049, 0.3], [0.0, 0.01, 0.02, 0.03]])
    rows = robustness_results.policy_rows(policy_header(), distances)
    assert [(row["copy"], row["value"]) for row in rows] == [(0, 0.5), (1, 1.0)]
    (row, _) = rows
    assert (
        row.items()
        >= dict(
            env=REACHER,
            sim="mujoco",
            task="reach",
            model="tsm",
            planner="policy",
            search_space="latent",
            noise=NOISE,
            delay=None,
            iteration=880,
            n=4,
            seed=4,
            scale="smoke",
            metric="success50",
            unit="share",
        ).items()
    )
    strict = robustness_results.policy_rows(policy_header(REACHER), distances, level=0.02)
    assert [(row["metric"], row["noise"], row["value"]) for row in strict] == [
        ("success20", None, 0.25),
        ("success20", None, 0.5),
    ]


OURS, THEIRS = zoo.method("tsm", "latent"), zoo.method("lstm", "direct")
WORLDS: dict[str, dict[str, Any]] = {
    "clean": {},
    "noise": {"noise": NOISE},
    "delay": {"delay": DELAY},
}


def learned(
    values: dict[str, list[list[float]]],
    method: Method = OURS,
    metric: str = "return_true",
    first: int = 0,
) -> list[dict[str, Any]]:
    """World -> copies -> records, one every 220 iterations."""
    return [
        dict(
            env=REACHER,
            task="reach",
            scale="paper",
            model=method.model,
            search_space=method.search_space,
            planner="policy",
            execution="policy",
            metric=metric,
            seed=0,
            copy=copy,
            iteration=first + 220 * record,
            value=value,
            **WORLDS[world],
        )
        for world, copies in values.items()
        for copy, records in enumerate(copies)
        for record, value in enumerate(records)
    ]


ROWS = [
    *learned(
        {
            "clean": [[-12, -5, -3, -1], [-12, -5, -5, -1]],
            "noise": [[-12, -6, -5], [-12, -6, -5]],
            "delay": [[-12, -6, -8], [-12, -6, -7]],
        }
    ),
    *learned({"noise": [[-12, -9, -8], [-12, -9, -6]]}, THEIRS),
    *learned({"noise": [[0.6], [0.7]], "delay": [[0.5], [0.6]]}, metric="success50", first=440),
    dict(env=REACHER, model="tsm", planner="none", noise=NOISE, metric="nrmse", value=0.1, seed=0),
]
LEARNED = tables.frame(ROWS)


def test_the_table_shows_the_last_record_that_counts() -> None:
    head, _, *lines = robustness_results.policies_table(LEARNED, last=500).splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in (head, *lines)]
    titles = [
        f"{world}: {what}" for world in WORLDS for what in ("executed return", "within 0.05 m")
    ]
    assert cells[0] == ["method", *(title for title in titles if title != "clean: within 0.05 m")]
    half = 12.706 * 1 / 1  # t interval of two copies at -3 and -5: their mean is off by 1
    assert cells[1] == [
        "TSM, latent",
        f"-4 ± {half:.2g}",
        "-5",
        "0.65 ± 0.64",
        "-7.5 ± 6.4",
        "0.55 ± 0.64",
    ]
    assert cells[2] == ["LSTM, direct", "", f"-7 ± {half:.2g}", "", "", ""]
    later = robustness_results.policies_table(LEARNED, last=660).splitlines()[2]
    assert [cell.strip() for cell in later.split("|")[1:3]] == ["TSM, latent", "-1"]


def test_what_is_lost_is_a_share_of_the_gain_over_random_torques() -> None:
    lost = partial(robustness_results.lost, LEARNED, OURS)
    assert lost("noise", 500, random=-14.0) == pytest.approx((-4 + 5) / (-4 + 14))
    assert lost("delay", 500, random=-14.0) == pytest.approx((-4 + 7.5) / (-4 + 14))
    assert lost("noise", 300, random=-15.0) == pytest.approx(0.1)  # -5 against -6


def test_learning_curves_are_a_line_for_each_copy() -> None:
    curves = robustness_results.learning_curves(LEARNED, last=500)
    drawn = {"clean": [OURS], "noise": [OURS, THEIRS], "delay": [OURS]}
    assert {world: list(own) for world, own in curves.items()} == drawn
    assert curves["clean"][OURS]["steps"].tolist() == [
        0,
        220_000,
        440_000,
    ]  # 20 episodes of 50 steps each
    assert curves["clean"][OURS]["return_true"].tolist() == [[-12, -5, -3], [-12, -5, -5]]
    assert curves["noise"][THEIRS]["return_true"].tolist() == [[-12, -9, -8], [-12, -9, -6]]
    figures.figure8(curves, {zoo.method("random"): -14.0})


def test_copies_that_learned_in_one_model_are_one_line_beside_those_of_another_seed() -> None:
    more = tables.frame(
        [*ROWS, *({**row, "seed": 1} for row in learned({"delay": [[-12, -7, -6], [-12, -7, -9]]}))]
    )
    curves = robustness_results.learning_curves(more, last=500)
    assert curves["delay"][OURS]["return_true"].tolist() == [[-12, -6, -7.5], [-12, -7, -7.5]]
    assert curves["noise"][OURS]["return_true"].tolist() == [
        [-12, -6, -5],
        [-12, -6, -5],
    ]  # of seed 0 alone
    head, _, ours, _ = (
        line.split("|")[1:-1]
        for line in robustness_results.policies_table(more, last=500).splitlines()
    )
    assert (
        ours[[cell.strip() for cell in head].index("delay: executed return")].strip() == "-7.5"
    )  # both seeds alike


def scored(
    model: str, seeds: list[float], env: str = REACHER, subset: str = ""
) -> list[dict[str, Any]]:
    common = table.place(env) | dict(
        model=model, execution="open loop", subset=subset, metric="ll_horizon"
    )
    return [dict(common, value=value, seed=seed) for seed, value in enumerate(seeds)]


def test_an_advantage_is_a_difference_per_pair_of_seeds_and_a_place_where_nothing_was_scored_is_left_out() -> (
    None
):
    obstacle, both = "tsm/ReacherObstacle-v0", imperfect(REACHER, noise=NOISE, delay=DELAY)
    noisy = imperfect(obstacle, noise=NOISE)
    rows = [
        *scored("tsm", [1.0, 2.0]),
        *scored("onestep", [0.0, 3.0]),
        *scored("tsm", [5.0, 6.0], both),
        *scored("onestep", [2.0], both),
        *scored("lstm", [2.0], LATE),
        *scored("tsm", [4.0], obstacle, "contact"),
        *scored("lstm", [1.5], obstacle, "contact"),
        *scored("tsm", [4.0], noisy, "contact"),
        *scored("lstm", [5.0], noisy, "contact"),
        *scored("tsm", [9.0], obstacle),
        *scored("lstm", [0.0], obstacle),
    ]
    found = robustness_results.advantage(
        tables.frame(rows), "tsm", ["onestep", "lstm"], [0.0, 0.25], [0, 5]
    )
    one_step, lstm = zoo.method("onestep"), zoo.method("lstm")
    assert {
        place: {rival: seeds.tolist() for rival, seeds in row.items()}
        for place, row in found.items()
    } == {
        "noise 0, delay 0": {one_step: [1.0, -1.0]},
        "noise 0.25, delay 5": {one_step: [3.0]},  # the only pair
        "obstacle, after contact": {lstm: [2.5]},  # steps after a touch on the arm without noise
    }


def test_the_map_has_the_seeds_of_each_place_and_of_the_clean_arms_those_of_the_predictions() -> (
    None
):
    noisy, elsewhere = imperfect(REACHER, noise=NOISE), "tsm/ReacherPush-v1"
    here, clean = list[dict[str, Any]](), list[dict[str, Any]]()
    for word in ("tsm", "onestep"):
        here += [*scored(word, [1.0]), *scored(word, [1.0], LATE), *scored(word, [7.0, 8.0], noisy)]
        clean += [*scored(word, [1.0, 2.0, 3.0]), *scored(word, [4.0], elsewhere)]
    given = [
        tables.frame([{**row, "scale": "paper", "n": 9} for row in rows]).assign(source=table.YOURS)
        for rows in (here, clean)
    ]
    (drawing,) = drawings.advantage_map(*given, "tsm", ["onestep"], [0.0], [0, 5])
    assert [text.get_text() for text in drawing.figure.axes[0].get_yticklabels()] == [
        "noise 0, delay 0 (3 seeds)",
        "noise 0, delay 5 (1 seed)",
    ]
    assert len(drawing.rows) == 2 * (3 + 1)  # each measurement once, and nothing that is not drawn
    stamp = table.stamp(drawing.rows, figure=True)
    assert stamp.startswith("scale paper, seeds 0, 1, 2 (Reacher with delay 5: 0), n = 9")


def test_a_threshold_is_reached_or_it_is_not() -> None:
    found = robustness_results.thresholds(LEARNED, OURS, random=-14.0, last=500)
    assert found[["threshold", "measured", "reached"]].to_numpy().tolist() == [
        ["at most 20.0%", "10.0%", True],
        ["at least 60.0%", "65.0%", True],
        ["at most 20.0%", "35.0%", False],
        ["at least 60.0%", "55.0%", False],
    ]
    assert [what.split(":")[0] for what in found["what"]] == ["noise", "noise", "delay", "delay"]
