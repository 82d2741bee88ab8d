"""Collecting, executing, posing tasks: records are what happened; the gap is predicted minus
executed return.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

from reproduction.measures.planning import random_torques
from tsmlib import rewards
from tsmlib.collection import collect, collect_random, open_loop, smooth_torques
from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE
from tsmlib.models.action_prior import ActionPrior
from tsmlib.planning import predictors
from tsmlib.planning.base import Plan, Predictor, SearchSpace
from tsmlib.planning.closed_loop import mpc
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import adam, cem, mppi
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import TASK_SEED, draw_task, load_task
from tsmlib.rewards import Reward
from tsmlib.sampling import Noise
from tsmlib.trajectory import Segment, Trajectories

REACHER, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"


def arms(env_id: str, n: int) -> Any:
    return gymnasium.make_vec(env_id, num_envs=n)


def torques(n: int, steps: int, seed: int = 0) -> Tensor:
    return smooth_torques(n, steps, generator=torch.Generator().manual_seed(seed), rms=0.2)


# Collecting


@pytest.mark.parametrize("env_id", [REACHER, PUSH, "tsm/PymunkPush-v1"])
def test_collected_episodes_are_the_simulators_rollouts(env_id: str) -> None:
    env, actions = arms(env_id, 3), torques(3, 12)
    data = collect(env, open_loop(actions), horizon=12, seed=5)
    start, _ = env.reset(seed=5)
    np.testing.assert_array_equal(data.states[:, 0], start.astype(np.float32))
    np.testing.assert_array_equal(
        data.states[:, 1:], env.unwrapped.rollout(actions.numpy()).astype(np.float32)
    )
    np.testing.assert_array_equal(data.actions, actions)
    arm = env.unwrapped
    assert (data.env, data.dt, data.names, data.angles) == (env_id, 0.02, tuple(arm.names), (0, 1))
    assert data.states.dtype == data.actions.dtype == np.float32


def test_a_controller_that_is_asked_again_gets_the_past() -> None:
    asked: list[Segment] = []
    plan = torques(2, 20)

    def three_at_a_time(past: Segment) -> Tensor:
        done = 3 * len(asked)
        asked.append(past)
        return plan[:, done : done + 3]

    data = collect(arms(REACHER, 2), three_at_a_time, horizon=10, past_len=5, seed=0)
    assert len(asked) == 4
    assert data.horizon == 10  # the last answer is cut short
    whole = data.segment(5)
    for k, past in enumerate(asked):
        assert torch.equal(past.states, whole.states[:, 3 * k : 3 * k + 5])
        assert torch.equal(past.actions, whole.actions[:, 3 * k : 3 * k + 5])
    at_once = collect(arms(REACHER, 2), open_loop(plan), horizon=10, seed=0)
    np.testing.assert_array_equal(data.states, at_once.states)


def test_what_is_recorded_is_what_the_arm_received() -> None:
    strong = torch.full((1, 4, 2), 3.0, requires_grad=True)
    data = collect(arms(REACHER, 1), open_loop(strong), horizon=4, seed=0)
    assert (data.actions == 1).all()


# Smooth torques


def test_torques_start_near_zero_and_settle_to_their_strength() -> None:
    drawn = smooth_torques(4000, 60, generator=torch.Generator().manual_seed(0), rms=0.1)
    strength = drawn.square().mean((0, 2)).sqrt()  # (60,)
    assert strength[0] < 0.07
    assert (strength[:5].diff() > 0).all()
    assert (strength[20:] - 0.1).abs().max() < 0.003
    assert drawn.mean().abs() < 1e-3


@pytest.mark.parametrize("given", [{"seed": 2**32}, {"time_constant": 0}])
def test_what_would_count_as_another_value_is_refused(given: dict[str, int]) -> None:
    name, value = next(iter(given.items()))
    with pytest.raises(ValueError, match=f"{name} is {value}; expected"):
        collect_random(REACHER, 1, horizon=3, **given)


def test_torques_are_smooth_and_bounded() -> None:
    drawn = torques(2000, 60)
    now, later = drawn[:, 20:-1].flatten(), drawn[:, 21:].flatten()
    assert torch.corrcoef(torch.stack([now, later]))[0, 1] > 0.7
    strong = smooth_torques(500, 50, generator=torch.Generator().manual_seed(0), rms=2.0)
    assert strong.abs().max() == 1


# Executing


def some_task(env: str = REACHER, n: int = 4, horizon: int = 20) -> Task:
    return dataclasses.replace(draw_task(env, seed=3, n=n), horizon=horizon)


@pytest.mark.parametrize("env", ENV_IDS)
def test_without_torque_the_return_is_that_of_staying_put(env: str) -> None:
    task = some_task(env)
    trial = execute(task, task.idle_actions())
    distance = np.linalg.norm(task.start[:, task.position] - task.target.numpy(), axis=1)
    assert trial.states.shape == (4, 21, task.start.shape[1])
    np.testing.assert_allclose(
        trial.executed_return, -20 * distance, atol=20 * 1e-3
    )  # it drifts by less than a millimetre
    np.testing.assert_allclose(trial.final_distance, distance, atol=2e-3)
    np.testing.assert_allclose(trial.states[:, 0], task.start, atol=1e-7)


@pytest.mark.parametrize("env", [REACHER, PUSH])
def test_the_environments_reward_is_the_tasks(env: str) -> None:
    task, actions = some_task(env), torques(4, 20)
    trial = execute(task, actions)
    arm = arms(env, 4)
    arm.reset(options={"states": task.start, "target": task.target.numpy()})
    total, last = np.zeros(4), None
    for u in actions.unbind(1):
        last, reward, _, _, _ = arm.step(u.numpy())
        total += reward
    np.testing.assert_allclose(trial.executed_return, total, rtol=1e-5)
    np.testing.assert_allclose(trial.states[:, -1], last, rtol=1e-5, atol=1e-6)


def test_a_reward_is_distance_and_torque_of_its_own_target() -> None:
    draw = torch.Generator().manual_seed(0)
    states, actions = (
        torch.randn(5, 3, 7, 10, generator=draw),
        torch.randn(5, 3, 7, 2, generator=draw),
    )
    target = torch.randn(3, 2, generator=draw)
    for reward, at in (
        (rewards.reach(target, torque_weight=0.3), 4),
        (rewards.push(target, torque_weight=0.3), 6),
    ):
        found = reward(states, actions)
        assert found.shape == (5, 3, 7)
        for c, b, t in ((0, 0, 0), (4, 2, 6), (1, 2, 3)):
            apart = math.dist(states[c, b, t, at : at + 2].tolist(), target[b].tolist())
            effort = actions[c, b, t].square().sum().item()
            assert found[c, b, t].item() == pytest.approx(-apart - 0.3 * effort, rel=1e-5)


def test_a_reward_has_a_finite_slope_at_its_target() -> None:
    states = torch.zeros(1, 2, 6, requires_grad=True)
    rewards.reach(torch.zeros(1, 2))(states, torch.zeros(1, 2, 2)).sum().backward()
    assert torch.isfinite(states.grad).all()


def test_the_gap_is_predicted_minus_true() -> None:
    task = some_task()
    actions = random_torques(task)
    predicted = torch.tensor([-1.0, -2.0, 0.0, 5.0])
    plan = Plan(
        actions=actions,
        parameters=actions,
        states=torch.zeros(1, 4, 20, 6),
        predicted_return=predicted,
        curve=predicted[None],
        seconds=1.0,
    )
    trial, plain = execute(task, plan), execute(task, actions)
    torch.testing.assert_close(trial.executed_return, plain.executed_return)
    torch.testing.assert_close(trial.gap, predicted - plain.executed_return)
    with pytest.raises(ValueError, match="not planned"):
        _ = plain.gap


# Executing behind noisy sensors and with late actions


def imperfect_task(env: str = REACHER, n: int = 4, **how: Any) -> Task:
    """The plain arm's task, whose starts are true states."""
    return dataclasses.replace(some_task(env, n), env=imperfect(env, **how))


