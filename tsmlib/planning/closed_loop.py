"""Closed loop: planning again every few steps from what the robot really did.

Letters in shapes: B targets, T horizon, L past length, dx, du size of state and action.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm.auto import tqdm

from tsmlib.checks import (
    MOST,
    as_tensor,
    require_callable,
    require_count,
    require_seed,
    require_type,
)
from tsmlib.models.base import Model, as_dynamics
from tsmlib.planning.base import Judge, Plan, Planner, Predictor, SearchSpace
from tsmlib.planning.execution import (
    Trial,
    measured,
    open_loop_actions,
    require_task,
    run_task,
    whole_actions,
)
from tsmlib.planning.planners import reevaluate
from tsmlib.planning.predictors import fresh_predictor, model_predictor, simulator_predictor
from tsmlib.planning.search import require_space
from tsmlib.planning.search_spaces import DirectActions
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment

# task of some instances, their past, steps -> actions (B, steps, du)
Proposal = Callable[[Task, Segment, int], Tensor]


def mpc(
    task: Task,
    model: Model | None,
    space: SearchSpace,
    planner: Planner,
    *,
    every: int = 10,
    lookahead: int | None = None,
    until_success: bool = False,
    plan: Plan | None = None,
    judge: Judge = model_predictor,
    proposal: Proposal | None = None,
    seed: int = 0,
    progress: str = "",
) -> Trial:
    """Closed loop: plan to the end of the episode, execute some steps, observe, repeat.

    The horizon shrinks: T, T - every, T - 2 every, ... steps; with ``lookahead`` only where less
    is left. Each plan starts from what is left of
    the one before it (``SearchSpace.after``), and is never worse than that by its own prediction.
    Its predicted return comes from samples that had no part in choosing it (``fresh_predictor``).

    Args:
        task: whose starts and reward are meant.
        model: what plans are made through, from the observed past; None is the true simulator.
        space: of the whole episode, or of ``lookahead`` steps.
        planner: with the budget of each plan, such as ``partial(cem, candidates=96)``.
        every: steps executed before the next plan.
        lookahead: steps of each plan, where it is not to reach to the end of the episode; of
            ``DirectActions``, whose new steps begin at zero. The reward sees these steps alone,
            and predicted returns are theirs.
        until_success: whether instances that have succeeded stay idle, where the first success is
            what counts, and nothing is planned for them any more.
        plan: the first one, if there is one already, so that closed and open loop begin alike.
        judge: makes what candidates are judged by, by default the model's mode.
        proposal: gives another start of each plan, such as what a policy does in the model
            (``imagine``): task, past (B, L, .), steps -> actions (B, steps, du); of
            ``DirectActions``. A search that begins well needs fewer candidates.
        seed: of what judges and fresh samples draw, 0 or above.
        progress: title of the progress bar; none without.

    Returns:
        The trial. Of its plan ``predicted_return`` is the first plan's, ``curve`` (plans, B) every
        plan's for the whole episode, the return executed until then included, and ``states``
        (1, B, T, dx) the part of every predicted rollout that was executed; where all episodes
        ended before, the last of them repeats.

    Raises:
        TypeError, ValueError: an argument that cannot be; the message names it.
        SimulationUnstable: a state that is not finite.
    """
    require_task(task)
    every = require_count("every", every)
    ahead = task.horizon if lookahead is None else require_count("lookahead", lookahead, most=MOST)
    if lookahead is not None and ahead <= every:
        raise ValueError(f"lookahead is {ahead}; expected more than the {every} steps of every")
    seed = require_seed("seed", seed)
    require_space(space)
    planned = space.decode(torch.zeros(1, len(task), *space.shape)).shape[2]
    if planned != min(ahead, task.horizon):
        raise ValueError(
            f"space is of {planned} steps; expected the {min(ahead, task.horizon)} of the whole "
            f"episode of task {task.name!r}, or of lookahead"
        )
    require_callable("planner", planner, "a function, such as tsmlib.cem")
    require_callable("judge", judge, "a function, such as tsmlib.model_predictor")
    if plan is not None:
        open_loop_actions(task, plan)
        plan = replace(plan, start=None)  # sensors may say another
    task.require_robot(getattr(model, "robot", None), "the model and the task")
    if proposal is not None and not isinstance(space, DirectActions):
        raise TypeError(
            f"a proposal is of actions, and space is a {type(space).__name__}; expected "
            "DirectActions, such as DirectActions.for_data(data, horizon)"
        )
    began, horizon = time.perf_counter(), task.horizon
    past_len = 1 if model is None else as_dynamics(model).past_len
    planning = _Replanning(
        task, model, planner, every, ahead, until_success, judge, seed, space, len(task), plan
    )
    planning.proposal = proposal
    with tqdm(total=-(-horizon // every), desc=progress, disable=not progress) as bar:

        def controller(past: Segment) -> Tensor:
            actions = planning(past)
            bar.update()
            return actions

        seen, run = run_task(task, controller, horizon, past_len=horizon + past_len)
    actions, returns = whole_actions(seen, horizon), torch.stack(planning.returns)
    states = torch.cat(planning.rollouts, 2)[:, :, : seen.horizon]
    after = states[:, :, -1:].expand(-1, -1, horizon - seen.horizon, -1)
    made = Plan(
        actions=actions,
        parameters=actions,
        states=torch.cat([states, after], 2),
        predicted_return=returns[0],
        curve=returns,
        seconds=time.perf_counter() - began,
        start=torch.from_numpy(task.start),
        robot=getattr(model, "robot", None),
    )
    return measured(task, run, seen, actions, made)


@dataclass
class _Replanning:
    """The controller that plans each time it is asked, and keeps predictions."""

    task: Task
    model: Model | None
    planner: Planner
    every: int
    ahead: int  # steps of a plan, where as many are left
    until_success: bool
    judge: Judge
    seed: int
    space: SearchSpace  # of the rest of the episode, as are start and plan
    start: Tensor | int
    plan: Plan | None
    proposal: Proposal | None = None
    done: int = 0  # steps
    rollouts: list[Tensor] = field(default_factory=list)  # (1, B, every, dx) of each plan
    returns: list[Tensor] = field(default_factory=list)  # (B,) of each plan

    def __call__(self, past: Segment) -> Tensor:
        """``past`` holds the whole episode so far, with ``past_len`` steps before it."""
        steps = min(self.every, self.task.horizon - self.done)
        actions = self.task.idle_actions()[:, :steps]
        rollout = past.states[None, :, -1:].repeat(1, 1, steps, 1)
        returns = self.returns[-1].clone() if self.returns else rollout.new_zeros(len(self.task))
        rows = self._unsolved(past)
        if len(rows):
            plan, judged = self._planned(past, rows)
            actions[rows], returns[rows] = plan.actions[:, :steps], judged.predicted_return
            rollout[:, rows] = judged.states[:1, :, :steps]
        self.returns.append(returns)
        self.rollouts.append(rollout)
        self.done += steps
        if len(rows) and self.done < self.task.horizon:
            parameters = plan.parameters.new_zeros(len(self.task), *plan.parameters.shape[1:])
            parameters[rows] = plan.parameters
            rest, left = self.space.after(parameters, steps)
            if self.ahead < self.task.horizon:  # as long a plan as before, or as far as the end
                needed = min(self.ahead, self.task.horizon - self.done)
                left = F.pad(left, (0, 0, 0, needed - left.shape[1]))
                rest, _ = self.space.after(parameters, plan.actions.shape[1] - needed)
            self.space = rest
            self.start = left[None]
        return actions

    def _unsolved(self, past: Segment) -> Tensor:
        """Which instances are planned for."""
        everyone = torch.arange(len(self.task))
        if not self.until_success or not self.done:
            return everyone
        _, success = self.task.judged(past.states[:, past.states.shape[1] - self.done - 1 :])
        return everyone if success is None else everyone[~success]

    def _planned(self, past: Segment, rows: Tensor) -> tuple[Plan, Plan]:
        """The next plan of some instances, and the same with the return that fresh samples give."""
        task, start, everyone = self.task, self.start, len(rows) == len(self.task)
        if not everyone:
            task, past = task.take(rows.tolist()), Segment(*(part[rows] for part in past))
            start = start[:, rows] if isinstance(start, Tensor) else len(rows)
        reward = task.reward
        if self.ahead >= self.task.horizon:
            so_far = Segment(*(part[:, part.shape[1] - self.done :] for part in past))
            reward = _whole_episode(reward, so_far)
        if self.proposal is not None:
            begun = self._proposed(task, past)
            start = torch.cat([start, begun]) if isinstance(start, Tensor) else begun
        predict, fresh = self._predictors(task, past)
        plan, self.plan = self.plan or self.planner(predict, reward, self.space, start), None
        self._require_whole(plan)
        return plan, reevaluate(plan, fresh, reward)

    def _proposed(self, task: Task, past: Segment) -> Tensor:
        """Parameters (1, B, T, du) of the actions that are proposed."""
        assert self.proposal is not None
        steps = min(self.ahead, self.task.horizon - self.done)
        actions = as_tensor(
            "what proposal gave",
            self.proposal(task, past, steps),
            (len(task), steps, task.action_dim),
        )
        return actions.clamp(-0.999, 0.999).atanh()[None]

    def _require_whole(self, plan: Plan) -> None:
        require_type("what the planner gave", plan, Plan, "a Plan, as of tsmlib.cem")
        left = self.task.horizon - self.done
        if plan.actions.shape[1] != min(self.ahead, left):
            raise ValueError(
                f"space gives plans of {plan.actions.shape[1]} steps, but {left} of the "
                f"{self.task.horizon} steps of task {self.task.name!r} are left; give a space of "
                "the whole episode, task.horizon steps, or of lookahead steps"
            )

    def _predictors(self, task: Task, past: Segment) -> tuple[Predictor, Predictor]:
        """What candidates are judged by, and what predicts the return of the finished plan."""
        if self.model is None:
            done = past.actions[:, past.actions.shape[1] - self.done :]
            simulator = simulator_predictor(task, past.states[:, -1].numpy(), done=done)
            return simulator, simulator
        recent, seed = past.last(as_dynamics(self.model).past_len), self.seed + 2 * self.done
        fresh = fresh_predictor(self.model, recent, seed=seed + 1)
        return self.judge(self.model, recent, seed=seed), fresh


def _whole_episode(reward: Reward, so_far: Segment) -> Reward:
    """``reward`` of an episode that began with ``so_far`` (B, t, .), as a function of its rest.

    The first step of the rest is given the return executed before, so that returns are those of the
    whole episode.
    """

    def total(states: Tensor, actions: Tensor) -> Tensor:
        done = so_far.states.shape[1]
        before = (
            part.expand(*rest.shape[:-2], -1, -1)
            for part, rest in zip(so_far, (states, actions), strict=True)
        )
        whole = (torch.cat(pair, -2) for pair in zip(before, (states, actions), strict=True))
        per_step = rewarded(reward, *whole)
        executed = per_step[..., :done].sum(-1, keepdim=True)
        return torch.cat([per_step[..., done : done + 1] + executed, per_step[..., done + 1 :]], -1)

    return total
