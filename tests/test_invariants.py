"""The true world never violates physics; a careless model's rollout does, and is found."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from reproduction.measures.actions import novelty, roughness, within
from reproduction.measures.exploitation import shares, violations, worst
from tsmlib.collection import smooth_torques
from tsmlib.envs.geometry import BLOCK_DECAY, closest_gap, fingertip

PUSH, PYMUNK = "tsm/ReacherPush-v1", "tsm/PymunkPush-v1"


def world(env_id: str, n: int = 200, rms: float = 0.1, steps: int = 50) -> np.ndarray:
    """True trajectories (n, T + 1, 10) under torques like the training data's."""
    env = gymnasium.make_vec(env_id, num_envs=n)
    start, _ = env.reset(seed=5)
    torques = smooth_torques(n, steps, generator=torch.Generator().manual_seed(1), rms=rms)
    return np.concatenate([start[:, None], env.unwrapped.rollout(torques.numpy())], axis=1)  # type: ignore[attr-defined]


def still(n: int = 1, steps: int = 50, *, block: tuple[float, float] = (0.0, 0.15)) -> np.ndarray:
    """An arm at rest along x, and an object at rest out of its way: (n, T + 1, 10)."""
    state = np.zeros(10)
    state[4:6], state[6:8] = fingertip(np.zeros(2)), block
    return np.tile(state, (n, steps + 1, 1))


@pytest.mark.parametrize(
    ("env_id", "rms"), [(PUSH, 0.1), (PUSH, 0.3), (PYMUNK, 0.1), (PYMUNK, 0.3)]
)
def test_the_true_world_breaks_nearly_none(env_id: str, rms: float) -> None:
    states = world(env_id, rms=rms)
    found = violations(states, env_id)
    assert (closest_gap(states, env_id) < 1e-3).any(1).mean() > 0.2  # objects are met
    assert found["violations"].shape == (200, 50)
    assert found["violations"].mean() < 1e-3
    step = np.linalg.norm(np.diff(states[..., 6:8], axis=1), axis=-1)
    sliding = (step > 0.005) & (closest_gap(states, env_id)[:, 1:] > 0.005)
    assert sliding.mean() > 5e-4  # the paper's wording alone would blame the world


def test_an_object_that_moves_on_its_own_is_found_from_5_mm_on() -> None:
    states = still(3)
    states[1, 20:, 6] += 0.0049
    states[2, 20:, 6] += 0.0051
    found = violations(states, PUSH)["moves_untouched"]
    assert not found[:2].any()
    assert found[2, 19:].all()  # step k leads to state k + 1
    assert not found[2, :19].any()


def test_a_pushed_object_may_slide_as_far_as_its_speed_carries_it() -> None:
    speed, decay = 1.0, BLOCK_DECAY
    seconds = 0.02 * np.arange(51)
    sliding = still(2, block=(0.0, 0.1))
    sliding[:, :, 7] += speed * decay * (1 - np.exp(-seconds / decay)) * 0.6
    sliding[:, :, 9] = 0.6 * speed * np.exp(-seconds / decay)
    assert not violations(sliding, PUSH)["violations"].any()
    sliding[1, 30:, 7] += 0.02  # and then a little more
    assert violations(sliding, PUSH)["moves_untouched"].sum(1).tolist() == [0, 21]


def test_an_object_that_moves_after_its_contact_has_ended_is_found() -> None:
    touched = still(2, block=(0.15, 0.041))  # 1 mm from the arm
    swing = np.radians(-2.0) * np.arange(51)
    touched[:, :, 0] = swing  # the arm leaves
    touched[1, 40:, 7] += 0.05
    found = violations(touched, PUSH)["moves_untouched"]
    assert not found[0].any()
    assert found[1, 39:].all()


def test_an_arm_that_passes_through_is_found() -> None:
    through = still(2, block=(0.15, 0.1))
    through[1, :, 0] = np.linspace(0, 2, 51)
    through[1, :, 2] = 2.0
    found = violations(through, PUSH)
    inside = closest_gap(through[1, 1:], PUSH) < -0.005
    assert inside.sum() > 5
    np.testing.assert_array_equal(found["penetrates"][1], inside)
    assert not found["moves_untouched"].any()
    assert not found["violations"][0].any()


