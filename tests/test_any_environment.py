"""Any Gymnasium environment with flat Boxes: what is collected, executed and predicted is what stepping it gives."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.registration import register, registry
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor

import tsmlib
from tsmlib import rewards
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs import stepping
from tsmlib.envs.snapshots import abilities
from tsmlib.envs.stepping import (
    Stepping,
    UnsupportedEnvironment,
    Vectorised,
    make_simulation,
    simulation,
)
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.exploration import ExplorationOptions, explore
from tsmlib.models.baselines import OneStep
from tsmlib.planning.execution import execute
from tsmlib.planning.tasks import Task
from tsmlib.policies.networks import Policy, controller
from tsmlib.training.fit import TrainingOptions
from tsmlib.trajectory import Trajectories

MUJOCO = [
    f"{name}-v5"
    for name in (
        "Ant",
        "HalfCheetah",
        "Hopper",
        "Humanoid",
        "HumanoidStandup",
        "InvertedDoublePendulum",
        "InvertedPendulum",
        "Pusher",
        "Reacher",
        "Swimmer",
        "Walker2d",
    )
]
IDS = ["Pendulum-v1", "MountainCarContinuous-v0", *MUJOCO]
PENDULUM, HOPPER, CHEETAH = "Pendulum-v1", "Hopper-v5", "HalfCheetah-v5"


def still(states: Tensor, actions: Tensor) -> Tensor:
    """Move little, with little."""
    return -states[..., 0].square() - 0.1 * actions.square().sum(-1)


def random_actions(n: int, horizon: int, dim: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return smooth_torques(n, horizon, generator=generator, action_dim=dim, rms=0.8)


def stepped(env_id: str, actions: Tensor, seed: int) -> list[tuple[np.ndarray, float, bool]]:
    """Observations, return and termination of every episode, from a loop that knows nothing of tsmlib."""
    found = []
    for i, own in enumerate(actions.double().numpy()):
        env = gymnasium.make(env_id)
        space: Any = env.action_space
        seen, total, over = [env.reset(seed=seed + i)[0]], 0.0, False
        for u in own:
            x, reward, over, late, _ = env.step(
                (space.low + (u + 1) / 2 * (space.high - space.low)).astype(np.float32)
            )
            seen.append(x)
            total += float(reward)
            if over or late:
                break
        found.append((np.stack(seen), total, over))
    return found


# Every id ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_every_robot_is_collected_fitted_planned_for_and_executed(env_id: str) -> None:
    data = tsmlib.collect_random(env_id, episodes=6, horizon=12, seed=0)
    model = tsmlib.OneStep.for_data(data, hidden=8)
    tsmlib.fit(
        model, model.loss, data, data, TrainingOptions(model.past_len, 2, steps=2, batch_size=4)
    )
    task = Task.from_env(
        env_id, n=2, horizon=5, reward=still, success=lambda x: x[:, -1, 0].abs() < 1
    )
    space = tsmlib.DirectActions(task.horizon, task.action_dim, rms=0.5)
    through = tsmlib.model_predictor(model, task.past(model.past_len))
    plan = tsmlib.cem(through, task.reward, space, len(task), candidates=4, elites=2, iterations=1)
    trial = tsmlib.execute(task, plan)
    assert trial.states.shape == (2, 6, data.states.shape[2])
    for i, (seen, total, _) in enumerate(stepped(env_id, plan.actions, seed=task.seeds[0])):
        taken = len(seen) - 1
        np.testing.assert_allclose(trial.states[i, : taken + 1], seen, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(
            trial.executed_return[i],
            still(trial.states[i, 1 : taken + 1], plan.actions[i, :taken]).sum(),
        )
        assert trial.own_return is not None
        assert float(trial.own_return[i]) == pytest.approx(total, rel=1e-4, abs=1e-5)
        assert trial.lengths == () or trial.lengths[i] == taken
    assert trial.success is not None
    assert trial.success.dtype == torch.bool


# Stepping ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [PENDULUM, HOPPER, "Walker2d-v5"])
def test_collected_episodes_are_those_of_a_loop_and_end_where_it_ends(env_id: str) -> None:
    env = gymnasium.make_vec(env_id, num_envs=3)
    actions = random_actions(3, 30, env.action_space.shape[1])
    data = collect(env, open_loop(actions), horizon=30, seed=5)
    slow = stepped(env_id, actions, seed=5)
    assert data.steps.tolist() == [len(seen) - 1 for seen, _, _ in slow]
    assert (data.terminated or (False,) * 3) == tuple(over for _, _, over in slow)
    for i, (seen, _, _) in enumerate(slow):
        np.testing.assert_array_equal(data.states[i, : len(seen)], seen.astype(np.float32))
    again = collect(make_simulation(env_id, 3), open_loop(actions), horizon=30, seed=5)
    np.testing.assert_array_equal(data.states, again.states)  # one copy or three


def test_an_episode_ends_at_the_limit_of_time_without_being_terminated() -> None:
    data = tsmlib.collect_random(PENDULUM, episodes=2, horizon=230, seed=0)
    assert set(data.lengths) == {200} and not any(data.terminated)


def test_a_controller_in_pieces_gets_what_one_in_a_piece_gets() -> None:
    actions, asked = random_actions(3, 24, 3), []

    def pieces(past: tsmlib.Segment) -> Tensor:
        asked.append(past)
        at = 7 * (len(asked) - 1)
        return actions[:, at : at + 7]

    whole, cut = (
        collect(make_simulation(HOPPER, 3), each, horizon=24, seed=0)
        for each in (open_loop(actions), pieces)
    )
    assert whole.lengths == cut.lengths
    np.testing.assert_allclose(whole.states, cut.states, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_what_a_vector_environment_makes_of_ended_episodes_stays_out_of_the_data(
    mode: AutoresetMode,
) -> None:
    make = partial(gymnasium.make, "InvertedPendulum-v5")
    env, actions = SyncVectorEnv([make] * 3, autoreset_mode=mode), random_actions(3, 20, 1)
    together, alone = (
        collect(each, open_loop(actions), horizon=20, seed=1) for each in (Vectorised(env), env)
    )
    assert alone.lengths
    assert together.lengths == alone.lengths
    assert all(together.terminated)
    np.testing.assert_array_equal(together.states, alone.states)
    np.testing.assert_array_equal(together.actions, alone.actions)


def test_an_environment_in_other_processes_is_collected_from() -> None:
    env, actions = AsyncVectorEnv([partial(gymnasium.make, PENDULUM)] * 2), random_actions(2, 5, 1)
    data = collect(env, open_loop(actions), horizon=5, seed=0)
    env.close()
    np.testing.assert_array_equal(
        data.states,
        collect(make_simulation(PENDULUM, 2), open_loop(actions), horizon=5, seed=0).states,
    )


class Drifts(VectorEnv):
    """Copies that are one: reset takes one seed, as Gymnasium's base class has it, and all of them end at once."""

    metadata = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012
    num_envs, dt = 2, 0.1
    single_observation_space = single_action_space = Box(-1, 1, (1,))

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict]:
        assert not options
        super().reset(seed=seed)
        self.x, self.t = self.np_random.normal(size=(2, 1)).astype(np.float32), 0
        return self.x, {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        self.x, self.t = self.x + actions, self.t + 1
        return self.x, np.zeros(2), np.zeros(2, bool), np.full(2, self.t >= 3), {}


def test_a_vector_environment_that_takes_one_seed_is_given_one() -> None:
    still = open_loop(torch.zeros(2, 5, 1))
    first, again, other = (collect(Drifts(), still, horizon=5, seed=seed) for seed in (1, 1, None))
    np.testing.assert_array_equal(first.states, again.states)
    assert first.states[0, 0] != first.states[1, 0] != other.states[1, 0]
    assert first.actions.shape == (2, 3, 1)
    with pytest.raises(
        UnsupportedEnvironment, match="Drifts takes no seed for each .* give one for all of them"
    ):
        collect(Drifts(), still, horizon=5, seed=[1, 2])


def test_a_wrapped_arm_is_collected_from_until_its_limit_of_time() -> None:
    wrapped = RecordEpisodeStatistics(gymnasium.make_vec("tsm/Reacher-v0", num_envs=2))
    actions = torch.zeros(2, 120, 2)
    data = collect(wrapped, open_loop(actions), horizon=120, seed=3)
    arms = collect(
        gymnasium.make_vec("tsm/Reacher-v0", num_envs=2), open_loop(actions), horizon=100, seed=3
    )
    np.testing.assert_allclose(data.states, arms.states, atol=1e-6)


def test_an_environment_without_an_id_is_collected_from() -> None:
    env, actions = SyncVectorEnv([HalfCheetahEnv, HalfCheetahEnv]), random_actions(2, 5, 6)
    assert simulation(env).path == "stepping: it cannot be told that its copies are alike"
    data = collect(env, open_loop(actions), horizon=5, seed=0)
    assert data.env == "HalfCheetahEnv"
    same = collect(make_simulation(CHEETAH, 2), open_loop(actions), horizon=5, seed=0)
    np.testing.assert_allclose(data.states, same.states, rtol=1e-5, atol=1e-6)


def test_full_actions_are_the_bounds_of_the_action_space() -> None:
    space = Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32))
    found = stepping.within_bounds(np.array([[-1, -1], [0, 0], [1, 1], [5, 0.5]]), space)
    np.testing.assert_array_equal(found, np.array([[-2, 0], [0, 5], [2, 10], [2, 7.5]], np.float32))


