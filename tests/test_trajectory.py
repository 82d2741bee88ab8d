"""The time convention, segments and windows, on a linear system whose future is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

import tsmlib as tsm
from tsmlib.evaluation.prediction import sample_states
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import as_dynamics, rollout, stepper
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


# The time convention


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
    for start in range(T - H + 1):
        cut = data.windows(torch.arange(N), torch.full((N,), start), L, H)
        predicted = rollout(Linear(H), cut.past, cut.future.actions)
        torch.testing.assert_close(predicted, cut.future.states, rtol=1e-5, atol=1e-6)
        late = cut.future.actions.roll(1, dims=1)  # with another action it is another system
        assert (rollout(Linear(H), cut.past, late) - cut.future.states).abs().max() > 0.05


def test_a_predicted_future_is_the_next_past(data: Trajectories) -> None:
    first = data.windows(torch.arange(N), torch.zeros(N, dtype=torch.long), L, H)
    second = data.windows(torch.arange(N), torch.full((N,), H), L, H)
    joined = first.past.then(first.future).last(L)
    assert all(torch.equal(a, b) for a, b in zip(joined, second.past, strict=True))


def test_before_the_first_step_the_arm_waits_without_torque(data: Trajectories) -> None:
    whole = data.segment(L)
    before = initial_past(torch.from_numpy(data.states[:, 0]), L, 2)
    assert torch.equal(whole.states[:, :L], before.states)
    assert torch.equal(whole.actions[:, :L], before.actions)
    assert torch.equal(whole.states[:, L:], torch.from_numpy(data.states[:, 1:]))
    assert torch.equal(whole.actions[:, L:], torch.from_numpy(data.actions))
    assert not torch.signbit(whole.actions[:, :L]).any()


# Episodes of different length

ENDS = (20, 6, 2, 13)  # steps of each episode


@pytest.fixture
def uneven(data: Trajectories) -> Trajectories:
    """The linear system's episodes, cut; the environment ended the second and the third."""
    return Trajectories(
        data.states,
        data.actions,
        data.env,
        data.dt,
        data.names,
        data.units,
        lengths=ENDS,
        terminated=(False, True, True, False),
    )


def test_windows_are_those_of_a_double_loop(uneven: Trajectories) -> None:
    pairs = [(i, start) for i, n in enumerate(ENDS) for start in range(n - H + 1)]
    cut = uneven.windows(*torch.tensor(pairs).unbind(1), L, H)
    for row, (episode, start) in enumerate(pairs):
        x, u = uneven.episode(episode)
        for k in range(L + H):
            t = start - L + k  # the step that this column holds
            part, column = (cut.past, k) if k < L else (cut.future, k - L)
            np.testing.assert_array_equal(part.states[row, column], x[max(t + 1, 0)])
            np.testing.assert_array_equal(part.actions[row, column], u[t] if t >= 0 else 0 * u[0])


@pytest.mark.parametrize(("episode", "start"), [(1, 2), (0, -1), (3, 13)])
def test_a_window_that_leaves_its_episode_is_refused(
    uneven: Trajectories, episode: int, start: int
) -> None:
    with pytest.raises(TrajectoryError, match="leave their episodes"):
        uneven.windows(torch.tensor([episode]), torch.tensor([start]), L, H)


def drawn(data: Trajectories, n: int = 8, seed: int = 0, future_len: int = H) -> Window:
    generator = torch.Generator().manual_seed(seed)
    options = {"past_len": L, "future_len": future_len, "batch_size": n}
    return next(batches(data.tensors(), generator=generator, **options))


def test_batches_are_a_function_of_the_generator(data: Trajectories) -> None:
    assert torch.equal(drawn(data).future.states, drawn(data).future.states)
    assert not torch.equal(drawn(data).future.states, drawn(data, seed=1).future.states)


@pytest.mark.filterwarnings("ignore:training")
@pytest.mark.parametrize("lengths", [ENDS, (20,) * 4])
def test_windows_are_all_those_within_an_episode_and_as_often_each(
    data: Trajectories, lengths: tuple[int, ...]
) -> None:
    marked = data.states + 100 * np.arange(N, dtype=np.float32)[:, None, None]
    uneven = replace(data, states=marked, lengths=lengths)
    known = {  # a double loop, by their last state
        tuple(marked[i, start + H].tolist())
        for i, n in enumerate(lengths)
        for start in range(n - H + 1)
    }
    seen = [tuple(state) for state in drawn(uneven, 4000).future.states[:, -1].tolist()]
    counts = np.array([seen.count(window) for window in known])
    assert counts.sum() == len(seen), "a window crosses the end of an episode"
    assert np.abs(counts - 4000 / len(known)).max() < 5 * np.sqrt(4000 / len(known))


