"""The time convention, segments and windows, on a linear system whose future is known exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

import tsmlib as tsm
from tsmlib.evaluation.prediction import sample_states
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import as_dynamics, rollout, stepper
from tsmlib.models.features import Features
from tsmlib.models.tsm import TSM
from tsmlib.planning.predictors import model_predictor
from tsmlib.sampling import Noise
from tsmlib.training.fit import fixed_windows
from tsmlib.trajectory import (
    Segment,
    Trajectories,
    TrajectoryError,
    Window,
    batches,
    initial_past,
    windows,
)

A = torch.tensor([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.0, 0.3, 0.7]])
C = torch.tensor([[0.5, 0.0], [0.1, -0.4], [0.0, 0.6]])
N, T, L, H = 4, 20, 3, 5


@dataclass
class Linear:
    """x_{t+1} = A x_t + C u_t, in segments of any length."""

    segment_len: int
    past_len: int = 1

    def loss(self, window: Window, generator: Noise) -> Tensor:
        return (
            (self.predict_segment(window.past, window.future.actions) - window.future.states)
            .square()
            .mean()
        )

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
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
    states, actions = (
        np.zeros((N, T + 1, 3), np.float32),
        rng.uniform(-1, 1, (N, T, 2)).astype(np.float32),
    )
    states[:, 0] = rng.normal(size=(N, 3))
    for t in range(T):
        states[:, t + 1] = states[:, t] @ A.numpy().T + actions[:, t] @ C.numpy().T
    return Trajectories(
        states, actions, "tsm/Linear-v0", 0.02, ("a", "b", "c"), ("m", "m", "m/s"), ()
    )


# The time convention -------------------------------------------------------------------------------------------------


def test_a_model_of_ones_own_needs_a_segment_length_and_its_predictions_alone(
    data: Trajectories,
) -> None:
    past, actions = (
        initial_past(torch.from_numpy(data.states[:, 0]), H, 2),
        torch.from_numpy(data.actions[:, :13]),
    )
    truth, draw = torch.from_numpy(data.states[:, 1:14]), torch.Generator().manual_seed(0)
    step = stepper(Own(), past, generator=draw)
    for states in (
        rollout(Own(), past, actions, generator=draw),
        torch.stack([step(u) for u in actions.unbind(1)], 1),
    ):
        torch.testing.assert_close(states, truth, rtol=1e-5, atol=1e-6)
    assert not as_dynamics(Own()).stochastic
    predicted = model_predictor(Own(), past)(actions[None])
    torch.testing.assert_close(predicted, truth.expand(1, 1, -1, -1, -1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("horizon", [1, 5, 13])
def test_one_step_and_five_step_models_agree_with_the_system(
    data: Trajectories, horizon: int
) -> None:
    past = initial_past(torch.from_numpy(data.states[:, 0]), 1, 2)
    actions = torch.from_numpy(data.actions[:, :horizon])
    truth = torch.from_numpy(data.states[:, 1 : horizon + 1])
    for segment_len in (1, 5):
        torch.testing.assert_close(
            rollout(Linear(segment_len), past, actions), truth, rtol=1e-5, atol=1e-6
        )


def test_every_window_pairs_a_state_with_the_action_that_led_to_it(data: Trajectories) -> None:
    whole = data.padded(L)
    for start in range(T - H + 1):
        cut = windows(whole, torch.arange(N), torch.full((N,), start), L, H)
        predicted = rollout(Linear(H), cut.past, cut.future.actions)
        torch.testing.assert_close(predicted, cut.future.states, rtol=1e-5, atol=1e-6)
        late = cut.future.actions.roll(
            1, dims=1
        )  # paired with another action, the system is another one
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
    draw = batches(
        data.padded(L),
        past_len=L,
        future_len=H,
        batch_size=500,
        generator=torch.Generator().manual_seed(0),
    )
    batch = next(draw)
    assert batch.past.states.shape == (500, L, 3)
    assert batch.future.actions.shape == (500, H, 2)
    every = {
        row.tobytes()
        for episode in data.actions
        for row in np.lib.stride_tricks.sliding_window_view(episode, H, 0)
    }
    seen = {np.ascontiguousarray(row.T).tobytes() for row in batch.future.actions.numpy()}
    assert seen == every


def test_batches_are_a_function_of_the_generator(data: Trajectories) -> None:
    def first(seed: int) -> Window:
        generator = torch.Generator().manual_seed(seed)
        return next(
            batches(data.padded(L), past_len=L, future_len=H, batch_size=8, generator=generator)
        )

    assert torch.equal(first(0).future.states, first(0).future.states)
    assert not torch.equal(first(0).future.states, first(1).future.states)


def test_episodes_of_exactly_one_window_are_enough_and_shorter_ones_are_refused(
    data: Trajectories,
) -> None:
    def batch(future_len: int) -> Window:
        generator = torch.Generator()
        return next(
            batches(
                data.padded(L), past_len=L, future_len=future_len, batch_size=3, generator=generator
            )
        )

    assert batch(T).future.states.shape == (3, T, 3)
    with pytest.raises(
        TrajectoryError,
        match=f"episodes of {T} steps are too short for windows of {T + 1}.*collect",
    ):
        batch(T + 1)


def test_a_choice_of_episodes_keeps_what_they_are(data: Trajectories) -> None:
    chosen = data.take(np.array([2, 0]))
    assert (len(chosen), chosen.horizon, chosen.env, chosen.names) == (2, T, data.env, data.names)
    np.testing.assert_array_equal(chosen.states, data.states[[2, 0]])
    np.testing.assert_array_equal(chosen.actions, data.actions[[2, 0]])


# What is no trajectory -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_named_by_episode_step_and_field(
    data: Trajectories, value: float
) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        episode, step, column = (int(rng.integers(n)) for n in (N, T + 1, 3))
        states = data.states.copy()
        states[episode, step, column] = value
        with pytest.raises(TrajectoryError) as caught:
            replace(data, states=states)
        assert f"episode {episode}, step {step}, field '{'abc'[column]}': {value}" in str(
            caught.value
        )
    actions = data.actions.copy()
    actions[2, 7, 1] = value
    with pytest.raises(
        TrajectoryError, match="in actions of tsm/Linear-v0 .* episode 2, step 7, field 'action 1'"
    ):
        replace(data, actions=actions)


def test_arrays_that_do_not_fit_each_other_are_refused(data: Trajectories) -> None:
    for states in (data.states[:, 1:], data.states[1:], data.states[0]):
        with pytest.raises(
            TrajectoryError, match=r"of tsm/Linear-v0 do not fit: expected \(N, T \+ 1, dx\)"
        ):
            replace(data, states=states)
    with pytest.raises(TrajectoryError, match="3 state dimensions, 2 names, 3 units"):
        replace(data, names=("a", "b"))


# Episodes of different length ----------------------------------------------------------------------------------------

ENDS = (20, 6, 2, 13)  # steps of each episode


@pytest.fixture
def ragged(data: Trajectories) -> Trajectories:
    """The linear system's episodes, cut where they end; the second and the third were ended by the environment."""
    states = [data.states[i, : n + 1] for i, n in enumerate(ENDS)]
    actions = [data.actions[i, :n] for i, n in enumerate(ENDS)]
    return Trajectories.ragged(
        states,
        actions,
        data.env,
        data.dt,
        data.names,
        data.units,
        terminated=(False, True, True, False),
    )


