"""What codes do is measured against closed forms, and planted effects are found."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from untrained import in_units

from reproduction.measures import contacts, exploitation, futures, latent
from reproduction.measures.contacts import Deflections
from reproduction.measures.futures import SampledFutures
from tsmlib.collection import collect_random
from tsmlib.envs.geometry import BLOCK_RADIUS, WALL, closest_gap, fingertip
from tsmlib.evaluation import prediction
from tsmlib.models.features import Features
from tsmlib.models.layers import kl_from_standard_normal
from tsmlib.models.tsm import TSM
from tsmlib.trajectory import Segment, Trajectories, Window

PUSH = "tsm/ReacherPush-v1"


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def test_data() -> Trajectories:
    return collect_random(PUSH, 40, seed=3, rms=0.1)


@pytest.fixture(scope="module")
def model(test_data: Trajectories) -> TSM:
    return TSM.for_data(test_data, channels=8, latent_dim=3)


class Shifts:
    """A model whose future is the last state plus ``reach`` times the code, in every step."""

    segment_len, code_len, past_len, latent_dim = 10, 10, 10, 3
    reach = torch.tensor([0.5, 0.1, 0.0])

    def __init__(self) -> None:
        self.features = Features(3, ())
        self.features.step_std.fill_(1.0)

    def decode(self, past: Segment, actions: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        return (past.states[:, -1] + self.reach * z)[:, None].expand(-1, actions.shape[1], -1)


def still_window(n: int, steps: int = 10) -> Window:
    return Window(
        Segment(torch.zeros(n, 10, 3), torch.zeros(n, 10, 2)),
        Segment(torch.zeros(n, steps, 3), torch.zeros(n, steps, 2)),
    )


def moving() -> Features:
    """Statistics of ten dimensions that all move."""
    return in_units(SimpleNamespace(features=Features(10, ()))).features


def scene(n: int, steps: int = 10, block: tuple[float, float] = (0.0, 0.15)) -> SampledFutures:
    """An arm at rest along x and an object at rest, for the truth and for two samples."""
    state = torch.zeros(10)
    state[4:6], state[6:8] = torch.from_numpy(fingertip(np.zeros(2))).float(), torch.tensor(block)
    states = state.expand(n, steps, -1).clone()
    window = Window(
        Segment(state.expand(n, 10, -1).clone(), torch.zeros(n, 10, 2)),
        Segment(states, torch.zeros(n, steps, 2)),
    )
    return SampledFutures(PUSH, window, states.expand(2, -1, -1, -1).clone())


def test_the_divergence_of_a_gaussian_is_the_textbook_s_and_adds_up_over_dimensions() -> None:
    mean, log_variance = torch.randn(5, 4, generator=rng()), torch.randn(5, 4, generator=rng(1))
    found = latent.kl_by_dimension(mean, log_variance)
    torch.testing.assert_close(found, 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance))
    torch.testing.assert_close(found.sum(1), kl_from_standard_normal(mean, log_variance))


def test_units_count_as_active_from_a_variance_of_a_hundredth_on() -> None:
    mean = torch.randn(20000, 3, generator=rng()) * torch.tensor([0.09, 0.11, 1.0])
    assert latent.active_units(mean).tolist() == [False, True, True]


def test_each_dimension_of_a_linear_decoder_matters_by_its_own_weight() -> None:
    shifts: Any = Shifts()
    found = latent.total_effects(shifts, still_window(20000), rng())
    torch.testing.assert_close(
        found, shifts.reach / math.sqrt(3), rtol=0.03, atol=1e-6
    )  # one of three features moves


def test_a_code_that_knows_the_future_reconstructs_it_better_only_if_the_decoder_listens(
    model: TSM, test_data: Trajectories
) -> None:
    seen = futures.sample_futures(model, test_data, samples=2, horizon=10)
    with torch.no_grad():
        for weight in model.decoder.codes.parameters():
            kept = weight.clone()
            weight.zero_()
        errors = latent.reconstruction(model, seen.window, rng())
        weight.copy_(kept)
    assert torch.equal(errors["posterior"], errors["prior"])
    assert torch.equal(errors["posterior"], errors["zero"])


def test_windows_hold_the_states_that_scores_are_taken_from(
    model: TSM, test_data: Trajectories
) -> None:
    seen = futures.sample_futures(model, test_data, samples=2, horizon=30)
    whole = test_data.segment(0)
    assert torch.equal(seen.window.future.states, prediction.cut(whole.states, futures.STARTS, 30))
    assert torch.equal(
        seen.window.past.states[1], whole.states[0, 30:40]
    )  # the second window of the first episode
    assert seen.samples.shape == (2, 120, 30, 10)
    touched = prediction.cut(contacts.contact_steps(test_data.states, PUSH), futures.STARTS, 30)
    assert torch.equal(contacts.touched(seen), touched)
    assert touched.any()


def test_windows_of_figure_9_begin_five_steps_before_the_first_touch(
    model: TSM, test_data: Trajectories
) -> None:
    seen, episodes = contacts.windows_before_contact(model, test_data, samples=2, horizon=20)
    assert 3 <= len(episodes) < len(test_data)
    near = closest_gap(seen.window.future.states.numpy(), PUSH) < exploitation.NEAR
    assert near[:, contacts.LEAD - 1].all()
    assert not near[:, : contacts.LEAD - 1].any()
    with pytest.raises(ValueError, match="none of the 40 episodes"):
        contacts.windows_before_contact(model, test_data, samples=1, horizon=95)


def test_every_step_counts_alike_however_often_it_occurs() -> None:
    squares = torch.tensor([[1.0, 4.0], [1.0, 100.0], [1.0, 100.0]])
    where = torch.tensor([[True, True], [True, False], [True, False]])
    assert latent.root_mean(squares, where) == pytest.approx(math.sqrt(2.5))
    assert math.isnan(latent.root_mean(squares, torch.zeros(3, 2, dtype=torch.bool)))


def test_a_touch_is_an_event_once_and_a_bounce_between_two_states_is_seen() -> None:
    seen = scene(1)
    future = seen.window.future.states
    future[0, 4:7, 6:8] = torch.tensor([0.15, 0.02])  # at the arm for three steps
    limit = WALL - BLOCK_RADIUS
    future[0, 7, 6:10] = torch.tensor([limit - 0.02, 0.2, 1.5, 0.0])  # 2 cm from the wall, fast
    future[0, 8:, 6:10] = torch.tensor(
        [limit - 0.015, 0.2, -0.6, 0.0]
    )  # and already on its way back
    true, samples = contacts.contacts(seen)["object"]
    assert true[0].nonzero().flatten().tolist() == [4]
    assert not samples.any()
    assert contacts.contacts(seen)["wall"][0][0].nonzero().flatten().tolist() == [8]


def test_an_event_is_foretold_up_to_two_steps_early_or_late() -> None:
    truth = torch.zeros(2, 20, dtype=torch.bool)
    truth[0, 5] = truth[1, 15] = True
    samples = torch.zeros(4, 2, 20, dtype=torch.bool)
    samples[0, 0, 5] = samples[1, 0, 7] = samples[2, 0, 8] = samples[0, 1, 13] = True
    everything = contacts.recall(truth, samples, range(20))
    assert everything == {"n": 2, "recall": 3 / 8, "majority": 0.5, "precision": 3 / 4}
    assert contacts.recall(truth, samples, range(10))["recall"] == 0.5
    assert math.isnan(contacts.recall(truth, samples, range(16, 20))["recall"])


def test_a_planted_deflection_is_read_off_in_degrees() -> None:
    seen = scene(2, steps=30)
    step = contacts.LEAD - 1 + contacts.AHEAD
    seen.window.future.states[:, step:, 6] += 0.05  # along x
    way = 0.05 * torch.tensor([math.cos(math.radians(30)), math.sin(math.radians(30))])
    seen.samples[:, 0, step:, 6:8] += way
    seen.samples[0, 1, step:, 7] += 0.1  # one sample to the left and twice as far, the other stays
    found = contacts.deflections(seen)
    torch.testing.assert_close(torch.rad2deg(found.off[:, 0]), torch.tensor([30.0, 30.0]))
    assert torch.rad2deg(found.off[0, 1]) == pytest.approx(90)
    assert found.still == 0.25
    torch.testing.assert_close(found.error, torch.tensor([30.0, 90.0]))
    torch.testing.assert_close(found.travels[:, 1], torch.tensor([0.1, 0.0]))
    assert not found.inside().any()


def test_intervals_of_honest_directions_hold_the_truth_as_often_as_they_should() -> None:
    drawn = 0.4 * torch.randn(201, 400, generator=rng())
    found = Deflections(
        drawn[1:] - drawn[0],  # truth and samples alike
        torch.ones(400),
        torch.ones(200, 400),
    )
    assert found.inside(0.8).float().mean() == pytest.approx(0.8, abs=0.05)
    assert found.spread.median() == pytest.approx(math.degrees(0.4), rel=0.05)


def test_the_directions_that_move_an_outcome_are_found() -> None:
    codes = torch.randn(500, 6, generator=rng())
    outcome = torch.stack([3 * codes[:, 2], codes[:, 4]], 1) + 0.01 * torch.randn(
        500, 2, generator=rng(1)
    )
    found, explained = latent.directions(codes, outcome)
    torch.testing.assert_close(found.abs(), torch.eye(6)[[2, 4]], atol=0.01, rtol=0)
    assert explained > 0.99
    assert latent.directions(codes, torch.randn(500, 2, generator=rng(2)))[1] < 0.1


def test_a_past_longer_than_what_was_observed_begins_with_the_first_state(
    test_data: Trajectories,
) -> None:
    model = in_units(
        TSM(test_data.states.shape[2], 2, segment_len=20, dilations=(1, 2, 4, 8), channels=8)
    )
    past = futures.sample_futures(
        model, test_data.take(slice(1)), samples=1, horizon=10
    ).window.past
    assert model.past_len > 10
    early = past.states[0, : model.past_len - 10].numpy()
    np.testing.assert_array_equal(early, np.broadcast_to(test_data.states[0, 0], early.shape))
