"""A task of one's own is one torch function; where it is wrong, the error says what to do."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor
from untrained import in_units

import tsmlib
from tsmlib import rewards
from tsmlib.envs import variant
from tsmlib.models.tsm import TSM
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import adam, cem, mppi
from tsmlib.planning.predictors import model_predictor, simulator_predictor
from tsmlib.planning.search_spaces import DirectActions
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import draw_task
from tsmlib.rewards import Reward

REACHER, N, T = "tsm/Reacher-v0", 3, 20
ANGLE = torch.linspace(0, math.pi / 2, T)
ARC = 0.18 * torch.stack([ANGLE.cos(), ANGLE.sin()], -1)  # (T, 2)


def arc(states: Tensor, actions: Tensor) -> Tensor:
    """Be on the arc at the right time."""
    return -(states[..., rewards.TIP] - ARC).norm(dim=-1) - actions.square().sum(-1)


def posed(reward: Reward = arc, env: str = REACHER) -> Task:
    return draw_task(env, seed=3, n=N).with_reward(
        "trace an arc", reward, target=ARC[-1], horizon=T
    )


def test_an_own_task_is_planned_for_and_executed() -> None:
    task = posed()
    plan = cem(
        simulator_predictor(REACHER, task.start),
        task.reward,
        DirectActions(T, rms=0.3),
        N,
        candidates=48,
        elites=6,
        iterations=5,
    )
    trial, nothing = execute(task, plan), execute(task, task.idle_actions())
    torch.testing.assert_close(
        trial.executed_return, arc(trial.states[:, 1:], trial.actions).sum(-1)
    )
    torch.testing.assert_close(trial.executed_return, plan.predicted_return)
    assert (
        trial.executed_return > 0.7 * nothing.executed_return
    ).all()  # both are costs below zero
    torch.testing.assert_close(
        trial.final_distance, (trial.states[:, -1, 4:6] - ARC[-1]).norm(dim=1)
    )


def test_a_zone_to_keep_away_from_changes_the_plan() -> None:
    plain = draw_task(REACHER, seed=3, n=N)
    target, zone = torch.tensor([0.0, 0.2]), torch.tensor([0.16, 0.16])

    def around(states: Tensor, actions: Tensor) -> Tensor:
        inside = (0.05 - (states[..., rewards.TIP] - zone).norm(dim=-1)).relu()
        return rewards.reach(target.expand(N, 2))(states, actions) - 30 * inside

    depth = []
    for reward in (rewards.reach(target.expand(N, 2)), around):
        task = plain.with_reward("around", reward, target=target, horizon=T)
        plan = cem(
            simulator_predictor(REACHER, task.start),
            task.reward,
            DirectActions(T, rms=0.3),
            N,
            candidates=64,
            elites=8,
            iterations=8,
        )
        depth.append(
            (0.05 - (plan.states[0, ..., rewards.TIP] - zone).norm(dim=-1)).clamp(min=0).sum()
        )
    assert depth[1] < 0.3 * depth[0], depth


def test_a_task_of_another_name_needs_a_reward() -> None:
    plain = draw_task(REACHER, seed=3, n=N)
    with pytest.raises(TypeError, match="reward_for"):
        Task("dance", REACHER, plain.start, plain.target)  # type: ignore[call-arg]


def test_fewer_instances_keep_the_reward() -> None:
    few = posed().take(2)
    assert (few.reward, few.name, few.horizon, len(few)) == (arc, "trace an arc", T, 2)


# Rewards of the wrong shape


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        (
            lambda s, a: arc(s, a).sum(-1),
            r"a tensor \(2, 1, 3\)",
        ),  # the return, not the reward of a step
        (
            lambda s, a: -(s[..., 4:6] - ARC).norm(dim=-1, keepdim=True),
            r"a tensor \(2, 1, 3, 20, 1\)",
        ),
        (lambda s, a: -a.square().sum(-1), r"a tensor \(1, 3, 20\)"),  # of the torques alone
        (lambda s, a: 0.0, "a float"),
        (lambda s, a: arc(s, a).numpy(), "a ndarray"),
    ],
)
def test_a_reward_of_the_wrong_shape_is_refused(wrong: Reward, found: str) -> None:
    with pytest.raises(
        ValueError, match=rf"is {found}.*; expected a tensor \(2, 1, 3, 20\), one number per step"
    ):
        posed(wrong)


def test_some_instances_are_taken_by_number_and_none_that_there_is_not() -> None:
    task = tsmlib.load_task("tsm/Reacher-v0").take(4)
    some = task.take([3, 1])
    assert torch.equal(some.target, task.target[[3, 1]])
    assert (some.start == task.start[[3, 1]]).all()
    for wrong in ([], [4], [-1]):
        with pytest.raises(ValueError, match="choose some from 0 to 3|an index of a target"):
            task.take(wrong)


def test_a_reward_that_fails_says_what_it_was_given() -> None:
    with pytest.raises(
        ValueError,
        match=r"the reward fails on states \(2, 1, 3, 20, 6\) and actions \(1, 3, 20, 2\)",
    ):
        posed(lambda states, actions: states[..., 4:6] - ARC[:7])
    with pytest.raises(ValueError, match="the reward fails on states"):
        posed().take(2).with_reward("mine", rewards.reach(torch.zeros(5, 2)))


# Rewards without a number


def test_a_reward_that_is_no_number_is_refused_before_anything_is_planned() -> None:
    with pytest.raises(
        FloatingPointError,
        match="the reward is nan for target 0 at step 0, although the state there",
    ):
        posed(lambda states, actions: (arc(states, actions)).sqrt())
    with pytest.raises(
        ValueError,
        match="the reward of task 'trace an arc' is infinite for an arm that stands still",
    ):
        posed(lambda states, actions: arc(states, actions) + actions.square().sum(-1).log())


def test_a_reward_that_is_no_number_somewhere_stops_every_planner() -> None:
    task = posed(
        lambda states, actions: arc(states, actions) + 0 * (0.1 - states[..., 0].abs()).log()
    )
    torch.manual_seed(0)
    model = in_units(TSM(6, 2, channels=8))
    through = model_predictor(model, task.past(10), samples=1)
    for plan in (adam, cem, mppi):
        with pytest.raises(
            FloatingPointError, match=r"the reward is nan .* although the state there is finite"
        ):
            # type: ignore[operator]
            plan(through, task.reward, DirectActions(T, rms=0.1), torch.ones(1, N, T, 2))


def test_a_slope_that_is_no_number_stops_adam() -> None:
    task = posed(lambda states, actions: arc(states, actions) - (0 * states).sum(-1).abs().sqrt())
    with pytest.raises(
        FloatingPointError, match="the gradient of the return is not finite at the start"
    ):
        adam(
            model_predictor(in_units(TSM(6, 2, channels=8)), task.past(10)),
            task.reward,
            DirectActions(T, rms=0.1),
            N,
            iterations=2,
        )


# Rewards without a gradient


@pytest.mark.parametrize(
    "flat",
    [
        lambda states, actions: (states[..., 4] > 0.1).float(),
        lambda states, actions: (states[..., 4] > 0.1).float() - actions.square().sum(-1),
        lambda states, actions: arc(states.detach(), actions),
    ],
)
def test_adam_refuses_a_reward_without_a_gradient_and_the_others_do_not(flat: Reward) -> None:
    task = posed(flat)
    predict, space = (
        model_predictor(in_units(TSM(6, 2, channels=8)), task.past(10)),
        DirectActions(T, rms=0.1),
    )
    with pytest.raises(
        ValueError, match=r"not a differentiable function of the states.*plan with cem or mppi"
    ):
        adam(predict, task.reward, space, N, iterations=2)
    mppi(predict, task.reward, space, N, iterations=1, candidates=4)


def test_what_a_reward_would_be_after_the_end_neither_counts_nor_spoils_the_slope() -> None:
    x = torch.tensor([1.0, 0.5, 0.1, -0.1, math.nan])[None, :, None].requires_grad_()
    u = torch.tensor([0.1, 0.1, 0.1, 1.0, 1.0])[None, :, None].requires_grad_()
    counted = rewards.until(
        lambda x: x[..., 0] < 0.2, lambda x, u: x[..., 0].log() + (1 - u[..., 0]).sqrt()
    )
    found = counted(x[None, None], u[None])  # (S, C, B, T) of states, (C, B, T) of actions
    torch.testing.assert_close(found[0, 0, 0, :3], (x[0, :3, 0].log() + 0.9**0.5))
    assert (found[..., 3:] == 0).all()
    found.sum().backward()
    assert x.grad is not None
    assert u.grad is not None
    torch.testing.assert_close(x.grad.flatten(), torch.tensor([1.0, 2.0, 10.0, 0.0, 0.0]))
    torch.testing.assert_close(
        u.grad.flatten(), torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0]) * -0.5 / 0.9**0.5
    )


# Targets and horizons


def test_a_target_out_of_reach_is_refused() -> None:
    task = draw_task(REACHER, seed=3, n=N)
    far = torch.tensor([[0.1, 0.1], [0.2, 0.1], [0.0, 0.0]])
    with pytest.raises(
        ValueError,
        match=r"target 1 at \(0.200, 0.100\) m is out of reach: the fingertip gets .* 0.21 m",
    ):
        dataclasses.replace(task, target=far)
    dataclasses.replace(task, target=0.9 * far)
    push = draw_task("tsm/ReacherPush-v1", seed=3, n=N)
    dataclasses.replace(push, target=far)  # an object can lie in the corner
    with pytest.raises(
        ValueError,
        match=r"target 0 at \(0.300, 0.300\) m is out of reach: the object gets .* 0.21 m",
    ):
        dataclasses.replace(push, target=3 * far)


def test_a_target_in_the_hole_around_the_shoulder_is_refused() -> None:
    unequal = variant(REACHER, link_lengths=(0.06, 0.18))
    task = draw_task(unequal, seed=3, n=2)
    dataclasses.replace(task, target=torch.tensor([[0.11, 0.0], [0.24, 0.0]]))
    with pytest.raises(
        ValueError,
        match=r"target 1 at \(0.000, 0.100\) m is out of reach: .* expected 0.11 to 0.24 m",
    ):
        dataclasses.replace(task, target=torch.tensor([[0.11, 0.0], [0.0, 0.1]]))