@pytest.mark.parametrize("env", [REACHER, "tsm/PymunkPush-v1"])
def test_behind_noisy_sensors_the_return_of_a_trial_is_that_of_the_true_states(env: str) -> None:
    noisy, clear, actions = imperfect_task(env, noise=NOISE), some_task(env), torques(4, 20)
    trial, plain = execute(noisy, actions), execute(clear, actions)
    assert torch.equal(trial.states, plain.states)
    assert torch.equal(trial.executed_return, plain.executed_return)
    assert torch.equal(trial.final_distance, plain.final_distance)
    assert trial.observed is not None
    assert trial.observed.shape == trial.states.shape
    assert (trial.observed != trial.states).all()
    assert plain.observed is None


def test_a_controller_behind_noisy_sensors_sees_nothing_else() -> None:
    seen: list[Segment] = []

    def watching(past: Segment) -> Tensor:
        seen.append(past)
        return -0.02 * past.states[:, -1:, 2:4]  # a brake

    task = imperfect_task(noise=NOISE)
    trial = execute(task, watching)
    assert trial.observed is not None
    whole = Trajectories(
        trial.observed.numpy(),
        trial.actions.numpy(),
        task.env,
        0.02,
        tuple("abcdef"),
        tuple("abcdef"),
    ).segment(10)
    assert len(seen) == 20
    for t, past in enumerate(seen):
        assert torch.equal(past.states, whole.states[:, t : t + 10])
    assert torch.equal(trial.actions, (-0.02 * trial.observed[:, :-1, 2:4]).clamp(-1, 1))
    np.testing.assert_array_equal(trial.states[:, 0], task.start)