def test_a_fast_arm_may_hit_the_object_between_two_states() -> None:
    hit = still(block=(0.15, 0.1))
    hit[0, 10:, 0] = 1.2  # far beyond where the object was, in one step
    hit[0, 10:, 6:8] = (-0.05, 0.2)
    hit[0, 10:, 8:10] = 0.0
    assert closest_gap(hit, PUSH).min() > 0.005
    assert not violations(hit, PUSH)["moves_untouched"].any()


def test_every_made_up_violation_is_found() -> None:
    """An object displaced by a centimetre wherever nothing had touched it."""
    states = world(PUSH)
    alone = np.flatnonzero((closest_gap(states, PUSH) > 0.03).all(1))
    states[alone, 25:, 6:8] += 0.01 / np.sqrt(2)
    found = violations(states, PUSH)["moves_untouched"]
    assert len(alone) > 40
    assert found[alone][:, 24:].mean() > 0.999


def test_states_without_an_object_or_a_number_are_refused() -> None:
    with pytest.raises(ValueError, match="no object moves in tsm/ReacherObstacle-v0"):
        violations(still(), "tsm/ReacherObstacle-v0")
    for wrong in (still()[:, :1], still() * np.nan):
        with pytest.raises(ValueError, match="at least 1, all finite"):
            violations(wrong, PUSH)


# Actions ------------------------------------------------------------------------------------------


def test_the_roughness_of_waves_is_known() -> None:
    time = 0.02 * torch.arange(100)
    slow, fast = (torch.sin(2 * torch.pi * hertz * time) for hertz in (2.0, 10.0))
    found = roughness(torch.stack([slow, fast, slow + fast], 0)[..., None].expand(-1, -1, 2))
    torch.testing.assert_close(
        found["centroid"], torch.tensor([2.0, 10.0, 6.0]), rtol=1e-4, atol=1e-4
    )
    torch.testing.assert_close(found["fast"], torch.tensor([0.0, 1.0, 0.5]), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found["change"][0], slow.diff().abs().mean())
    assert found["autocorrelation"][0] > 0.95
    assert found["autocorrelation"][1] < 0.4
    for value in roughness(torch.zeros(2, 50, 2)).values():
        assert (value == 0).all()


def test_torques_of_the_data_are_near_and_others_far() -> None:
    draw = torch.Generator().manual_seed(0)
    data = smooth_torques(300, 60, generator=draw)
    rough = 0.1 * torch.randn(20, 50, 2, generator=draw)
    seen, unseen = (
        novelty(data[:20, 7:57], data),
        novelty(smooth_torques(20, 50, generator=draw), data),
    )
    torch.testing.assert_close(seen, torch.zeros(20), rtol=0, atol=2e-3)
    assert (seen < unseen).all()
    assert unseen.max() < novelty(rough, data).min()
    assert novelty(3 * data[:20], 3 * data).max() < 2e-3  # in units of the data


def test_the_range_of_the_data_holds_95_of_100_of_their_steps_and_none_of_what_is_larger() -> None:
    data = smooth_torques(300, 60, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1.0, 0.2]
    )
    assert within(data, data).mean() == pytest.approx(0.95, abs=1e-4)
    assert within(torch.zeros(2, 50, 2), data).tolist() == [1, 1]
    plan = torch.zeros(1, 4, 2)
    plan[0, 1, 0], plan[0, 3, 1] = 0.5, -0.15  # both far above a tenth, and a tenth of a fifth
    assert within(plan, data).tolist() == [0.5]


def test_an_object_that_drifts_slowly_is_found() -> None:
    states = still(block=(0.0, 0.12))
    states[0, :, 7] += 0.0012 * np.arange(51)
    found = violations(states, PUSH)["moves_untouched"][0]
    np.testing.assert_array_equal(found, 0.0012 * np.arange(1, 51) > 0.005)


def test_shares_are_of_the_steps_of_each_plan_and_the_worst_is_a_tenth() -> None:
    predicted = still(20)
    predicted[3, 26:, 6] += 0.1  # 25 of its 50 steps
    found = shares(predicted[:, 0], np.stack([predicted[:, 1:], still(20)[:, 1:]]), PUSH)
    assert found["moves_untouched"][3] == 0.25  # every other rollout is sound
    assert found["moves_untouched"].sum() == 0.25
    error = np.zeros(20)
    error[[3, 5, 9]] = 2.0, 1.0, -7.0  # predicted less than executed: no exploitation
    assert sorted(worst(error)) == [3, 5]
