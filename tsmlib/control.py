"""A task posed, planned for and executed: what a plan promised and what the arm then did (section 5.3.2, figure 6).

Open loop as in the paper (``execute``), or planning again every few steps from what the arm really did (``replan``).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor
from tqdm.auto import tqdm

import tsmlib.envs  # noqa: F401 - registers the environments
from tsmlib import rewards
from tsmlib.collect import Controller, collect, once, smooth_torques
from tsmlib.dynamics import DynamicsModel
from tsmlib.envs.base import BLOCK_RADIUS, LINK_LENGTHS, WALL
from tsmlib.envs.wrappers import ImperfectArms
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment, initial_past
from tsmlib.trajopt import Plan, Planner, Space, reassess, through_model, through_simulator

TOLERANCE = 0.03  # metres: a trial that ends within it is a success
SENSORS = 5  # seed of the sensor noise of every trial, so that trials can be repeated


@dataclass(frozen=True)
class Task:
    """B instances of one task in one environment. start (B, dx), target (B, 2) in metres, horizon in steps.

    own: a reward of one's own, for a task of any other name; see ``with_reward``. ValueError where a target is out of
    reach, or the reward is not one number per step; FloatingPointError where it is NaN.
    """

    name: str  # reach or push; with a reward of one's own, any word
    env: str
    start: np.ndarray
    target: Tensor
    horizon: int = 50
    own: Reward | None = None

    def __post_init__(self) -> None:
        if self.own is None and self.name not in ("reach", "push"):
            raise ValueError(
                f"task is {self.name!r}, expected 'reach' or 'push'; any other task needs a reward of its own"
            )
        if self.name == "push" and self.start.shape[1] < 10:
            raise ValueError(f"there is nothing to push in {self.env}; its task is 'reach'")
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}, expected a positive number of steps")
        if self.target.shape != (len(self), 2):
            raise ValueError(f"target is {tuple(self.target.shape)}, expected ({len(self)}, 2): one per start")
        self._check_reach()
        if self.own is not None:  # standing still, in the shape in which planners ask
            states = torch.from_numpy(self.start).float()[:, None].expand(2, 1, -1, self.horizon, -1)
            found = rewarded(self.own, states, states.new_zeros(1, len(self), self.horizon, 2))
            if not torch.isfinite(found).all():
                raise ValueError(f"the reward of task {self.name!r} is infinite for an arm that stands still")

    def __len__(self) -> int:
        return len(self.start)

    @property
    def reward(self) -> Reward:
        """The task's reward, one target per instance."""
        if self.own is not None:
            return self.own
        return (rewards.reach if self.name == "reach" else rewards.push)(self.target)

    @property
    def position(self) -> slice:
        """What has to arrive: the object if the task is to push, else the fingertip."""
        return rewards.BLOCK if self.name == "push" else rewards.TIP

    def with_reward(
        self, name: str, reward: Reward, *, target: Tensor | None = None, horizon: int | None = None
    ) -> Task:
        """A task of one's own from these starts.

        reward: any torch function of states (..., B, T, dx) and actions (..., B, T, du) that gives one number per
        step, (..., B, T), differentiable if it is to be planned for with Adam. It always sees the whole episode, so
        that it may depend on the time. target (2,) or (B, 2): where it should end, for final_distance and pictures.
        """
        if target is not None:
            target = target.float().expand(len(self), 2)
        return Task(
            name, self.env, self.start, self.target if target is None else target, horizon or self.horizon, reward
        )

    def _check_reach(self) -> None:
        if self.position == rewards.TIP:
            within, what = self.target.norm(dim=1) <= sum(LINK_LENGTHS) + 1e-6, "fingertip"
            limit = f"{sum(LINK_LENGTHS):g} m from the shoulder"
        else:
            within, what = self.target.abs().amax(1) <= WALL - BLOCK_RADIUS + 1e-6, "object"
            limit = f"{WALL - BLOCK_RADIUS:g} m along x and y, where the walls are"
        if not within.all():
            i = int((~within).nonzero()[0])
            raise ValueError(
                f"target {i} at ({self.target[i, 0]:.3f}, {self.target[i, 1]:.3f}) m is out of reach: "
                f"the {what} gets as far as {limit}"
            )

    def past(self, past_len: int) -> Segment:
        """The past before the first step: x_0 repeated, zero actions."""
        return initial_past(torch.from_numpy(self.start).float(), past_len, 2)

    def take(self, n: int) -> Task:
        """The first ``n`` instances; ValueError if there are not as many."""
        if not 1 <= n <= len(self):
            raise ValueError(f"{n} targets of {self.env} asked for; choose a number from 1 to {len(self)}")
        return replace(self, start=self.start[:n], target=self.target[:n])

    def times(self, n: int) -> Task:
        """All instances n times over, for as many copies of a policy."""
        return replace(self, start=np.tile(self.start, (n, 1)), target=self.target.repeat(n, 1))