# Bulk simulation -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [CHEETAH, HOPPER, "Ant-v5", "Reacher-v5"])
def test_bulk_simulation_gives_what_stepping_gives(env_id: str) -> None:
    both = make_simulation(env_id, 3, returns=True), make_simulation(env_id, 3, returns=True)
    assert all(isinstance(each, Stepping) and each.bulk for each in both)
    assert both[0].path == "bulk simulation (mujoco.rollout)"
    both[1].bulk = None  # type: ignore[attr-defined]
    actions = random_actions(3, 40, both[0].action_dim)
    fast, slow = (collect(each, open_loop(actions), horizon=40, seed=2) for each in both)
    assert fast.lengths == slow.lengths
    np.testing.assert_allclose(fast.states, slow.states, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(both[0].returns, both[1].returns, rtol=1e-6)
    without = make_simulation(env_id, 3)
    np.testing.assert_array_equal(
        collect(without, open_loop(actions), horizon=40, seed=2).states, fast.states
    )
    assert np.isnan(without.returns).all()


def test_an_episode_that_is_only_observed_ends_at_its_limit_of_time_too(made: Made) -> None:
    env_id = made(HalfCheetahEnv, max_episode_steps=12)
    simulated, actions = make_simulation(env_id, 2), random_actions(2, 20, 6)
    assert isinstance(simulated, Stepping)
    assert simulated.bulk
    assert simulated.bulk.only_observes
    asked: list[int] = []

    def pieces(past: tsmlib.Segment) -> Tensor:
        asked.append(5 * len(asked))
        return actions[:, asked[-1] : asked[-1] + 5]

    data = collect(simulated, pieces, horizon=20, seed=0)
    assert set(data.lengths) == {12} and not any(data.terminated) and asked == [0, 5, 10]
    for i, (seen, _, _) in enumerate(stepped(env_id, actions, seed=0)):
        np.testing.assert_allclose(data.states[i], seen, rtol=1e-5, atol=1e-6)


def test_what_bulk_simulation_cannot_do_is_stepped() -> None:
    assert (
        "differ from those of stepping" in make_simulation("Humanoid-v5", 1).path
    )  # it observes contact forces
    assert "not one of MuJoCo's" in make_simulation(PENDULUM, 1).path


class Odd(HalfCheetahEnv):
    """A cheetah that behaves until step 30, when the trial is over; then ``how`` says what it does."""

    def __init__(self, how: str = "", **options: Any) -> None:
        self.how, self.taken = how, 0
        super().__init__(**options)

    def reset(self, **options: Any) -> Any:
        self.taken = 0
        return super().reset(**options)

    def step(self, action: np.ndarray) -> Any:
        self.taken += 1
        if self.taken > 30:
            if self.how == "noise":
                action = action + 0.1 * self.np_random.standard_normal(len(action))
            elif self.how == "push":
                self.data.xfrc_applied[1, 0] = 50.0
            elif self.how == "jump":
                self.set_state(self.data.qpos + 0.1, self.data.qvel)
        return super().step(action)


class Own(HalfCheetahEnv):
    def do_simulation(self, ctrl: np.ndarray, n_frames: int) -> None:
        super().do_simulation(0.5 * ctrl, n_frames)


@pytest.mark.parametrize("how", ["noise", "push", "jump"])
def test_a_robot_that_does_more_than_its_actions_say_is_stepped_from_then_on(
    how: str, made: Made
) -> None:
    env_id = made(partial(Odd, how), max_episode_steps=100)
    both = make_simulation(env_id, 2), make_simulation(env_id, 2)
    assert isinstance(both[0], Stepping)
    assert both[0].bulk
    both[1].bulk = None  # type: ignore[attr-defined]
    actions = random_actions(2, 40, 6)
    fast, slow = (collect(each, open_loop(actions), horizon=40, seed=2) for each in both)
    np.testing.assert_array_equal(fast.states, slow.states)


def test_a_robot_with_a_simulation_of_its_own_is_stepped(made: Made) -> None:
    assert "do_simulation of its own" in make_simulation(made(Own, max_episode_steps=100), 2).path


# The oracle ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [PENDULUM, HOPPER, "Ant-v5"])
def test_the_oracle_predicts_what_is_executed(env_id: str) -> None:
    task = Task.from_env(env_id, n=2, horizon=15, reward=still, seed=3)
    actions = torch.stack([random_actions(2, 15, task.action_dim, seed) for seed in range(3)])
    predict = tsmlib.simulator_predictor(task)
    for _ in range(2):  # asked again, it says the same
        predicted = predict(actions)
        for candidate, own in enumerate(actions):
            torch.testing.assert_close(
                predicted[0, candidate],
                tsmlib.execute(task, own).states[:, 1:],
                rtol=1e-5,
                atol=1e-6,
            )


@pytest.mark.parametrize("env_id", [PENDULUM, HOPPER])
def test_the_oracle_plans_again_from_where_the_robot_is(env_id: str) -> None:
    task = Task.from_env(env_id, n=2, horizon=12, reward=still, seed=3)
    space, planner = (
        tsmlib.DirectActions(12, task.action_dim, rms=0.5),
        partial(tsmlib.cem, candidates=6, elites=2),
    )
    trial = tsmlib.mpc(task, None, space, partial(planner, iterations=1), every=5)
    assert trial.plan is not None
    steps = trial.actions.shape[1]
    for i in range(2):
        own = (trial.lengths or (steps, steps))[i]
        torch.testing.assert_close(
            trial.plan.states[0, i, :own], trial.states[i, 1 : own + 1], rtol=1e-4, atol=1e-5
        )


def test_an_environment_that_does_not_repeat_itself_has_no_oracle_and_says_so(made: Made) -> None:
    env_id = made(lambda: Plain(noise=np.random.default_rng()))
    with pytest.raises(
        UnsupportedEnvironment,
        match="has no oracle and no replay: the same seed and actions do not",
    ):
        tsmlib.simulator_predictor(Task.from_env(env_id, n=2, horizon=5, reward=still))
    assert len(tsmlib.collect_random(env_id, episodes=3, horizon=5)) == 3


def test_an_environment_that_cannot_be_saved_has_no_oracle_but_is_collected_from(
    made: Made,
) -> None:
    env_id = made(lambda: Plain(hidden=True))
    assert not abilities(gymnasium.make(env_id)).restores
    with pytest.raises(
        UnsupportedEnvironment, match="no oracle and no replay: its state cannot be saved and set"
    ):
        tsmlib.simulator_predictor(Task.from_env(env_id, n=2, horizon=5, reward=still))
    actions = random_actions(3, 10, 1)
    data = collect(make_simulation(env_id, 3), open_loop(actions), horizon=10, seed=0)
    for i, (seen, _, _) in enumerate(stepped(env_id, actions, seed=0)):
        np.testing.assert_array_equal(data.states[i], seen.astype(np.float32))


class Fragile(gymnasium.Env):
    """Breaks at a step once it is told to; knows how many of it are open."""

    observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))
    open, broken = 0, False

    def __init__(self, observations: Any = None) -> None:
        Fragile.open += 1
        self.observation_space = observations or Fragile.observation_space

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if Fragile.broken:
            raise RuntimeError("broken")
        return np.zeros(2, np.float32), 0.0, False, False, {}

    def close(self) -> None:
        Fragile.open -= 1


