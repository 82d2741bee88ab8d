"""The time convention, segments and windows, on a linear system whose future is known exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tsmlib.models.base import as_dynamics, rollout, stepper
from tsmlib.planning.predictors import model_predictor
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Trajectories, TrajectoryError, Window, batches, initial_past, windows

A = torch.tensor([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.0, 0.3, 0.7]])
C = torch.tensor([[0.5, 0.0], [0.1, -0.4], [0.0, 0.6]])
N, T, L, H = 4, 20, 3, 5


@dataclass
class Linear:
    """x_{t+1} = A x_t + C u_t, in segments of any length."""

    segment_len: int
    past_len: int = 1

    def loss(self, window: Window, generator: Noise) -> Tensor:
        return (self.predict_segment(window.past, window.future.actions) - window.future.states).square().mean()

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        assert actions.shape[1] <= self.segment_len
        x, states = past.states[:, -1], []
        for u in actions.unbind(1):
            x = x @ A.T + u @ C.T
            states.append(x)
        return torch.stack(states, 1)


class Own:
    """All that the README asks of a model: no past length, no generator."""

    segment_len = H

    def predict_segment(self, past: Segment, actions: Tensor) -> Tensor:
        assert past.states.shape[1] == H
        return Linear(H).predict_segment(past, actions)


@pytest.fixture
def data() -> Trajectories:
    """Episodes of the linear system, from a loop that knows nothing of segments."""
    rng = np.random.default_rng(0)
    states, actions = np.zeros((N, T + 1, 3), np.float32), rng.uniform(-1, 1, (N, T, 2)).astype(np.float32)
    states[:, 0] = rng.normal(size=(N, 3))
    for t in range(T):
        states[:, t + 1] = states[:, t] @ A.numpy().T + actions[:, t] @ C.numpy().T
    return Trajectories(states, actions, "tsm/Linear-v0", 0.02, ("a", "b", "c"), ("m", "m", "m/s"), ())


# The time convention -------------------------------------------------------------------------------------------------


def test_a_model_of_ones_own_needs_a_segment_length_and_its_predictions_alone(data: Trajectories) -> None:
    past, actions = initial_past(torch.from_numpy(data.states[:, 0]), H, 2), torch.from_numpy(data.actions[:, :13])
    truth, draw = torch.from_numpy(data.states[:, 1:14]), torch.Generator().manual_seed(0)
    step = stepper(Own(), past, generator=draw)
    for states in (rollout(Own(), past, actions, generator=draw), torch.stack([step(u) for u in actions.unbind(1)], 1)):
        torch.testing.assert_close(states, truth, rtol=1e-5, atol=1e-6)
    assert not as_dynamics(Own()).stochastic
    predicted = model_predictor(Own(), past)(actions[None])
    torch.testing.assert_close(predicted, truth.expand(1, 1, -1, -1, -1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("horizon", [1, 5, 13])
def test_one_step_and_five_step_models_agree_with_the_system(data: Trajectories, horizon: int) -> None:
    past = initial_past(torch.from_numpy(data.states[:, 0]), 1, 2)
    actions = torch.from_numpy(data.actions[:, :horizon])
    truth = torch.from_numpy(data.states[:, 1 : horizon + 1])
    for segment_len in (1, 5):
        torch.testing.assert_close(rollout(Linear(segment_len), past, actions), truth, rtol=1e-5, atol=1e-6)


def test_every_window_pairs_a_state_with_the_action_that_led_to_it(data: Trajectories) -> None:
    whole = data.padded(L)
    for start in range(T - H + 1):
        cut = windows(whole, torch.arange(N), torch.full((N,), start), L, H)
        predicted = rollout(Linear(H), cut.past, cut.future.actions)
        torch.testing.assert_close(predicted, cut.future.states, rtol=1e-5, atol=1e-6)
        late = cut.future.actions.roll(1, dims=1)  # paired with another action, the system is another one
        assert (rollout(Linear(H), cut.past, late) - cut.future.states).abs().max() > 0.05


def test_a_predicted_future_is_the_next_past(data: Trajectories) -> None:
    whole = data.padded(L)
    first = windows(whole, torch.arange(N), torch.zeros(N, dtype=torch.long), L, H)
    second = windows(whole, torch.arange(N), torch.full((N,), H), L, H)
    joined = first.past.then(first.future).last(L)
    assert all(torch.equal(a, b) for a, b in zip(joined, second.past, strict=True))


# Segments and windows ------------------------------------------------------------------------------------------------


def test_before_the_first_step_the_arm_waits_without_torque(data: Trajectories) -> None:
    whole = data.padded(L)
    assert whole.states.shape == (N, L + T, 3)
    before = initial_past(torch.from_numpy(data.states[:, 0]), L, 2)
    assert torch.equal(whole.states[:, :L], before.states)
    assert torch.equal(whole.actions[:, :L], before.actions)
    assert not before.actions.any()
    assert (before.states == before.states[:, :1]).all()
    assert torch.equal(whole.states[:, L:], torch.from_numpy(data.states[:, 1:]))
    assert torch.equal(whole.actions[:, L:], torch.from_numpy(data.actions))


def test_windows_are_those_of_a_double_loop(data: Trajectories) -> None:
    index = torch.cartesian_prod(torch.arange(N), torch.arange(T - H + 1))
    cut = windows(data.padded(L), index[:, 0], index[:, 1], L, H)
    row = 0
    for episode in range(N):
        for start in range(T - H + 1):
            for k in range(L + H):
                t = start - L + k  # the step that this column holds
                state = data.states[episode, max(t + 1, 0)]
                action = data.actions[episode, t] if t >= 0 else np.zeros(2)
                part, column = (cut.past, k) if k < L else (cut.future, k - L)
                np.testing.assert_array_equal(part.states[row, column], state)
                np.testing.assert_array_equal(part.actions[row, column], action)
            row += 1
    assert len(cut.past.states) == row


def test_batches_are_windows_of_the_data_and_miss_none(data: Trajectories) -> None:
    draw = batches(data.padded(L), past_len=L, future_len=H, batch_size=500, generator=torch.Generator().manual_seed(0))
    batch = next(draw)
    assert batch.past.states.shape == (500, L, 3)
    assert batch.future.actions.shape == (500, H, 2)
    every = {
        row.tobytes() for episode in data.actions for row in np.lib.stride_tricks.sliding_window_view(episode, H, 0)
    }
    seen = {np.ascontiguousarray(row.T).tobytes() for row in batch.future.actions.numpy()}
    assert seen == every


def test_batches_are_a_function_of_the_generator(data: Trajectories) -> None:
    def first(seed: int) -> Window:
        generator = torch.Generator().manual_seed(seed)
        return next(batches(data.padded(L), past_len=L, future_len=H, batch_size=8, generator=generator))

    assert torch.equal(first(0).future.states, first(0).future.states)
    assert not torch.equal(first(0).future.states, first(1).future.states)


def test_episodes_of_exactly_one_window_are_enough_and_shorter_ones_are_refused(data: Trajectories) -> None:
    def batch(future_len: int) -> Window:
        generator = torch.Generator()
        return next(batches(data.padded(L), past_len=L, future_len=future_len, batch_size=3, generator=generator))

    assert batch(T).future.states.shape == (3, T, 3)
    with pytest.raises(TrajectoryError, match=f"episodes of {T} steps are too short for windows of {T + 1}.*collect"):
        batch(T + 1)


def test_a_choice_of_episodes_keeps_what_they_are(data: Trajectories) -> None:
    chosen = data.take(np.array([2, 0]))
    assert (len(chosen), chosen.horizon, chosen.env, chosen.names) == (2, T, data.env, data.names)
    np.testing.assert_array_equal(chosen.states, data.states[[2, 0]])
    np.testing.assert_array_equal(chosen.actions, data.actions[[2, 0]])


# What is no trajectory -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_named_by_episode_step_and_field(data: Trajectories, value: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        episode, step, column = (int(rng.integers(n)) for n in (N, T + 1, 3))
        states = data.states.copy()
        states[episode, step, column] = value
        with pytest.raises(TrajectoryError) as caught:
            replace(data, states=states)
        assert f"episode {episode}, step {step}, field '{'abc'[column]}': {value}" in str(caught.value)
    actions = data.actions.copy()
    actions[2, 7, 1] = value
    with pytest.raises(TrajectoryError, match="in actions of tsm/Linear-v0 .* episode 2, step 7, field 'action 1'"):
        replace(data, actions=actions)


def test_arrays_that_do_not_fit_each_other_are_refused(data: Trajectories) -> None:
    for states in (data.states[:, 1:], data.states[1:], data.states[0]):
        with pytest.raises(TrajectoryError, match=r"of tsm/Linear-v0 do not fit: expected \(N, T \+ 1, dx\)"):
            replace(data, states=states)
    with pytest.raises(TrajectoryError, match="3 state dimensions, 2 names, 3 units"):
        replace(data, names=("a", "b"))