@dataclass(frozen=True)
class Trial:
    """Actions executed in the true simulator.

    actions (B, T, du); states (B, T + 1, dx) from the start on; true (B,): undiscounted return executed;
    final_distance (B,): metres; plan: where the actions came from, with the predicted return, if from a plan;
    observed (B, T + 1, dx): what the sensors said, where they are noisy.
    """

    actions: Tensor
    states: Tensor
    true: Tensor
    final_distance: Tensor
    plan: Plan | None = None
    observed: Tensor | None = None

    @property
    def gap(self) -> Tensor:
        """Exploitation gap (B,): predicted minus true return."""
        if self.plan is None:
            raise ValueError("these actions were not planned, so nothing was predicted for them")
        return self.plan.predicted - self.true


def execute(task: Task, plan: Plan | Tensor | Controller) -> Trial:
    """Run a plan, or plain actions (B, T, du), open loop from the task's starts; or a controller, a policy say.

    A controller sees what the sensors say, noise included (drawn from one fixed seed); the trial holds true states.
    """
    actions = plan.actions if isinstance(plan, Plan) else plan
    env = gymnasium.make_vec(task.env, num_envs=len(task))
    if isinstance(actions, Tensor):
        seen = collect(env, once(actions), horizon=actions.shape[1], seed=SENSORS, states=task.start)
    else:
        seen = collect(env, actions, horizon=task.horizon, seed=SENSORS, states=task.start)
        actions = torch.from_numpy(seen.actions)
    env.close()
    return _measured(task, env, seen.states, actions, plan if isinstance(plan, Plan) else None)