def test_episodes_shorter_than_a_window_are_counted_aloud(uneven: Trajectories) -> None:
    with pytest.warns(UserWarning, match="1 of 4 episodes are shorter than 5 steps and are not"):
        drawn(uneven)
    with pytest.warns(UserWarning, match="validation .*: 3 of 4 episodes are shorter than 14"):
        fixed_windows(uneven, L, 14)
    with pytest.raises(TrajectoryError, match="4 episodes of at most 20 steps hold no window of"):
        drawn(uneven, future_len=21)


def test_one_long_episode_among_short_ones_costs_what_it_holds() -> None:
    steps = [100] * 300 + [50_000]
    x = [np.zeros((n + 1, 10), np.float32) for n in steps]
    u = [np.zeros((n, 2), np.float32) for n in steps]
    data = Trajectories(x, u, env="log", dt=0.1)
    given = sum(array.nbytes for array in x + u)
    assert data.flat_states.nbytes + data.flat_actions.nbytes == given
    tensors = data.tensors()
    assert tensors.states.data_ptr() == data.flat_states.ctypes.data


def test_parts_of_data_keep_what_they_are(uneven: Trajectories) -> None:
    few = uneven.take([3, 1])
    assert (few.lengths, few.terminated, few.robot) == ((13, 6), (False, True), uneven.robot)
    for ours, theirs in zip(few.episode(1), uneven.episode(1), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with pytest.warns(UserWarning, match=r"cut\(steps\) .*: 1 of 4 episodes"):
        long = uneven.cut(6)
    assert (long.terminated, long.states.shape) == ((False, True, False), (3, 7, 3))
    pieces = uneven.pieces(6)
    assert pieces.lengths == (6, 6, 6, 2, 6, 2, 6, 6, 1)
    assert pieces.terminated == (False,) * 4 + (True, True) + (False,) * 3
    np.testing.assert_array_equal(pieces.episode(1)[0], uneven.episode(0)[0][6:13])
    assert uneven.joined(few).lengths == (*ENDS, 13, 6)
    train, held_out = uneven.split(0.75)
    assert (len(train), len(held_out)) == (3, 1)
    assert sorted(train.lengths + held_out.lengths) == sorted(ENDS)
    x, u = uneven.padded(25)
    assert (x.shape, u.shape) == ((4, 26, 3), (4, 25, 2))
    assert (x[1, 6:] == x[1, 6]).all()
    assert not u[1, 6:].any()


def test_what_needs_equal_lengths_says_so(uneven: Trajectories) -> None:
    with pytest.raises(
        TrajectoryError, match=r"data.states needs .* have 2 to 20 steps.*data\.cut"
    ):
        _ = uneven.states
    with pytest.raises(AttributeError, match="no attribute 'sattes'"):
        _ = uneven.sattes


def test_statistics_are_of_real_steps(uneven: Trajectories) -> None:
    episodes = [uneven.episode(i) for i in range(N)]
    x = np.concatenate([states for states, _ in episodes])
    steps = np.concatenate([np.diff(states, axis=0) for states, _ in episodes])
    features = TSM.for_data(uneven, channels=8).features
    np.testing.assert_allclose(features.mean, x.mean(0), rtol=1e-5)
    np.testing.assert_allclose(features.std, x.std(0, ddof=1), rtol=1e-5)
    np.testing.assert_allclose(features.step_std, steps.std(0, ddof=1), rtol=1e-4)
    u = np.concatenate([actions for _, actions in episodes])
    np.testing.assert_allclose(ActionPrior.for_data(uneven).std, u.std(0, ddof=1), rtol=1e-5)


@pytest.mark.filterwarnings("ignore:scores")
def test_scores_are_of_windows_within_their_episode(uneven: Trajectories) -> None:
    samples = sample_states(Linear(H), uneven, samples=1, horizon=4, starts=(1, 5, 9))
    slow = [
        uneven.episode(i)[0][start + 1 : start + 5]
        for i, n in enumerate(ENDS)
        for start in (1, 5, 9)
        if start + 4 <= n
    ]
    np.testing.assert_allclose(samples[0], np.stack(slow), rtol=1e-4, atol=1e-5)


# What is no trajectory, and what is one in another form


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_value_that_is_not_finite_is_named_by_episode_step_and_field(
    uneven: Trajectories, value: float
) -> None:
    episodes = [uneven.episode(i) for i in range(N)]
    states = [x.astype(np.float64) for x, _ in episodes]
    states[3][4, 1] = value
    with pytest.raises(TrajectoryError, match=r"first in episode 3, step 4, field 'b'"):
        Trajectories(states, [u for _, u in episodes], "log", 0.1, uneven.names)


X, U = np.zeros((2, 6, 2)), np.zeros((2, 5, 1))
TURN = np.array([[[0.0, 3.0], [0.1, -3.0], [0.2, -2.9], [0.3, -2.8], [0.4, -2.7], [0.5, -2.6]]] * 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": X[:, 1:]}, r"states \(5, 2\) and actions \(5, 1\) of episode 0 do not fit"),
        ({"states": X[1:]}, "1 episodes of states, but 2 of actions"),
        ({"states": X[0]}, r"A single episode goes in a list: \[states\]"),
        ({"states": []}, "there are no states"),
        ({"states": X.astype(complex)}, "are of type complex128; expected real numbers"),
        ({"states": X.astype(str)}, "expected real numbers"),
        ({"states": [X[0], X[1, :, :1]]}, "states of episode 1 have shape"),
        ({"states": np.ma.masked_equal(X, 0)}, "not finite"),
        ({"states": X[:, :1], "actions": U[:, :0]}, "at least one action"),
        ({"actions": U + 2}, r"go up to 2; expected them within \[-1, 1\]. Scale them"),
        ({"dt": 0}, "dt is 0; expected a number above 0"),
        ({"dt": np.nan}, "dt is nan"),
        ({"env": 5}, "env is 5"),
        ({"names": ("a",)}, "names are"),
        ({"names": ("a", "a")}, "no name twice"),
        ({"names": "ab"}, "names is 'ab'"),
        ({"units": (1, 2)}, "units is"),
        ({"angles": (2,)}, "expected a tuple of some of 0 to 1, or of x0, x1"),
        ({"angles": (-1,)}, "angles are"),
        ({"angles": (0, 0)}, "angles are"),
        ({"angles": (True,)}, "angles are"),
        ({"angles": "x0"}, "angles are"),
        ({"angles": ("theta",)}, "angles are"),
        ({"angles": ("x0",), "units": ("deg", "")}, "expected radians"),
        ({"angles": ("x0",), "units": ("Deg.", "")}, "expected radians"),
        ({"angles": ("q [deg]",), "names": ("q [deg]", "x")}, "without degrees"),
        ({"states": 60 * TURN, "angles": (1,), "unwrap": True}, "jumps by .*convert degrees"),
        (
            {"states": TURN, "angles": ("x1",)},
            "'x1' jumps .* 2 step.*episode 0 after step 0.*unwrap",
        ),
        ({"lengths": (5,)}, "lengths is .* expected 2 values"),
        ({"lengths": (5, 6)}, "lengths is .* no more than the 5 steps"),
        ({"lengths": (5, 0)}, "lengths is .* expected at least 1"),
        ({"lengths": (5, 4.5)}, "lengths is"),
        ({"terminated": (1, 0)}, "terminated is .* expected 2 values of type bool"),
    ],
)
def test_what_is_no_trajectory_is_refused_with_what_to_do(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Trajectories(**({"states": X, "actions": U, "env": "log", "dt": 0.1} | change))


@pytest.mark.parametrize(
    "cast",
    [
        lambda x: x.astype(np.int64),
        lambda x: x.astype(">f4"),
        lambda x: x.astype(np.float16),
        lambda x: x[:, ::-1][:, ::-1],
        lambda x: np.asfortranarray(x),
        lambda x: torch.from_numpy(x),
        lambda x: x.tolist(),
        lambda x: list(x),
        lambda x: tuple(torch.from_numpy(part) for part in x),
    ],
)
def test_numbers_of_any_type_become_contiguous_float32(cast: Callable) -> None:
    x = np.arange(12.0).reshape(2, 3, 2)
    data = Trajectories(cast(x), np.zeros((2, 2, 1)), "log", 0.1)
    assert data.states.dtype == np.float32
    assert data.states.flags.c_contiguous
    np.testing.assert_array_equal(data.states, x)


def test_data_are_a_copy_of_what_was_given() -> None:
    x = np.zeros((2, 6, 2), np.float32)
    data = Trajectories(x, U, "log", 0.1)
    x[:] = 9
    assert not data.states.any()


def test_a_wrapped_angle_is_unwrapped_on_request() -> None:
    data = Trajectories(TURN, U, "log", 0.1, angles=["x1"], unwrap=True)
    assert data.angles == (1,)
    np.testing.assert_allclose(data.states[0, 1:, 1], TURN[0, 1:, 1] + 2 * np.pi, rtol=1e-6)
    np.testing.assert_allclose(np.cos(data.states), np.cos(TURN), atol=1e-5)


def moving(offset: float, scale: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    return offset + scale * rng.normal(size=(4, 21, 2)).cumsum(1)


def test_numbers_that_float32_cannot_tell_apart_are_refused() -> None:
    u = np.zeros((4, 20, 1))
    with pytest.raises(TrajectoryError, match="'x0' goes up to 1e.06.*Take an offset off it"):
        Trajectories(moving(1e6, 0.01), u, "log", 0.1)
    constant = np.full((4, 21, 2), 1e6 + 0.3)
    assert not Trajectories(constant, u, "log", 0.1).increments().any()


@pytest.mark.parametrize("scale", [1e6, 1.0, 1e-6, 1e-9, 1e-20])
def test_units_change_no_standardised_number(scale: float) -> None:
    u = np.zeros((4, 20, 1))
    usual = Trajectories(moving(0, 1), u, "log", 0.1)
    other = Trajectories(moving(0, scale), u, "log", 0.1)
    ours, theirs = (tsm.OneStep.for_data(data).features for data in (usual, other))
    assert theirs.moving.all()
    ratio = theirs.step_std.double() / ours.step_std
    np.testing.assert_allclose(ratio, scale, rtol=1e-5)
    standardised = ours(torch.from_numpy(usual.states)), theirs(torch.from_numpy(other.states))
    torch.testing.assert_close(*standardised, rtol=1e-4, atol=1e-4)


def test_rounding_is_no_motion() -> None:
    x = moving(0, 1).astype(np.float32)
    x[..., 1] = 1e4
    x[:, ::2, 1] = np.nextafter(np.float32(1e4), np.float32(2e4))
    data = Trajectories(x, np.zeros((4, 20, 1)), "log", 0.1)
    assert tsm.OneStep.for_data(data).features.moving.tolist() == [True, False]


def test_two_robots_are_told_apart_by_every_field(data: Trajectories) -> None:
    robot = replace(data.robot, units=("rad", "", ""))
    robot.require_same(replace(robot, dt=robot.dt * 1.0001), "both")
    changes = [("env", "door"), ("dt", 0.5), ("names", ("a", "b", "d")), ("angles", (0,))]
    for field, value in [*changes, ("units", ("", "", "")), ("action_dim", 7)]:
        other = replace(robot, **{field: value})
        with pytest.raises(TrajectoryError, match=f"both are not of one robot: {field} is"):
            robot.require_same(other, "both")
        robot.require_same(other, "both", but=(field,))
    with pytest.raises(TrajectoryError, match="env is .* and 'door'; dt is"):
        data.joined(replace(data, env="door", dt=0.5))


@pytest.mark.parametrize(
    ("index", "message"),
    [
        ([9], "there are 4 episodes"),
        (slice(0, 0), "no episode is left"),
        ([True], "boolean"),
        (None, "a slice, or numbers"),
    ],
)
def test_a_choice_that_is_not_there_is_refused(
    data: Trajectories, index: object, message: str
) -> None:
    with pytest.raises(TrajectoryError, match=message):
        data.take(index)  # type: ignore[arg-type]


def test_data_are_equal_by_their_numbers(data: Trajectories) -> None:
    assert data == replace(data, states=data.states.copy())
    assert data != replace(data, states=data.states + 1)
    assert data != data.take([0])


def test_a_single_episode_is_not_split(data: Trajectories) -> None:
    with pytest.raises(TrajectoryError, match=r"1 episode.*data\.pieces"):
        data.take([0]).split()
    for share in (0, 1, 1.5, "half"):
        with pytest.raises((TypeError, ValueError), match="share|split"):
            data.split(share)  # type: ignore[arg-type]


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