@pytest.mark.parametrize(
    "how", [{"noise": NOISE}, {"delay": DELAY}, {"noise": NOISE, "delay": DELAY}]
)
def test_a_trial_of_an_imperfect_arm_can_be_repeated(how: dict[str, Any]) -> None:
    def brake(past: Segment) -> Tensor:
        return -0.02 * past.states[:, -1:, 2:4]

    first, again = (execute(imperfect_task(**how), brake) for _ in range(2))
    assert torch.equal(first.states, again.states)
    assert torch.equal(first.actions, again.actions)
    assert ("noise" in how) is (first.observed is not None) is (again.observed is not None)
    if first.observed is not None:
        assert torch.equal(first.observed, again.observed)


@pytest.mark.parametrize("env", [REACHER, "tsm/PymunkPush-v1"])
def test_with_late_actions_the_states_are_those_of_shifted_torques(env: str) -> None:
    task, actions = imperfect_task(env, delay=DELAY), torques(4, 20)
    trial = execute(task, actions)
    late = torch.cat([torch.zeros(4, DELAY, 2), actions], 1)[:, :20]
    assert torch.equal(trial.states, execute(some_task(env), late).states)
    assert torch.equal(trial.actions, actions)
    charged = task.reward(trial.states[:, 1:], late).sum(
        -1
    )  # what arrives, as the environment's own reward
    torch.testing.assert_close(trial.executed_return, charged)
    at_once = execute(some_task(env), actions)
    assert torch.equal(
        trial.states[:, : DELAY + 1], execute(some_task(env), 0 * actions).states[:, : DELAY + 1]
    )
    assert not torch.allclose(trial.states, at_once.states, atol=1e-3)


def test_a_closed_loop_plans_from_what_noisy_sensors_say_and_is_scored_by_true_states() -> None:
    task, model = imperfect_task(noise=NOISE), Wrong()
    trial = mpc(task, model, DirectActions(20, rms=0.1), as_it_is, every=10)  # type: ignore[arg-type]
    assert trial.observed is not None
    told = {past.states[:4, -1].contiguous().numpy().tobytes() for past in model.asked}
    for now in (0, 10):
        assert trial.observed[:, now].contiguous().numpy().tobytes() in told
    expected = task.reward(trial.states[:, 1:], trial.actions).sum(-1)
    torch.testing.assert_close(trial.executed_return, expected)


# Closed loop

as_it_is = partial(adam, iterations=0)  # the planner that leaves a plan as it is


