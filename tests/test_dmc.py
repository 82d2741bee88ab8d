"""Five tasks with the figures of the DeepMind Control Suite, and `solve`, which learns them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

import tsmlib
from tsmlib.envs import CONTROL_IDS
from tsmlib.rewards import reward_of

REACHER, _, CARTPOLE, PENDULUM, CUP = CONTROL_IDS


def played(env_id: str, start: list[float], steps: int) -> np.ndarray:
    """States (T + 1, dx) of an episode without any action."""
    env = gymnasium.make(env_id)
    states = [env.reset(options={"states": np.array(start)})[0]]
    zero = np.zeros(env.action_space.shape, np.float32)
    states += [env.step(zero)[0] for _ in range(steps)]
    return np.array(states)


def test_an_untouched_ball_comes_to_hang_below_its_cup() -> None:
    last = played(CUP, [0, 0, 0.15, 0.3, 0, 0, 0, 0], 500)[-50:]
    cup_x, cup_z, ball_x, ball_z = last[:, :4].T
    string = np.hypot(ball_x - cup_x, 0.2 + ball_z - (0.6 - 0.108 + cup_z))
    assert np.all(string < 0.31)
    assert np.all(0.2 + ball_z < 0.6 + cup_z - 0.3)
    assert abs(float(np.mean(ball_x - cup_x))) < 0.02


def test_a_falling_pendulum_gains_what_it_loses_in_height_but_for_its_damping() -> None:
    angle, speed = played(PENDULUM, [0.5, 0.0], 60).T
    inertia = 0.5**2 + 0.4 * 0.05**2
    energy = inertia * speed**2 / 2 + 9.81 * 0.5 * np.cos(angle)
    lost = np.cumsum(0.1 * speed[1:] ** 2) * 0.04
    np.testing.assert_allclose(energy[1:] + lost, energy[0], atol=0.35)
    assert lost[-1] > 2


@pytest.mark.parametrize("env_id", CONTROL_IDS)
def test_the_reward_of_an_environment_is_its_function_and_lies_in_0_to_1(env_id: str) -> None:
    env, rng, states, actions, rewards = (
        gymnasium.make(env_id),
        np.random.default_rng(0),
        [],
        [],
        [],
    )
    env.reset(seed=3)
    for _ in range(40):
        u = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        x, r, *_ = env.step(u)
        states.append(x), actions.append(u), rewards.append(float(r))
    reward, guided = reward_of(env_id), reward_of(env_id, guided=True)
    after, taken = torch.tensor(np.array(states)), torch.tensor(np.array(actions))
    own = reward(after, taken).double()
    assert own.min() >= 0
    assert own.max() <= 1
    before = torch.tensor(rewards) - own  # of the first of the two control steps
    assert before.min() >= -1e-6
    assert before.max() <= 1 + 1e-6
    assert torch.isfinite(guided(after, taken)).all()


@pytest.mark.parametrize(
    ("env_id", "best"),
    [(CARTPOLE, [0, 0, 0, 0]), (PENDULUM, [0, 0]), (CUP, [0, 0, 0, 0.35, 0, 0, 0, 0])],
)
def test_the_best_state_of_a_task_is_rewarded_by_one(env_id: str, best: list[float]) -> None:
    action = torch.zeros(gymnasium.make(env_id).action_space.shape)
    assert float(reward_of(env_id)(torch.tensor(best), action)) == pytest.approx(1)


@pytest.mark.parametrize("env_id", CONTROL_IDS)
def test_a_start_that_is_given_is_the_start_and_what_follows_is_a_function_of_it(
    env_id: str,
) -> None:
    env = gymnasium.make(env_id)
    start, _ = env.reset(seed=1)
    action = np.full(env.action_space.shape, 0.5, np.float32)
    first = [env.step(action)[0] for _ in range(5)]
    again, _ = env.reset(options={"states": start})
    np.testing.assert_array_equal(again, start)
    np.testing.assert_allclose([env.step(action)[0] for _ in range(5)], first, atol=1e-12)


def test_the_true_simulator_predicts_what_is_executed() -> None:
    task = tsmlib.Task.from_env(CUP, n=2, horizon=30)
    actions = torch.rand(2, 30, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    predicted = tsmlib.simulator_predictor(task)(actions[None])[0, 0]
    np.testing.assert_array_equal(predicted, tsmlib.execute(task, actions).states[:, 1:])


@pytest.mark.parametrize("env_id", CONTROL_IDS)
def test_every_task_is_drawn_and_what_moves_is_seen(env_id: str) -> None:
    film = tsmlib.episode_film(tsmlib.collect_random(env_id, 1, horizon=5, rms=0.8), 0)
    assert film.shape[0] == 6
    assert (film[0] != film[5]).any()


@pytest.mark.parametrize("env_id", ["tsm/dmc-walker-v0", "tsm/dmc-cup-catch-v1"])
def test_an_unknown_task_is_named_beside_those_that_there_are(env_id: str) -> None:
    with pytest.raises(gymnasium.error.NameNotFound, match="is none of tsm/dmc-reacher-easy-v0"):
        tsmlib.collect_random(env_id, 1)


def test_an_id_with_two_slashes_is_the_same_environment() -> None:
    data = tsmlib.collect_random(CUP.replace("dmc-", "dmc/"), 1, horizon=3)
    assert data.env == CUP
    assert (
        data.flat_states.tolist() == tsmlib.collect_random(CUP, 1, horizon=3).flat_states.tolist()
    )


SMALL = tsmlib.SolveOptions(
    episodes=2, candidates=16, iterations=1, hidden=32, first=150, updates=30, ahead=0.6
)


def test_a_run_that_was_stopped_goes_on_with_the_same_numbers(tmp_path: Path) -> None:
    def run(steps: int, folder: Path) -> tsmlib.Solved:
        options = {"horizon": 40, "options": SMALL, "progress": False, "folder": folder}
        return tsmlib.solve(PENDULUM, steps, **options)

    whole = run(480, tmp_path / "whole")
    run(320, tmp_path / "stopped")
    rest = run(480, tmp_path / "stopped")
    assert rest.data == whole.data
    assert [r["return"] for r in rest.records] == [r["return"] for r in whole.records]
    assert [r["env_steps"] for r in whole.records] == [320, 480]
    for name, weight in whole.model.state_dict().items():
        torch.testing.assert_close(rest.model.state_dict()[name], weight, rtol=0, atol=0)
    assert len(whole.film(tmp_path / "pendulum.gif")) == 40
    assert (tmp_path / "pendulum.gif").stat().st_size > 1000
    assert whole.play().own_return is not None


def test_an_environment_without_a_reward_function_says_how_one_is_given() -> None:
    with pytest.raises(ValueError, match="expected reward=function"):
        tsmlib.solve("Pendulum-v1")
    with pytest.raises(ValueError, match="two rounds of"):
        tsmlib.solve(PENDULUM, 1000)


def test_a_reward_that_is_out_of_reach_is_named() -> None:
    options = {"horizon": 20, "options": dataclasses.replace(SMALL, first=5), "progress": False}
    with pytest.raises(ValueError, match=r"0 at each of 80 steps; a plan that looks 0\.6 s ahead"):
        tsmlib.solve(CUP, 160, reward=lambda x, u: (x[..., 3] > 9).float(), **options)


def test_other_robots_are_solved_by_the_same_call() -> None:
    def upright(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return states[..., 0]

    pendulum = tsmlib.solve(
        "Pendulum-v1", 120, horizon=30, reward=upright, options=SMALL, progress=False
    )
    assert pendulum.records[-1]["return"] < 0 < len(pendulum.data)
    reach = tsmlib.rewards.reach(torch.tensor([[0.1, 0.1]]))
    arm = tsmlib.solve(
        "tsm/Reacher-v0", 160, horizon=40, reward=reach, options=SMALL, progress=False
    )
    assert arm.records[-1]["return"] == pytest.approx(arm.records[-1]["planned_return"])


def test_a_model_that_reaches_predicts_the_same_for_any_target() -> None:
    few = dataclasses.replace(SMALL, first=5, updates=5)
    model = tsmlib.solve(REACHER, 160, horizon=20, options=few, progress=False).model
    one = torch.randn(8, 6)
    other = torch.cat([one[:, :4], torch.randn(8, 2)], 1)
    moved = [model.step(x, torch.zeros(8, 2))[:, :4] for x in (one, other)]
    torch.testing.assert_close(*moved, rtol=0, atol=1e-6)
