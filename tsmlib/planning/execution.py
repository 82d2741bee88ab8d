"""A task posed, planned for and executed: what a plan promised and what the arm then did (section 5.3.2, figure 6).

Open loop as in the paper (``execute``), or planning again every few steps from what the arm really did (``mpc``).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib import rewards
from tsmlib.collection import Controller, collect, open_loop
from tsmlib.envs.wrappers import ImperfectArms
from tsmlib.models.base import DynamicsModel
from tsmlib.planning.base import Plan, Planner, SearchSpace
from tsmlib.planning.planners import reevaluate
from tsmlib.planning.predictors import model_predictor, simulator_predictor
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment

SENSORS = 5  # seed of the sensor noise of every trial, so that trials can be repeated


@dataclass(frozen=True)
class Trial:
    """Actions executed in the true simulator.

    actions (B, T, du); states (B, T + 1, dx) from the start on; true (B,): undiscounted return executed;
    final_distance (B,): metres; plan: where the actions came from, with the predicted return, if from a plan;
    observed (B, T + 1, dx): what the sensors said, where they are noisy.
    """

    actions: Tensor
    states: Tensor
    executed_return: Tensor
    final_distance: Tensor
    plan: Plan | None = None
    observed: Tensor | None = None

    @property
    def gap(self) -> Tensor:
        """Exploitation gap (B,): predicted minus true return."""
        if self.plan is None:
            raise ValueError("these actions were not planned, so nothing was predicted for them")
        return self.plan.predicted_return - self.executed_return


def execute(task: Task, plan: Plan | Tensor | Controller) -> Trial:
    """Run a plan, or plain actions (B, T, du), open loop from the task's starts; or a controller, a policy say.

    A controller sees what the sensors say, noise included (drawn from one fixed seed); the trial holds true states.
    """
    actions = plan.actions if isinstance(plan, Plan) else plan
    env = gymnasium.make_vec(task.env, num_envs=len(task))
    if isinstance(actions, Tensor):
        seen = collect(env, open_loop(actions), horizon=actions.shape[1], seed=SENSORS, states=task.start)
    else:
        seen = collect(env, actions, horizon=task.horizon, seed=SENSORS, states=task.start)
        actions = torch.from_numpy(seen.actions)
    env.close()
    return _measured(task, env, seen.states, actions, plan if isinstance(plan, Plan) else None)


def mpc(
    task: Task,
    model: DynamicsModel | None,
    space: SearchSpace,
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
            predict = judge = simulator_predictor(task.env, recent.states[:, -1].numpy())
        else:
            predict = model_predictor(model, recent, samples=samples, seed=seed + 2 * done)
            judge = model_predictor(model, recent, samples=32, seed=seed + 2 * done + 1)
        made = plan if plan is not None and not done else planner(predict, total, space, start)
        promised = reevaluate(made, judge, total)
        promises.append(promised.predicted_return)
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
        actions=actions, parameters=actions, states=torch.cat(dreamt, 2), predicted_return=promises[0],
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
    if isinstance(env, ImperfectArms) and env.sigma:
        states = torch.from_numpy(env.truth).float()
    return Trial(
        actions=actions,
        states=states,
        executed_return=rewarded(task.reward, states[:, 1:], actions).sum(-1),
        final_distance=rewards.final_distance(states, task.target, task.position),
        plan=plan,
        observed=None if states is observed else observed,
    )