def test_an_episode_is_padded_by_its_last_state_and_zero_actions(
    data: Trajectories, ragged: Trajectories
) -> None:
    assert (ragged.lengths, ragged.horizon, len(ragged)) == (ENDS, T, N)
    for episode, steps in enumerate(ENDS):
        np.testing.assert_array_equal(
            ragged.states[episode, : steps + 1], data.states[episode, : steps + 1]
        )
        np.testing.assert_array_equal(
            ragged.actions[episode, :steps], data.actions[episode, :steps]
        )
        assert (ragged.states[episode, steps:] == data.states[episode, steps]).all()
        assert (ragged.actions[episode, steps:] == 0).all()


def test_windows_are_all_those_within_an_episode_and_as_often_each(ragged: Trajectories) -> None:
    marked = replace(
        ragged, states=ragged.states + 100 * np.arange(N, dtype=np.float32)[:, None, None]
    )
    known = {  # a double loop, by their last state
        tuple(marked.states[i, start + H].tolist())
        for i, n in enumerate(ENDS)
        for start in range(n - H + 1)
    }
    draw = batches(
        marked.padded(L),
        past_len=L,
        future_len=H,
        batch_size=4000,
        generator=torch.Generator().manual_seed(0),
        lengths=marked.lengths,
    )
    seen = [tuple(state) for state in next(draw).future.states[:, -1].tolist()]
    counts = np.array([seen.count(window) for window in known])
    assert counts.sum() == len(seen), "a window crosses the end of an episode"
    assert len(known) == 16 + 2 + 0 + 9
    assert np.abs(counts - 4000 / len(known)).max() < 5 * np.sqrt(4000 / len(known))


def test_equal_lengths_draw_the_windows_that_they_always_drew(data: Trajectories) -> None:
    def first(lengths: tuple[int, ...]) -> Window:
        options = {"past_len": L, "future_len": H, "batch_size": 8, "lengths": lengths}
        return next(batches(data.padded(L), generator=torch.Generator().manual_seed(3), **options))  # type: ignore[arg-type]

    told = replace(data, lengths=(T,) * N)
    assert told.lengths == ()
    assert torch.equal(first(told.lengths).future.states, first(()).future.states)


def test_no_window_at_all_is_an_error(ragged: Trajectories) -> None:
    short = ragged.take(np.array([1, 2]))
    with pytest.raises(
        TrajectoryError, match="episodes of 6 steps are too short for windows of 7 future steps"
    ):
        next(
            batches(
                short.padded(L),
                past_len=L,
                future_len=7,
                batch_size=3,
                generator=torch.Generator(),
                lengths=short.lengths,
            )
        )