def replan(
    task: Task,
    model: DynamicsModel | None,
    space: Space,
    planner: Planner,
    *,
    every: int = 10,  # steps executed before the next plan
    plan: Plan | None = None,
    samples: int = 2,
    seed: int = 0,
    progress: str = "",
) -> Trial:
    """Closed loop (model predictive control): plan to the end of the episode, execute ``every`` steps, observe, repeat.

    model: what plans are made through, from the true observed past; None is the true simulator. space: of the whole
    episode. planner: for example ``partial(cem, iterations=4)``; from the second plan on it starts from what is left
    of the plan before. Over codes, plans begin with a new segment each time; where ``every`` is no multiple of H, what
    is left of a plan is encoded anew and only nearly the same. plan: the first one, if it is already there, so that
    closed and open loop begin alike. samples: of the model that a plan is made with; promises come from 32 others.

    Of the trial's plan, ``predicted`` is the first promise, ``curve`` (plans, B) every plan's promise for the whole
    episode, what was earned until then included, and ``states`` (1, B, T, dx) of every plan the part that was executed.
    """
    if every < 1:
        raise ValueError(f"every is {every}, expected a positive number of steps")
    began, horizon = time.perf_counter(), task.horizon
    past_len = 1 if model is None else model.past_len
    done = 0
    start: Tensor | int = len(task)
    dreamt: list[Tensor] = []
    promises: list[Tensor] = []
    bar = tqdm(total=-(-horizon // every), desc=progress, disable=not progress)

    def controller(past: Segment) -> Tensor:
        """``past`` holds the whole episode so far, with ``past_len`` steps before it."""
        nonlocal done, space, start
        so_far = Segment(*(part[:, part.shape[1] - done :] for part in past))
        total = _whole_episode(task.reward, so_far)
        recent = past.last(past_len)
        if model is None:
            predict = judge = through_simulator(task.env, recent.states[:, -1].numpy())
        else:
            predict = through_model(model, recent, samples=samples, seed=seed + 2 * done)
            judge = through_model(model, recent, samples=32, seed=seed + 2 * done + 1)
        made = plan if plan is not None and not done else planner(predict, total, space, start)
        promised = reassess(made, judge, total)
        promises.append(promised.predicted)
        dreamt.append(promised.states[:1, :, :every])
        steps = min(every, horizon - done)
        if done + steps < horizon:
            space, left = space.after(made.parameters, steps)
            start = left[None]
        done += steps
        bar.update()
        return made.actions[:, :steps]

    env = gymnasium.make_vec(task.env, num_envs=len(task))
    seen = collect(env, controller, horizon=horizon, past_len=horizon + past_len, seed=SENSORS, states=task.start)
    env.close()
    bar.close()
    actions = torch.from_numpy(seen.actions)
    made = Plan(
        actions=actions, parameters=actions, states=torch.cat(dreamt, 2), predicted=promises[0],
        curve=torch.stack(promises), seconds=time.perf_counter() - began,
    )  # fmt: skip
    return _measured(task, env, seen.states, actions, made)


def _whole_episode(reward: Reward, so_far: Segment) -> Reward:
    """``reward`` of an episode that began with ``so_far`` (B, t, .), as a function of the rest of it.

    The first step of the rest is given what was earned before, so that returns are those of the whole episode.
    """

    def total(states: Tensor, actions: Tensor) -> Tensor:
        done = so_far.states.shape[1]
        rest = (states, actions)
        before = (part.expand(*new.shape[:-2], -1, -1) for part, new in zip(so_far, rest, strict=True))
        per_step = rewarded(reward, *(torch.cat(pair, -2) for pair in zip(before, rest, strict=True)))
        earned = per_step[..., :done].sum(-1, keepdim=True)
        return torch.cat([per_step[..., done : done + 1] + earned, per_step[..., done + 1 :]], -1)

    return total


def _measured(task: Task, env: VectorEnv, seen: np.ndarray, actions: Tensor, plan: Plan | None) -> Trial:
    """The trial that just ended in ``env``, of which the sensors said ``seen`` (B, T + 1, dx)."""
    states = observed = torch.from_numpy(seen)
    if isinstance(env, ImperfectArms):
        states = torch.from_numpy(env.truth).float()
    return Trial(
        actions=actions,
        states=states,
        true=rewarded(task.reward, states[:, 1:], actions).sum(-1),
        final_distance=rewards.final_distance(states, task.target, task.position),
        plan=plan,
        observed=None if states is observed else observed,
    )


def zero_torques(task: Task) -> Tensor:
    """No torque at all: the floor below which a plan does harm. (B, T, du)."""
    return torch.zeros(len(task), task.horizon, 2)


def random_torques(task: Task, *, seed: int = 0) -> Tensor:
    """Torques like the training data's. (B, T, du)."""
    return smooth_torques(len(task), task.horizon, generator=torch.Generator().manual_seed(seed))


def sim_of(env: str) -> str:
    """The simulator behind an environment id, as the tables name it."""
    return "pymunk" if "Pymunk" in env else "mujoco"


def label(model: str, planner: str, prior: str) -> str:
    """A method in one line, as figures name it: ``tsm codes cem``, ``zero``."""
    return planner if model == "none" else f"{model} {prior} {planner}"