class BlowsUp(gymnasium.Env):
    """A point that is pushed; from every third reset its speed is not a number at the fourth step."""

    observation_space, action_space = Box(-np.inf, np.inf, (2,)), Box(-1, 1, (1,))

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        self.state, self.taken = np.array([seed or 0, 0.0]) / 100, 0
        self.fails = (seed or 0) % 3 == 1
        return self.state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.taken += 1
        self.state += np.array([self.state[1], 0.1 * float(action[0])])
        if self.fails and self.taken == 4:
            self.state[1] = np.nan
        return self.state.astype(np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("vectorised", [False, True])
def test_an_episode_that_is_not_finite_is_told_with_its_step_since_reset(
    made: Made, vectorised: bool
) -> None:
    env_id = made(BlowsUp)
    copies = [lambda: gymnasium.make(env_id)] * 3
    run = simulation(
        AsyncVectorEnv(copies, context="fork") if vectorised else SyncVectorEnv(copies)
    )
    with closing(run):
        run.reset(seed=0)
        run.rollout(np.zeros((3, 2, 1)))
        with pytest.raises(SimulationUnstable, match=r"episode 1 at step 3: x1 is nan") as caught:
            run.rollout(np.zeros((3, 5, 1)))
        assert (caught.value.env, caught.value.episode, caught.value.step) == (run.id, 1, 3)


def test_exploring_leaves_out_the_episodes_in_which_an_environment_blows_up(made: Made) -> None:
    env_id = made(BlowsUp, max_episode_steps=20)
    sound = Task.from_env(env_id, n=6, horizon=8, reward=still, seed=100).take([1, 2, 4, 5])
    data = execute(
        sound, 0.3 * torch.randn(4, 8, 1, generator=torch.Generator().manual_seed(0))
    ).seen
    assert data is not None
    once = TrainingOptions(past_len=1, future_len=4, steps=2, batch_size=4, validate_every=1)
    options = ExplorationOptions(once, rounds=1, every=4, candidates=4, elites=2, iterations=1)
    model = OneStep.for_data(data, hidden=4)
    asked = Task.from_env(env_id, n=6, horizon=8, reward=still, seed=200)  # 202 and 205 fail
    found = explore(model, None, data.take([0, 1, 2]), data.take([3]), lambda k: asked, options)
    assert (found.records[0]["lost"], len(found.episodes[0] or ())) == (2, 4)
    assert found.records[0]["env_steps"] == 4 * 6 + 4 * 5 + 8 * 4


def test_environments_are_closed_where_collecting_or_executing_raises(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    env_id = made(Fragile)
    task = Task.from_env(env_id, n=3, horizon=2, reward=still)
    assert Fragile.open == 0
    monkeypatch.setattr(Fragile, "broken", True)
    for attempt in (
        lambda: tsmlib.collect_random(env_id, 3),
        lambda: tsmlib.execute(task, torch.zeros(3, 2, 1)),
    ):
        with pytest.raises(RuntimeError, match="broken"):
            attempt()
        assert Fragile.open == 0
    with pytest.raises(UnsupportedEnvironment):
        make_simulation(made(lambda: Fragile(Dict(x=Box(-1, 1, (2,))))), 2)
    assert Fragile.open == 0


# Tasks ---------------------------------------------------------------------------------------------------------------


def test_nothing_counts_after_an_episode_ended() -> None:
    def fallen(x: Tensor) -> Tensor:
        return (x[..., 0] < 0.7) | (x[..., 1].abs() > 0.2)

    task = Task.from_env(
        HOPPER, n=3, horizon=60, reward=rewards.until(fallen, lambda x, u: x[..., 5] + 1), seed=0
    )
    actions = random_actions(3, 60, 3)
    trial, predicted = (
        tsmlib.execute(task, actions),
        tsmlib.simulator_predictor(task)(actions[None])[0],
    )
    assert max(trial.lengths) < 60
    slow = [
        sum(float(trial.states[i, t, 5]) + 1 for t in range(1, steps + 1))
        for i, steps in enumerate(trial.lengths)
    ]
    np.testing.assert_allclose(trial.executed_return, slow, rtol=1e-4)
    np.testing.assert_allclose(task.reward(predicted, actions[None]).sum(-1)[0], slow, rtol=1e-4)
    assert [
        steps == int(fallen(trial.states[i]).int().argmax())
        for i, steps in enumerate(trial.lengths)
    ] == [True] * 3


def test_a_reward_sees_the_whole_episode_also_where_all_robots_fell_before() -> None:
    weight = torch.linspace(1, 2, 60)  # fails on any other horizon
    task = Task.from_env(HOPPER, n=2, horizon=60, reward=lambda x, u: x[..., 5] * weight, seed=0)
    space, planner = tsmlib.DirectActions(60, 3), partial(tsmlib.mppi, candidates=2, iterations=1)
    model = tsmlib.OneStep.for_data(tsmlib.collect_random(HOPPER, episodes=2, horizon=10), hidden=8)
    closed = tsmlib.mpc(task, model, space, planner, every=20)
    for trial in (closed, tsmlib.execute(task, lambda past: torch.ones(len(past.states), 1, 3))):
        assert max(trial.steps) < 60
        assert (trial.actions.shape, trial.states.shape) == ((2, 60, 3), (2, 61, 11))
        for i, steps in enumerate(trial.steps):
            assert not trial.actions[i, steps:].any()
            assert (trial.states[i, steps:] == trial.states[i, steps]).all()
        played = tsmlib.execute(task, trial.actions)
        torch.testing.assert_close(
            trial.executed_return, played.executed_return, rtol=1e-4, atol=1e-4
        )
    assert closed.plan is not None
    assert closed.plan.states.shape == (1, 2, 60, 11)


def test_success_is_a_yes_or_a_distance_within_the_tolerance() -> None:
    pose = partial(Task.from_env, PENDULUM, n=3, horizon=4, reward=still)
    nothing = torch.zeros(3, 4, 1)
    trial = tsmlib.execute(pose(), nothing)
    assert trial.success is None
    assert trial.final_distance.isnan().all()
    trial = tsmlib.execute(pose(success=lambda x: (x[:, -1, 0] - 1).abs(), tolerance=0.5), nothing)
    torch.testing.assert_close(trial.final_distance, (trial.states[:, -1, 0] - 1).abs())
    assert trial.success is not None
    assert trial.success.tolist() == (trial.final_distance <= 0.5).tolist()
    with pytest.raises(
        ValueError,
        match=r"success of task 'Pendulum-v1' is a tensor \(3, 5\) .* expected \(3,\), bool",
    ):
        tsmlib.execute(pose(success=lambda x: x[..., 0] > 0), nothing)


def test_a_task_is_no_longer_than_the_environments_limit_of_time() -> None:
    swing = partial(Task.from_env, PENDULUM, n=1, reward=still)
    with pytest.raises(
        ValueError,
        match="horizon is 250, but Pendulum-v1 ends episodes after 200 steps; give horizon=",
    ):
        swing(horizon=250)
    with pytest.raises(ValueError, match="horizon is 201, but"):
        swing(horizon=200).with_reward("longer", still, horizon=201)
    Task.from_env("tsm/Reacher-v0", n=1, horizon=150, reward=still)  # an arm goes on


def test_a_distance_without_a_tolerance_is_no_measure_of_success() -> None:
    pose = partial(
        Task.from_env, PENDULUM, n=3, horizon=4, reward=still, success=lambda x: x[:, -1, 0].abs()
    )
    with pytest.raises(
        ValueError, match=r"is a distance, .* and no tolerance is given; give the distance"
    ):
        pose()
    assert pose(tolerance=0.0).tolerance == 0


def test_a_task_of_any_robot_is_cut_and_repeated_with_its_seeds() -> None:
    task = Task.from_env(PENDULUM, n=3, horizon=4, reward=still, seed=7)
    assert (task.seeds, task.take(2).seeds, task.take(2).times(2).seeds) == (
        (7, 8, 9),
        (7, 8),
        (7, 8, 7, 8),
    )
    np.testing.assert_array_equal(task.start[2], gymnasium.make(PENDULUM).reset(seed=9)[0])
    with pytest.raises(
        ValueError,
        match=r"the reward of .* is a tensor \(2, 1, 3\); expected a tensor \(2, 1, 3, 4\)",
    ):
        Task.from_env(PENDULUM, n=3, horizon=4, reward=lambda x, u: still(x, u).sum(-1))


def test_by_default_a_task_begins_where_no_data_of_the_default_seed_did() -> None:
    data, task = (
        tsmlib.collect_random(PENDULUM, 60, horizon=1),
        Task.from_env(PENDULUM, n=8, horizon=4, reward=still),
    )
    assert not (data.states[:, None, 0] == task.start[None]).all(-1).any()


def test_starts_beyond_the_seeds_of_the_data_are_none_of_theirs() -> None:
    data = tsmlib.collect_random(PENDULUM, 1004, horizon=1)
    shared, apart = (
        Task.from_env(PENDULUM, n=4, horizon=4, reward=still, seed=seed)
        for seed in (1000, len(data))
    )
    np.testing.assert_array_equal(
        data.states[1000:, 0], shared.start
    )  # as the default's docstring says
    assert not (data.states[:, None, 0] == apart.start[None]).all(-1).any()


def test_a_task_of_ones_own_is_made_of_an_arm_too() -> None:
    task = Task.from_env("tsm/Reacher-v0", n=2, horizon=4, reward=still, seed=1)
    trial = tsmlib.execute(task, torch.zeros(2, 4, 2))
    np.testing.assert_allclose(trial.states[:, 0], task.start, rtol=1e-6)
    torch.testing.assert_close(
        tsmlib.simulator_predictor(task)(torch.zeros(1, 2, 4, 2))[0, 0], trial.states[:, 1:]
    )


@pytest.mark.parametrize("env_id", [PENDULUM, "tsm/Reacher-v0"])
def test_numpys_integers_are_integers(env_id: str) -> None:
    tasks = [
        Task.from_env(env_id, n=2, horizon=4, reward=still, seed=seed) for seed in (np.int64(3), 3)
    ]
    np.testing.assert_array_equal(tasks[0].start, tasks[1].start)
    assert tasks[0].seeds == tasks[1].seeds
    np.testing.assert_array_equal(tasks[0].take(np.int64(1)).start, tasks[1].take(1).start)
    data = [tsmlib.collect_random(env_id, 2, horizon=3, seed=seed) for seed in (np.int64(3), 3)]
    np.testing.assert_array_equal(data[0].states, data[1].states)
    with closing(make_simulation(env_id, 2)) as run:
        again = collect(
            run, open_loop(torch.from_numpy(data[0].actions)), horizon=3, seed=np.int64(3)
        )
    np.testing.assert_array_equal(data[0].states, again.states)


@pytest.mark.parametrize("how", ["-noise0.25", "-delay5"])
def test_a_task_of_an_imperfect_arm_begins_where_the_plain_arms_does(how: str) -> None:
    imperfect, plain = (
        Task.from_env(f"tsm/ReacherPush{word}-v1", n=3, horizon=4, reward=still, seed=1)
        for word in (how, "")
    )
    np.testing.assert_array_equal(imperfect.start, plain.start)
    trial = tsmlib.execute(imperfect, torch.zeros(3, 4, 2))
    np.testing.assert_allclose(trial.states[:, 0], plain.start, rtol=1e-6, atol=1e-7)


def test_a_search_space_of_another_robot_is_refused() -> None:
    data = tsmlib.collect_random(PENDULUM, episodes=2, horizon=10)
    task, model = (
        Task.from_env(PENDULUM, n=2, horizon=4, reward=still),
        tsmlib.OneStep.for_data(data, hidden=8),
    )
    through = tsmlib.model_predictor(model, task.past(model.past_len))
    with pytest.raises(
        ValueError, match="actions have 6 dimensions, those of the past 1; give the search space"
    ):
        tsmlib.cem(
            through, still, tsmlib.DirectActions(4, 6), 2, candidates=4, elites=2, iterations=1
        )


@pytest.mark.parametrize("kind", ["one step", "segment"])
def test_a_policy_is_learned_and_executed_on_another_robot(kind: str) -> None:
    data = tsmlib.collect_random(PENDULUM, episodes=4, horizon=20)
    model = tsmlib.OneStep.for_data(data, hidden=8)
    task = Task.from_env(PENDULUM, n=2, horizon=6, reward=still)
    if kind == "one step":
        policy: Policy = tsmlib.OneStepPolicy(3, 1, 0, hidden=8)
    else:
        policy = tsmlib.SegmentPolicy(
            3, tsmlib.ActionPrior.for_data(data, channels=8), 0, channels=8
        )
    policy.features.fit(data)
    begin = torch.from_numpy(data.states[:, 0])
    tsmlib.learn_policy(
        policy,
        model,
        task.reward_for,
        lambda n, generator: (begin[torch.arange(n) % 4], torch.zeros(n, 0)),
        tsmlib.LearningOptions(horizon=6, episodes=4, iterations=2, record_every=1),
    )
    trial = tsmlib.execute(task, controller(policy, task.target), past_len=policy.past_len)
    assert trial.states.shape == (2, 7, 3)


# What is not supported -----------------------------------------------------------------------------------------------


class Plain(gymnasium.Env):
    """A point that is pushed; its spaces, noise, and what it keeps out of sight, are arguments."""

    def __init__(
        self,
        observations: gymnasium.Space | None = None,
        actions: gymnasium.Space | None = None,
        noise: np.random.Generator | None = None,
        hidden: bool = False,
        grows: bool = False,
    ) -> None:
        self.observation_space = observations or Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = actions or Box(-1, 1, (1,), np.float32)
        self.noise, self.grows, self.t = noise, grows, 0
        place = [np.zeros(2)]
        self.where: Any = (lambda: place) if hidden else place

    @property
    def place(self) -> list[np.ndarray]:
        return self.where() if callable(self.where) else self.where

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t, self.place[0] = 0, self.np_random.standard_normal(2)
        return self.place[0].copy(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        self.place[0] = self.place[0] + 0.1 * action[0]
        if self.noise is not None:
            self.place[0] = self.place[0] + self.noise.standard_normal(2)
        seen = np.zeros(3) if self.grows and self.t > 30 else self.place[0].copy()
        return seen, 0.0, False, False, {}


Made, COUNT = Callable[..., str], itertools.count()


@pytest.fixture
def made() -> Iterator[Made]:
    """Registers an environment for one test."""
    names = []

    def make(entry: Callable[..., gymnasium.Env], **options: Any) -> str:
        names.append(f"tests/Own{next(COUNT)}-v0")
        register(names[-1], entry_point=lambda **_: entry(), disable_env_checker=True, **options)
        return names[-1]

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*does not say how long a step is.*")
        yield make
    for name in names:
        del registry[name]


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        (
            {"observations": Box(0, 255, (96, 96, 3), np.uint8)},
            r"observations of .* are images.*supported are .*Wrap it",
        ),
        (
            {"observations": Dict(x=Box(-1, 1, (2,)))},
            r"observations of .* are not flat, Dict.*FlattenObservation",
        ),
        ({"observations": Discrete(4)}, r"observations of .* are not flat, Discrete"),
        ({"actions": Discrete(2)}, r"actions of .* are discrete, Discrete\(2\); supported are"),
        ({"actions": Box(-1, 1, (2, 2))}, r"actions of .* are not flat, Box.*; supported are"),
        (
            {"actions": Box(-np.inf, np.inf, (1,))},
            r"actions of .* have no bounds, .*supported are .*RescaleAction",
        ),
    ],
)
def test_spaces_that_are_not_supported_are_named_with_what_is(
    made: Made, spaces: dict, message: str
) -> None:
    env_id = made(lambda: Plain(**spaces))
    for ask in (
        lambda: tsmlib.collect_random(env_id, episodes=2, horizon=3),
        lambda: collect(
            gymnasium.make_vec(env_id, num_envs=2), open_loop(torch.zeros(2, 3, 1)), horizon=3
        ),
        lambda: Task.from_env(env_id, n=2, horizon=3, reward=still),
    ):
        with pytest.raises(UnsupportedEnvironment, match=message):
            ask()


def test_an_environment_that_changes_its_space_is_named(made: Made) -> None:
    env_id = made(lambda: Plain(grows=True))
    with pytest.raises(
        UnsupportedEnvironment,
        match=r"of shape \(3,\), but says that they are \(2,\): it changes its",
    ):
        tsmlib.collect_random(env_id, episodes=2, horizon=40)


def test_other_robots_begin_from_seeds_and_not_from_observations() -> None:
    states = np.zeros((2, 3))
    with pytest.raises(
        UnsupportedEnvironment, match="Pendulum-v1 cannot begin in given states.*name the seed"
    ):
        collect(
            make_simulation(PENDULUM, 2), open_loop(torch.zeros(2, 3, 1)), horizon=3, states=states
        )
    with pytest.raises(UnsupportedEnvironment, match="Pendulum-v1 cannot begin in given states"):
        tsmlib.simulator_predictor(PENDULUM, states)(torch.zeros(1, 2, 3, 1))
    with pytest.raises(
        ValueError, match="3 seeds for 2 episodes of Pendulum-v1; expected one each"
    ):
        make_simulation(PENDULUM, 2).reset(seed=[1, 2, 3])


def test_actions_of_another_size_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"actions are \(2, 3, 2\); Pendulum-v1 expected \(2, T, 1\)"
    ):
        collect(make_simulation(PENDULUM, 2), open_loop(torch.zeros(2, 3, 2)), horizon=3)