def test_a_plan_that_is_never_made_again_is_executed_open_loop() -> None:
    task, space = some_task(PUSH), DirectActions(20, rms=0.3)
    planner = partial(cem, candidates=12, elites=3, iterations=2)
    trial = mpc(task, None, space, planner, every=20)
    assert trial.plan is not None
    open_loop = execute(task, trial.actions)
    assert torch.equal(trial.states, open_loop.states)
    torch.testing.assert_close(trial.executed_return, open_loop.executed_return)
    torch.testing.assert_close(
        trial.plan.predicted_return, trial.executed_return
    )  # the simulator keeps its word
    torch.testing.assert_close(trial.plan.states[0], trial.states[:, 1:])


@pytest.mark.parametrize(
    ("over", "every"), [("actions", 1), ("actions", 7), ("codes", 10), ("codes", 20)]
)
def test_what_is_left_of_a_good_plan_is_what_is_done_next(over: str, every: int) -> None:
    torch.manual_seed(0)
    task, prior = (
        some_task(horizon=30),
        ActionPrior(2, channels=8).fit_scale(0.1 * torch.randn(20, 30, 2)),
    )
    space = (
        LatentActions(prior.requires_grad_(False), 30)
        if over == "codes"
        else DirectActions(30, rms=0.3)
    )
    plan = cem(
        predictors.simulator_predictor(REACHER, task.start),
        task.reward,
        space,
        4,
        candidates=12,
        elites=3,
        iterations=2,
    )
    trial = mpc(task, None, space, as_it_is, every=every, plan=plan)
    assert trial.plan is not None
    torch.testing.assert_close(trial.actions, plan.actions, rtol=1e-4, atol=1e-6)
    assert trial.plan.curve.shape == (math.ceil(30 / every), 4)
    torch.testing.assert_close(
        trial.plan.curve, trial.executed_return.expand_as(trial.plan.curve), rtol=1e-3, atol=1e-4
    )
    torch.testing.assert_close(trial.gap, torch.zeros(4), rtol=0, atol=1e-3)
    torch.testing.assert_close(trial.plan.states[0], trial.states[:, 1:], rtol=1e-3, atol=1e-3)


def test_a_plan_begins_with_what_is_proposed_which_are_actions() -> None:
    task = some_task(PUSH)
    proposed = 0.5 * torch.ones(len(task), 20, 2)
    propose = partial(mpc, task, None, proposal=lambda task, past, steps: proposed)
    trial = propose(DirectActions(20, rms=0.3), as_it_is, every=20)
    torch.testing.assert_close(trial.actions, proposed)
    with pytest.raises(TypeError, match="proposal is of actions.*expected DirectActions"):
        propose(LatentActions(ActionPrior(2, channels=8), 20), as_it_is)
    with pytest.raises(ValueError, match=r"what proposal gave.*30"):
        propose(DirectActions(20, rms=0.3), as_it_is, proposal=lambda *_: torch.ones(3, 30, 2))


def test_planning_again_through_the_true_simulator_never_makes_a_plan_worse() -> None:
    task = some_task()
    planner = partial(mppi, candidates=12, iterations=2)
    trial = mpc(task, None, DirectActions(20, rms=0.3), planner, every=5)
    assert trial.plan is not None
    assert (trial.plan.curve.diff(dim=0) > -1e-4).all()
    assert (trial.plan.curve[-1] > trial.plan.curve[0]).any()
    torch.testing.assert_close(trial.plan.curve[-1], trial.executed_return, rtol=1e-4, atol=1e-4)


@dataclasses.dataclass
class Wrong:
    """A model in which every step adds to the angles, and that remembers which past it was asked
    about.
    """

    segment_len: int = 5
    past_len: int = 3
    asked: list[Segment] = dataclasses.field(default_factory=list)

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        self.asked.append(past)
        return past.states[:, -1:] + actions.cumsum(1).sum(-1, keepdim=True)


