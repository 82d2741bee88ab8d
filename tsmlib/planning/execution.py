"""Execution of plans in the true simulator: predicted and executed return (section 5.3.2, figure 6).

Open loop as in the paper (``execute``), or planning again every few steps from what the arm really did (``mpc``).
"""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm.auto import tqdm

from tsmlib.collection import Controller, collect, open_loop
from tsmlib.envs.stepping import Arms, Simulation, make_simulation
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.envs.wrappers import ImperfectArms
from tsmlib.models.base import Model, as_dynamics
from tsmlib.planning.base import Judge, Plan, Planner, Predictor, SearchSpace
from tsmlib.planning.planners import reevaluate
from tsmlib.planning.predictors import fresh_predictor, model_predictor, simulator_predictor
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment, Trajectories, real_steps

T = TypeVar("T")
SENSORS = 5  # seed of the sensor noise of every trial, so that trials can be repeated


@dataclass(frozen=True, repr=False)
class Trial:
    """Actions executed in the true simulator.

    actions (B, T, du), of a controller zero after the end of an episode; states (B, T + 1, dx) from the start on;
    executed_return (B,): undiscounted; final_distance (B,): metres, or as the task's measure of success has it, NaN
    where it has none; plan: where the actions came from, with the predicted return, if from a plan; observed
    (B, T + 1, dx): what the sensors said, where they are noisy.

    Behind delayed actions ``actions`` are those that were given. The executed return charges those that arrived, a
    predicted return those given, so that the gap holds the penalty of the last tau torques.

    success (B,): by the task's measure; None without one. lengths: steps of each episode, where some ended early;
    returns are of those steps. own_return (B,): by the environment's own reward, NaN where it keeps none. seen: the
    episodes as they were collected, with what the sensors said and how each of them ended.
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
        found = f"{len(self.actions)} episodes, {max(self.steps)} steps"
        return f"Trial({found}, mean executed return {float(self.executed_return.mean()):.4g})"

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
    """Run a plan, or plain actions (B, T, du), open loop from the task's starts; or a controller, a policy say.

    Actions beyond [-1, 1] are clipped, and the trial holds and charges them as they were executed.
    past_len: steps of past that a controller sees; those before the episode are x_0 repeated and no action.
    A controller sees what the sensors say, noise included (drawn from one fixed seed); the trial holds true states.
    """
    actions = plan.actions if isinstance(plan, Plan) else plan
    if isinstance(actions, Tensor):
        actions = actions.clamp(-1, 1)
        seen, run = _run(task, open_loop(actions), actions.shape[1])
    else:
        seen, run = _run(task, actions, task.horizon, past_len)
        actions = _whole_actions(seen, task.horizon)
    return _measured(task, run, seen, actions, plan if isinstance(plan, Plan) else None)


@dataclass(frozen=True)
class Stable(Generic[T]):
    """The result of a run on those instances of a task whose simulation stayed stable.

    task: these instances; kept: their indices among all. found: what ``run`` gave; None where no instance is left, and
    ``task`` is then the last that was lost. lost: how many others there were. discarded_steps: executed before an
    instance was lost, after which the others begin anew.
    """

    task: Task
    kept: list[int]
    found: T | None
    lost: int
    discarded_steps: int


def without_unstable(task: Task, run: Callable[[Task, list[int]], T]) -> Stable[T]:
    """``run(task, indices)``, run again without each instance whose simulation becomes unstable, until none does."""
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
        return collect(
            run, controller, horizon=horizon, past_len=past_len, seed=seed, states=states
        ), run


def mpc(
    task: Task,
    model: Model | None,
    space: SearchSpace,
    planner: Planner,
    *,
    every: int = 10,  # steps executed before the next plan
    plan: Plan | None = None,
    judge: Judge = model_predictor,
    seed: int = 0,
    progress: str = "",
) -> Trial:
    """Closed loop (model predictive control): plan to the end of the episode, execute ``every`` steps, observe, repeat.

    The horizon shrinks: T, T - every, T - 2 every, ... steps. Each plan starts from what is left of the one before it
    (``SearchSpace.after``), and is never worse than that by its own prediction.

    model: what plans are made through, from the true observed past; None is the true simulator. space: of the whole
    episode. planner: with the budget of each plan, ``partial(cem, candidates=96, iterations=4)`` for example. plan: the
    first one, if it is already there, so that closed and open loop begin alike.
    judge: what candidates are judged by, by default the model's mode. The predicted return of each plan comes from
    samples that had no part in choosing it (``fresh_predictor``).

    Of the trial's plan, ``predicted_return`` is the first plan's, ``curve`` (plans, B) every plan's for the whole
    episode, the return executed until then included, and ``states`` (1, B, T, dx) the part of every predicted rollout
    that was executed; where all episodes ended before, the last of them repeats.
    """
    if every < 1:
        raise ValueError(f"every is {every}, expected a positive number of steps")
    began, horizon, past_len = (
        time.perf_counter(),
        task.horizon,
        1 if model is None else as_dynamics(model).past_len,
    )
    planning = _Replanning(
        task, model, planner, every, judge, seed, space, start=len(task), plan=plan
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
    )
    return _measured(task, run, seen, actions, made)


@dataclass
class _Replanning:
    """The controller that plans to the end of the episode each time it is asked, and keeps what was predicted."""

    task: Task
    model: Model | None
    planner: Planner
    every: int
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
        reward = _whole_episode(
            self.task.reward, Segment(*(part[:, part.shape[1] - self.done :] for part in past))
        )
        predict, fresh = self._predictors(past)
        plan, self.plan = self.plan or self.planner(predict, reward, self.space, self.start), None
        judged = reevaluate(plan, fresh, reward)
        self.returns.append(judged.predicted_return)
        self.rollouts.append(judged.states[:1, :, : self.every])
        steps = min(self.every, self.task.horizon - self.done)
        self.done += steps
        if self.done < self.task.horizon:
            self.space, left = self.space.after(plan.parameters, steps)
            self.start = left[None]
        return plan.actions[:, :steps]

    def _predictors(self, past: Segment) -> tuple[Predictor, Predictor]:
        """What candidates are judged by, and what the return of the finished plan is predicted with."""
        if self.model is None:
            simulator = simulator_predictor(
                self.task,
                past.states[:, -1].numpy(),
                done=past.actions[:, past.actions.shape[1] - self.done :],
            )
            return simulator, simulator
        recent, seed = past.last(as_dynamics(self.model).past_len), self.seed + 2 * self.done
        return self.judge(self.model, recent, seed=seed), fresh_predictor(
            self.model, recent, seed=seed + 1
        )


def _whole_episode(reward: Reward, so_far: Segment) -> Reward:
    """``reward`` of an episode that began with ``so_far`` (B, t, .), as a function of the rest of it.

    The first step of the rest is given the return executed before, so that returns are those of the whole episode.
    """

    def total(states: Tensor, actions: Tensor) -> Tensor:
        done = so_far.states.shape[1]
        rest = (states, actions)
        before = (
            part.expand(*new.shape[:-2], -1, -1) for part, new in zip(so_far, rest, strict=True)
        )
        per_step = rewarded(
            reward, *(torch.cat(pair, -2) for pair in zip(before, rest, strict=True))
        )
        executed = per_step[..., :done].sum(-1, keepdim=True)
        return torch.cat([per_step[..., done : done + 1] + executed, per_step[..., done + 1 :]], -1)

    return total


def _whole_actions(seen: Trajectories, horizon: int) -> Tensor:
    """The actions (B, T, du) of episodes that may all have ended before: zeros from there on."""
    return F.pad(torch.from_numpy(seen.actions), (0, 0, 0, horizon - seen.horizon))


def _measured(
    task: Task, run: Simulation, seen: Trajectories, actions: Tensor, plan: Plan | None
) -> Trial:
    """The trial that just ended in ``run``, of which the sensors said ``seen``; its last state repeats up to T."""
    missing = actions.shape[1] - seen.horizon
    states = observed = torch.from_numpy(
        np.pad(seen.states, ((0, 0), (0, missing), (0, 0)), mode="edge")
    )
    arms = run.env if isinstance(run, Arms) else None
    if isinstance(arms, ImperfectArms) and arms.sigma:
        states = torch.from_numpy(arms.truth).float()
    late = arms.tau if isinstance(arms, ImperfectArms) else 0
    arrived = F.pad(actions, (0, 0, late, 0))[:, : actions.shape[1]]
    per_step = rewarded(task.reward, states[:, 1:], arrived)
    if seen.lengths or missing:
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
        lengths=seen.lengths or ((seen.horizon,) * len(seen) if missing else ()),
        own_return=torch.from_numpy(run.returns).float(),
        seen=seen,
    )
