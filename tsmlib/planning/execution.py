"""Execution of plans in the true simulator: predicted and executed return (section 5.3.2).

Open loop as in the paper (``execute``), or planning again every few steps from what the arm really
did (``mpc``).

Letters in shapes: B targets, T horizon, L past length, dx, du size of state and action.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm.auto import tqdm

from tsmlib.checks import (
    MOST,
    as_tensor,
    described,
    require_callable,
    require_count,
    require_seed,
    require_type,
)
from tsmlib.collection import Controller, collect, open_loop
from tsmlib.envs.stepping import Arms, Simulation, make_simulation
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.envs.wrappers import ImperfectArms
from tsmlib.models.base import Model, as_dynamics
from tsmlib.planning.base import Judge, Plan, Planner, Predictor, SearchSpace
from tsmlib.planning.planners import reevaluate
from tsmlib.planning.predictors import fresh_predictor, model_predictor, simulator_predictor
from tsmlib.planning.search import require_space
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment, Trajectories, real_steps

T = TypeVar("T")
SENSORS = 5  # seed of the sensor noise of every trial, so that trials can be repeated


@dataclass(frozen=True, repr=False)
class Trial:
    """Actions executed in the true simulator.

    Behind delayed actions ``actions`` are those that were given. The executed return charges those
    that arrived, a predicted return those given, so that the gap holds the penalty of the last tau.

    Attributes:
        actions: (B, T, du); of a controller zero after the end of an episode.
        states: (B, T + 1, dx), from the start on.
        executed_return: (B,), undiscounted, of the steps of each episode.
        final_distance: (B,), metres, or as the task's measure of success has it; NaN without one.
        plan: where the actions came from, with the predicted return, if from a plan.
        observed: (B, T + 1, dx), what the sensors said, where they are noisy.
        success: (B,) bool, by the task's measure; None without one.
        lengths: steps of each episode, where some ended early.
        own_return: (B,), by the environment's own reward, NaN where it keeps none.
        seen: the episodes as they were collected.
    """

    actions: Tensor
    states: Tensor
    executed_return: Tensor
    final_distance: Tensor
    plan: Plan | None = None
    observed: Tensor | None = None
    success: Tensor | None = None
    lengths: tuple[int, ...] = ()
    own_return: Tensor | None = None
    seen: Trajectories | None = None

    def __repr__(self) -> str:
        size = f"{len(self.actions)} episodes, {max(self.steps)} steps"
        solved = "" if self.success is None else f", {int(self.success.sum())} successes"
        return f"Trial({size}, mean executed return {self.executed_return.mean():.4g}{solved})"

    @property
    def steps(self) -> tuple[int, ...]:
        """Steps of each episode, whether any ended early or not."""
        return self.lengths or (self.actions.shape[1],) * len(self.actions)

    @property
    def gap(self) -> Tensor:
        """Exploitation gap (B,): predicted minus true return."""
        if self.plan is None:
            raise ValueError("these actions were not planned, so nothing was predicted for them")
        return self.plan.predicted_return - self.executed_return


def execute(task: Task, plan: Plan | Tensor | Controller, *, past_len: int = 10) -> Trial:
    """Run a plan, or plain actions, open loop from the task's starts; or a controller.

    Args:
        task: whose starts and reward are meant.
        plan: a plan from these starts; actions (B, T, du) in [-1, 1]; or a controller, a function
            of the past (B, L, .) that gives the next actions (B, K, du). A controller sees what the
            sensors say, noise included (drawn from one fixed seed); the trial holds true states.
        past_len: L, steps of past that a controller sees; before the episode they are x_0 repeated
            and no action.

    Returns:
        The trial.

    Raises:
        TypeError: ``plan`` is something else, such as a policy or a model.
        ValueError: actions of another shape, beyond [-1, 1], or planned from other starts; or an
            environment that begins elsewhere than its task.
        SimulationUnstable: a state that is not finite.
    """
    _require_task(task)
    past_len = require_count("past_len", past_len, most=MOST)
    if isinstance(plan, Plan) or not callable(plan):
        actions = _open_loop_actions(task, plan)
        seen, run = _run(task, open_loop(actions), task.horizon)
    elif isinstance(plan, nn.Module | type) or hasattr(plan, "begin"):
        raise TypeError(
            f"plan is {described(plan)}; expected a Plan, actions or a controller. A policy acts "
            "by tsmlib.policies.networks.controller(policy, task.target), a model by a plan"
        )
    else:
        seen, run = _run(task, plan, task.horizon, past_len)
        actions = _whole_actions(seen, task.horizon)
    return _measured(task, run, seen, actions, plan if isinstance(plan, Plan) else None)


def _require_task(task: object) -> None:
    hint = "a Task, such as tsmlib.load_task(env) or tsmlib.Task.from_env(env, ...)"
    require_type("task", task, Task, hint)


def _open_loop_actions(task: Task, plan: object) -> Tensor:
    """The actions (B, T, du) of a plan, or given as they are, checked against the task."""
    if isinstance(plan, Plan):
        task.require_robot(plan.robot, "the plan and the task")
        if plan.start is not None:
            task.require_start(plan.start, "the plan")
    name, given = ("plan.actions", plan.actions) if isinstance(plan, Plan) else ("actions", plan)
    sizes = (len(task), task.horizon, task.action_dim)
    actions = as_tensor(name, given, sizes)
    if (most := float(actions.abs().max())) > 1 + 1e-6:
        raise ValueError(
            f"{name} go up to {most:g}; expected them within [-1, 1], the bounds of the action "
            "space: divide by its bounds, or clip, actions.clamp(-1, 1)"
        )
    if not actions.any() and task.idle_actions().any():
        warnings.warn(
            f"{name} are zeros, the middle of the bounds of {task.env}; doing nothing there is "
            f"{task.idle_actions()[0, 0].tolist()}: task.idle_actions()",
            stacklevel=3,
        )
    return actions


@dataclass(frozen=True)
class Stable(Generic[T]):
    """The result of a run on those instances of a task whose simulation stayed stable.

    Attributes:
        task: these instances; where none is left, the last that was lost.
        kept: their indices among all.
        found: what the run gave; None where no instance is left.
        lost: how many others there were.
        discarded_steps: executed before an instance was lost, whereupon the others begin anew.
    """

    task: Task
    kept: list[int]
    found: T | None
    lost: int
    discarded_steps: int


def without_unstable(task: Task, run: Callable[[Task, list[int]], T]) -> Stable[T]:
    """Run instances of a task, again without each whose simulation becomes unstable.

    Args:
        task: of all instances.
        run: of a task and the indices of its instances among all.

    Returns:
        What the last run gave, and of which instances.
    """
    kept, discarded = list(range(len(task))), 0
    left = task
    while True:
        lost = len(task) - len(kept)
        try:
            return Stable(left, kept, run(left, kept), lost, discarded)
        except SimulationUnstable as fault:
            discarded += (fault.step + 1) * len(kept)
            kept = [k for i, k in enumerate(kept) if i != fault.episode]
            if not kept:
                return Stable(left, kept, None, lost + 1, discarded)
            left = task.take(kept)


def _run(
    task: Task, controller: Controller, horizon: int, past_len: int = 10
) -> tuple[Trajectories, Simulation]:
    """An episode from each of the task's starts, and the simulation that it ran in."""
    seed, states = (task.seeds, None) if task.begins_by_seed else (SENSORS, task.start)
    with closing(make_simulation(task.env, len(task))) as run:
        seen = collect(
            run, controller, horizon=horizon, past_len=past_len, seed=seed, states=states
        )
    if task.begins_by_seed:
        begun = torch.from_numpy(seen.flat_states[seen.offsets])
        task.require_start(begun, "the executed episode")
    return seen, run


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
    _require_task(task)
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
        _open_loop_actions(task, plan)
        plan = replace(plan, start=None)  # sensors may say another
    task.require_robot(getattr(model, "robot", None), "the model and the task")
    began, horizon = time.perf_counter(), task.horizon
    past_len = 1 if model is None else as_dynamics(model).past_len
    planning = _Replanning(
        task, model, planner, every, ahead, until_success, judge, seed, space, len(task), plan
    )
    with tqdm(total=-(-horizon // every), desc=progress, disable=not progress) as bar:

        def controller(past: Segment) -> Tensor:
            actions = planning(past)
            bar.update()
            return actions

        seen, run = _run(task, controller, horizon, past_len=horizon + past_len)
    actions, returns = _whole_actions(seen, horizon), torch.stack(planning.returns)
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
    return _measured(task, run, seen, actions, made)


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
        predict, fresh = self._predictors(task, past)
        plan, self.plan = self.plan or self.planner(predict, reward, self.space, start), None
        self._require_whole(plan)
        return plan, reevaluate(plan, fresh, reward)

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


def _whole_actions(seen: Trajectories, horizon: int) -> Tensor:
    """The actions (B, T, du) of episodes that may all have ended before: zeros from there on."""
    return torch.from_numpy(seen.padded(horizon)[1])


def _measured(
    task: Task, run: Simulation, seen: Trajectories, actions: Tensor, plan: Plan | None
) -> Trial:
    """The trial that just ended in ``run``; its last state repeats up to T."""
    early = min(seen.lengths) < actions.shape[1]
    states = observed = torch.from_numpy(seen.padded(actions.shape[1])[0])
    arms = run.env if isinstance(run, Arms) else None
    if isinstance(arms, ImperfectArms) and arms.sigma:
        states = torch.from_numpy(arms.truth).float()
    late = arms.tau if isinstance(arms, ImperfectArms) else 0
    arrived = F.pad(actions, (0, 0, late, 0))[:, : actions.shape[1]]
    per_step = rewarded(task.reward, states[:, 1:], arrived)
    if early:
        per_step = per_step * real_steps(seen.steps.tolist(), actions.shape[1])
    final_distance, success = task.judged(states)
    return Trial(
        actions=actions,
        states=states,
        executed_return=per_step.sum(-1),
        final_distance=final_distance,
        plan=plan,
        observed=None if states is observed else observed,
        success=success,
        lengths=seen.lengths if early else (),
        own_return=torch.from_numpy(run.returns).float(),
        seen=seen,
    )