def test_of_a_hundred_steps_ten_plans_are_made_each_for_the_steps_that_are_left() -> None:
    torch.manual_seed(0)
    prior = ActionPrior(2, channels=8).fit_scale(0.1 * torch.randn(20, 30, 2)).requires_grad_(False)
    made: list[tuple[SearchSpace, Tensor | int, Plan]] = []

    def planner(
        predict: Predictor, reward: Reward, space: SearchSpace, start: Tensor | int
    ) -> Plan:
        plan = mppi(predict, reward, space, start, candidates=3, iterations=1)
        made.append((space, start, plan))
        return plan

    task = some_task(n=2, horizon=100)
    trial = mpc(task, None, LatentActions(prior, 100), planner, every=10)
    assert [space.shape for space, _, _ in made] == [
        (10 - k, 8) for k in range(10)
    ]  # a code for every ten steps
    assert [plan.actions.shape[1] for _, _, plan in made] == list(range(100, 0, -10))
    for (_, _, before), (_, start, _) in pairwise(made):
        assert isinstance(start, Tensor)
        assert torch.equal(
            start[0], before.parameters[:, 1:]
        )  # the codes that are left, as they were
    executed = torch.cat([plan.actions[:, :10] for _, _, plan in made], 1)
    assert torch.equal(trial.actions, executed)


def test_a_closed_loop_judges_its_candidates_by_what_it_is_told_to() -> None:
    asked: list[tuple[int, int]] = []

    def judge(model: Any, past: Segment, *, seed: int) -> Predictor:
        asked.append((seed, past.states.shape[1]))
        return predictors.model_predictor(model, past, samples=3, seed=seed)

    task, model = some_task(horizon=20), Wrong()
    planner = partial(mppi, candidates=3, iterations=1)
    # type: ignore[arg-type]
    mpc(task, model, DirectActions(20, rms=0.1), planner, every=8, judge=judge, seed=5)
    assert asked == [(5, 3), (21, 3), (37, 3)]  # other noise for each plan
    assert {len(past.states) // 4 for past in model.asked} == {
        3,
        32,
    }  # a candidate's samples, and the fresh ones


def test_every_plan_is_made_from_the_past_that_was_observed() -> None:
    def push_on(predict: Any, reward: Any, space: Any, start: Any) -> Plan:
        return adam(predict, reward, space, torch.full((1, 4, *space.shape), 0.2), iterations=0)

    task, model = some_task(horizon=20), Wrong()
    trial = mpc(task, model, DirectActions(20, rms=0.1), push_on, every=8)  # type: ignore[arg-type]
    whole = Trajectories(
        trial.states.numpy(), trial.actions.numpy(), REACHER, 0.02, tuple("abcdef"), tuple("abcdef")
    ).segment(3)
    observed = {
        past.states[:4].numpy().tobytes() + past.actions[:4].numpy().tobytes()
        for past in model.asked
    }
    for now in (0, 8, 16):
        expected = (
            whole.states[:, now : now + 3].contiguous(),
            whole.actions[:, now : now + 3].contiguous(),
        )
        assert expected[0].numpy().tobytes() + expected[1].numpy().tobytes() in observed


def test_a_reward_that_depends_on_the_time_sees_the_whole_episode() -> None:
    height = torch.linspace(0, 0.1, 20)

    def rise(states: Tensor, actions: Tensor) -> Tensor:
        return -(states[..., 5] - height).abs()  # fails on any other horizon

    task = some_task().with_reward("rise", rise)
    trial = mpc(
        task,
        None,
        DirectActions(20, rms=0.3),
        partial(cem, candidates=24, elites=4, iterations=3),
        every=6,
    )
    assert trial.plan is not None
    torch.testing.assert_close(trial.plan.curve[-1], trial.executed_return, rtol=1e-3, atol=1e-4)
    assert (trial.executed_return > 0.7 * execute(task, task.idle_actions()).executed_return).all()


# Tasks


def test_pushing_without_an_object_is_refused() -> None:
    with pytest.raises(ValueError, match=f"there is nothing to push in {REACHER}"):
        dataclasses.replace(
            some_task(), name="push", reward_for=rewards.push, position=rewards.BLOCK
        )


@pytest.mark.parametrize("env", ENV_IDS)
def test_frozen_tasks_are_those_their_seed_draws(env: str) -> None:
    frozen, drawn = load_task(env), draw_task(env, seed=TASK_SEED["test"])
    assert (frozen.name, frozen.env, len(frozen)) == (drawn.name, env, 100)
    np.testing.assert_allclose(frozen.start, drawn.start, rtol=0, atol=1e-6)
    torch.testing.assert_close(frozen.target, drawn.target, rtol=0, atol=1e-6)
    assert not np.allclose(frozen.start, load_task(env, "validation").start)
