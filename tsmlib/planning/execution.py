"""Execution of plans in the true simulator: predicted and executed return (section 5.3.2).

Open loop as in the paper (``execute``), or planning again every few steps from what the arm really
did (``mpc``).

Letters in shapes: B targets, T horizon, L past length, dx, du size of state and action.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.checks import (
    MOST,
    as_tensor,
    described,
    require_count,
    require_type,
)
from tsmlib.collection import Controller, collect, open_loop
from tsmlib.envs.stepping import Arms, Simulation, make_simulation
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.envs.wrappers import ImperfectArms
from tsmlib.planning.base import Plan
from tsmlib.planning.tasks import Task
from tsmlib.rewards import rewarded
from tsmlib.trajectory import Trajectories, real_steps

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
    require_task(task)
    past_len = require_count("past_len", past_len, most=MOST)
    if isinstance(plan, Plan) or not callable(plan):
        actions = open_loop_actions(task, plan)
        seen, run = run_task(task, open_loop(actions), task.horizon)
    elif isinstance(plan, nn.Module | type) or hasattr(plan, "begin"):
        raise TypeError(
            f"plan is {described(plan)}; expected a Plan, actions or a controller. A policy acts "
            "by tsmlib.policies.networks.controller(policy, task.target), a model by a plan"
        )
    else:
        seen, run = run_task(task, plan, task.horizon, past_len)
        actions = whole_actions(seen, task.horizon)
    return measured(task, run, seen, actions, plan if isinstance(plan, Plan) else None)


def require_task(task: object) -> None:
    hint = "a Task, such as tsmlib.load_task(env) or tsmlib.Task.from_env(env, ...)"
    require_type("task", task, Task, hint)


def open_loop_actions(task: Task, plan: object) -> Tensor:
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


def run_task(
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


def whole_actions(seen: Trajectories, horizon: int) -> Tensor:
    """The actions (B, T, du) of episodes that may all have ended before: zeros from there on."""
    return torch.from_numpy(seen.padded(horizon)[1])


def measured(
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