def test_a_choice_of_episodes_keeps_where_they_end(ragged: Trajectories) -> None:
    few = ragged.take(np.array([3, 1]))
    assert (few.lengths, few.terminated, few.horizon) == ((13, 6), (False, True), 13)
    assert ragged.take(slice(0, 1)).lengths == ragged.take(slice(0, 1)).terminated == ()
    long = ragged.cut(6)
    assert (long.lengths, long.terminated, long.states.shape) == (
        (),
        (False, True, False),
        (3, 7, 3),
    )
    with pytest.raises(
        TrajectoryError,
        match="no episode of tsm/Linear-v0 has 21 steps: 4 episodes, the longest of",
    ):
        ragged.cut(21)
    with pytest.raises(
        TrajectoryError,
        match=r"a map needs .*; those of tsm/Linear-v0 have 2 to 20 steps.*data\.cut",
    ):
        ragged.require_equal_lengths("a map")
    long.require_equal_lengths("a map")


def test_statistics_are_of_real_steps(ragged: Trajectories) -> None:
    real = [ragged.states[i, : n + 1] for i, n in enumerate(ENDS)]
    for features in (
        Features(3, ()).fit(torch.from_numpy(ragged.states), ragged.lengths),
        TSM.for_data(ragged, channels=8).features,
    ):
        np.testing.assert_allclose(features.mean, np.concatenate(real).mean(0), rtol=1e-5)
        np.testing.assert_allclose(features.std, np.concatenate(real).std(0, ddof=1), rtol=1e-5)
        steps = np.concatenate([np.diff(x, axis=0) for x in real])
        np.testing.assert_allclose(features.step_std, steps.std(0, ddof=1), rtol=1e-4)
    actions = np.concatenate([ragged.actions[i, :n] for i, n in enumerate(ENDS)])
    np.testing.assert_allclose(ActionPrior.for_data(ragged).std, actions.std(0, ddof=1), rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lengths": (20, 6, 2)}, "lengths of .* expected a tuple of 4 ints"),
        ({"lengths": (20, 6.0, 2, 13)}, "lengths of .* expected a tuple of 4 ints"),
        ({"terminated": (1, 0, 0, 0)}, "terminated of .* expected a tuple of 4 bools"),
        (
            {"lengths": (20, 0, 2, 13)},
            "lengths of tsm/Linear-v0 go from 0 to 20; expected at least 1",
        ),
        ({"lengths": (19, 6, 2, 13)}, "the longest to fill the 20 steps"),
        (
            {"lengths": (20, 5, 2, 13)},
            "episode 1 of tsm.Linear-v0 ends after 5 steps, but its arrays go on at step 5",
        ),
    ],
)
def test_ends_that_do_not_fit_the_arrays_are_refused(
    ragged: Trajectories, change: dict, message: str
) -> None:
    with pytest.raises(TrajectoryError, match=message):
        replace(ragged, **change)
    with pytest.raises(TrajectoryError, match=r"states \(3, 3\) and actions \(3, 2\) of episode 0"):
        Trajectories.ragged(
            [np.zeros((3, 3))], [np.zeros((3, 2))], "mine", 1.0, ("a", "b", "c"), ("", "", "")
        )


def test_scores_are_of_windows_within_their_episode(ragged: Trajectories) -> None:
    options = {"samples": 1, "horizon": 4, "starts": (1, 5, 9)}
    found = sample_states(Linear(H), ragged, **options)  # type: ignore[arg-type]
    slow = [
        ragged.states[i, start + 1 : start + 5]
        for i, n in enumerate(ENDS)
        for start in (1, 5, 9)
        if start + 4 <= n
    ]
    assert len(slow) == 3 + 1 + 0 + 3
    np.testing.assert_allclose(found[0], np.stack(slow), rtol=1e-4, atol=1e-5)


def test_held_out_windows_never_cross_an_end(ragged: Trajectories) -> None:
    found = fixed_windows(ragged, L, H)
    predicted = Linear(H).predict_segment(found.past, found.future.actions)
    assert found.future.states.shape == (27, H, 3)
    torch.testing.assert_close(predicted, found.future.states, rtol=1e-4, atol=1e-5)


def test_what_a_person_prints_is_a_line() -> None:
    data = tsm.collect_random("tsm/Reacher-v0", 3, horizon=20, seed=0)
    task = tsm.load_task("tsm/Reacher-v0").take(2)
    trial = tsm.execute(task, torch.zeros(2, task.horizon, 2))
    plan = tsm.Plan(
        trial.actions,
        trial.actions,
        trial.states[None],
        trial.executed_return,
        trial.executed_return,
        1.0,
    )
    assert repr(data) == "Trajectories('tsm/Reacher-v0', 3 episodes, 20 steps, 6 states)"
    assert repr(task) == f"Task('reach', 'tsm/Reacher-v0', 2 starts, {task.horizon} steps)"
    for shown, kind in ((trial, "executed"), (plan, "predicted")):
        assert f"mean {kind} return {float(trial.executed_return.mean()):.4g}" in repr(shown)
        assert f"{task.horizon} steps" in repr(shown)
        assert len(repr(shown)) < 100