def test_a_step_is_as_long_as_the_environment_says_or_counts_as_a_second(made: Made) -> None:
    assert [make_simulation(name, 1).dt for name in (PENDULUM, CHEETAH)] == [
        0.05,
        pytest.approx(0.05),
    ]
    assert make_simulation("MountainCarContinuous-v0", 1).dt == pytest.approx(1 / 30)
    env = gymnasium.make(made(Plain))
    with pytest.warns(
        UserWarning, match="does not say how long a step is; one step counts as one second"
    ):
        assert Stepping([env]).dt == 1.0


def test_what_an_environment_says_of_itself_is_kept_and_nothing_is_guessed(made: Made) -> None:
    assert (make_simulation(PENDULUM, 1).names, make_simulation(PENDULUM, 1).angles) == (
        ("x0", "x1", "x2"),
        (),
    )

    class Said(Plain):
        names, units, angles, dt = ("turn", "speed"), ("rad", "m/s"), (0,), 0.1

    data: Trajectories = tsmlib.collect_random(made(Said), episodes=2, horizon=3)
    assert (data.names, data.units, data.angles, data.dt) == (
        Said.names,
        Said.units,
        Said.angles,
        Said.dt,
    )
    assert isinstance(simulation(gymnasium.make_vec("tsm/Reacher-v0", num_envs=1)), stepping.Arms)
