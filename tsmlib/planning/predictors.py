"""Predictors: candidate actions to states, through a model or through the true simulator.

Letters in shapes: C candidates, B targets, S model samples, T horizon, L past length.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import MOST, as_tensor, described, require_count, require_seed
from tsmlib.collection import collect, open_loop
from tsmlib.envs.spec import EnvSpec, is_arm
from tsmlib.envs.stepping import Stepping, UnsupportedEnvironment, copies, make_simulation
from tsmlib.models.base import Model, as_dynamics, members, rollout
from tsmlib.planning.base import Predictor
from tsmlib.planning.tasks import Task
from tsmlib.sampling import Noise, NoNoise, SeparateNoise, SharedNoise
from tsmlib.trajectory import Robot, Segment

FRESH = 32  # samples behind a predicted return that is reported
JUDGING = 8  # samples beside the mode by which a candidate is judged


@dataclass(frozen=True)
class ModelPredictor:
    """Predict by rolling out a model: ``draws`` rollouts of every candidate, or its mode.

    Attributes:
        model: of segments of steps.
        past: what was observed, states (B, L, dx) and actions (B, L, du).
        draws: S, rollouts of every candidate.
        noise: makes what each call draws from; None for the mode.
    """

    model: Model
    past: Segment
    draws: int = 1
    noise: Callable[[], Noise] | None = None

    @property
    def start(self) -> Tensor:
        """The states (B, dx) that predictions begin in."""
        return self.past.states[:, -1]

    @property
    def robot(self) -> Robot | None:
        """That the model is of, where it knows."""
        return getattr(self.model, "robot", None)

    def __repr__(self) -> str:
        what = f"{self.draws} rollouts" if self.noise else "the mode"
        n = len(self.past.states)
        return f"ModelPredictor({what} of {type(self.model).__name__}, {n} targets)"

    def __call__(self, actions: Tensor) -> Tensor:
        """Actions (C, B, T, du) -> states (S, C, B, T, dx)."""
        n, n_targets, _, du = actions.shape
        if du != self.past.actions.shape[2]:
            raise ValueError(
                f"actions have {du} dimensions, those of the past {self.past.actions.shape[2]}; "
                "give the search space the size of this robot's actions: "
                "DirectActions(task.horizon, task.action_dim, rms=...)"
            )
        _require_targets(n_targets, len(self.past.states), "the past")
        rows = actions[:, None].expand(-1, self.draws, -1, -1, -1).flatten(0, 2)  # (C S B, T, du)
        pasts = Segment(*(part.repeat(n * self.draws, 1, 1) for part in self.past))
        noise = self.noise() if self.noise else None
        states = rollout(self.model, pasts, rows, generator=noise)
        return states.unflatten(0, (n, self.draws, n_targets)).transpose(0, 1)


@dataclass(frozen=True)
class EnsemblePredictor:
    """Predict by several predictors: the modes of an ensemble's members, or a mode and samples.

    Attributes:
        each: by themselves, the first S = 1, by which ``cem`` screens.
        together: all at once, where one rollout can.
    """

    each: tuple[Predictor, ...]
    together: Predictor | None = None

    @property
    def start(self) -> Tensor | None:
        """The states (B, dx) that predictions begin in, where they are known."""
        return getattr(self.each[0], "start", None)

    @property
    def robot(self) -> Robot | None:
        """That the models are of, where they know."""
        return getattr(self.each[0], "robot", None)

    def __repr__(self) -> str:
        return f"EnsemblePredictor({', '.join(map(repr, self.each))})"

    def __call__(self, actions: Tensor) -> Tensor:
        """Actions (C, B, T, du) -> states (S, C, B, T, dx)."""
        if self.together:
            return self.together(actions)
        return torch.cat([predict(actions) for predict in self.each])


@dataclass(frozen=True)
class SimulatorPredictor:
    """Predict by executing in the true simulator, S = 1.

    Attributes:
        start: the states (B, dx) that predictions begin in.
        outcomes: actions (C, B, T, du) -> states (C, B, T, dx).
    """

    start: Tensor
    outcomes: Callable[[Tensor], Tensor]

    def __repr__(self) -> str:
        return f"SimulatorPredictor({len(self.start)} targets)"

    def __call__(self, actions: Tensor) -> Tensor:
        """Actions (C, B, T, du) -> states (1, C, B, T, dx)."""
        _require_targets(actions.shape[1], len(self.start), "the simulator")
        return self.outcomes(actions)[None]


def _require_targets(asked: int, known: int, where: str) -> None:
    if asked != known:
        raise ValueError(
            f"actions for {asked} targets, but {where} has {known}; expected one start for each: "
            f"plan for {known} targets, or take as many, task.take({asked})"
        )


def model_predictor(model: Model, past: Segment, *, samples: int = 0, seed: int = 0) -> Predictor:
    """Predict by rolling out a model: its mode, or samples of it.

    Args:
        model: of segments or of one step.
        past: what was observed, states (B, L, dx) and actions (B, L, du), L at least
            ``model.past_len``; ``task.past(model.past_len)`` at the start of an episode.
        samples: 0 rolls out the mode (z = 0) of every candidate, S = 1; of an ensemble the mode of
            each member. n draws n samples of each, with the same noise for every candidate and
            call.
        seed: of the noise, 0 or above.

    Returns:
        The predictor, of actions (C, B, T, du).

    Raises:
        TypeError: the model cannot predict, or the past is no Segment.
        ValueError: samples of a deterministic model, or a past that does not fit.
    """
    dynamics = as_dynamics(model)
    past = _checked_past(model, past)
    samples = require_count("samples", samples, least=0, most=MOST)
    seed = require_seed("seed", seed)
    if samples and not dynamics.stochastic:
        raise ValueError(
            f"samples is {samples}, but {type(model).__name__} is deterministic: its one rollout "
            "is the mode, samples=0"
        )
    if samples:

        def common() -> Noise:
            return SharedNoise(torch.Generator().manual_seed(seed), samples * len(past.states))

        return ModelPredictor(model, past, samples, common)
    if (n := members(model)) > 1:
        alone = (partial(NoNoise, sys.maxsize, first=k) for k in range(n))
        together = ModelPredictor(model, past, n, partial(NoNoise, len(past.states)))
        each = tuple(ModelPredictor(model, past, 1, noise) for noise in alone)
        return EnsemblePredictor(each, together)
    return ModelPredictor(model, past)


def expected_predictor(
    model: Model, past: Segment, *, samples: int = JUDGING, seed: int = 0
) -> Predictor:
    """Predict for an expectation over the model's futures (Eqs. 2 and 3): its mode and samples.

    An ``EnsemblePredictor`` whose first part is the mode, so that ``cem(screened=0.25)`` sorts the
    candidates by the mode and judges the best quarter by the mean over all. A deterministic model
    has its one rollout, an ensemble the modes of its members.

    Args:
        model: of segments or of one step.
        past: states (B, L, dx) and actions (B, L, du), as of ``model_predictor``.
        samples: beside the mode, at least 1; with the same noise for every candidate and call.
        seed: of the noise. ``fresh_predictor`` needs a seed that is none of ``samples * seed`` and
            the ``samples - 1`` after it.

    Returns:
        The predictor, of actions (C, B, T, du).

    Raises:
        ValueError: fewer than one sample; the mode alone is ``model_predictor(model, past)``.
    """
    if not require_count("samples", samples, least=0, most=MOST):
        raise ValueError(
            "samples is 0; expected at least 1. The mode alone is model_predictor(model, past)"
        )
    seed = require_seed("seed", seed)
    mode = model_predictor(model, past)
    if not as_dynamics(model).stochastic or not isinstance(mode, ModelPredictor):
        return mode

    def common() -> Noise:
        seeds = range(samples * seed, samples * (seed + 1))
        each = SeparateNoise(tuple(torch.Generator().manual_seed(one) for one in seeds))
        return SharedNoise(each, samples * len(mode.past.states))

    return EnsemblePredictor((mode, ModelPredictor(model, mode.past, samples, common)))


def fresh_predictor(model: Model, past: Segment, *, seed: int, samples: int = FRESH) -> Predictor:
    """Predict the return of a finished plan by samples that had no part in choosing it.

    Args:
        model: of segments or of one step; a deterministic one has no samples, but its one rollout.
        past: states (B, L, dx) and actions (B, L, du), as of ``model_predictor``.
        seed: of the samples, another than the planner's.
        samples: of every target, at least 1.

    Returns:
        The predictor, for ``reevaluate``.
    """
    samples = require_count("samples", samples, most=MOST)
    stochastic = as_dynamics(model).stochastic
    return model_predictor(model, past, samples=samples if stochastic else 0, seed=seed)


def _checked_past(model: Model, past: object) -> Segment:
    """The past as tensors; an error where it is none, or shorter than the model needs."""
    if not isinstance(past, Segment):
        raise TypeError(
            f"past is {described(past)}; expected tsmlib.Segment(states, actions), such as "
            "task.past(model.past_len)"
        )
    states, actions = past
    if not (isinstance(states, Tensor) and states.dtype == torch.float64):  # of derivatives
        states = as_tensor("past.states", states, ("B", "L", "dx"))
        actions = as_tensor("past.actions", actions, (*states.shape[:2], "du"))
    needed = as_dynamics(model).past_len
    if states.shape[1] < needed or not len(states):
        raise ValueError(
            f"past holds {states.shape[1]} steps of {len(states)} targets; expected at least "
            f"{needed} steps for {type(model).__name__}, such as task.past({needed})"
        )
    return Segment(states, actions)


def simulator_predictor(
    env: str | Task, start: np.ndarray | None = None, *, done: Tensor | None = None
) -> Predictor:
    """Predict by executing in the true simulator, S = 1. Not differentiable.

    In MuJoCo what follows is what would have followed, up to rounding; in pymunk, contacts that
    last forget the force with which they press. A foreign environment plays each candidate from the
    reset on. Of an episode that ended the last state repeats; ``rewards.until`` says what counts
    then.

    Args:
        env: a task, whose starts are predicted from; or the id of an arm.
        start: (B, dx), true states of an arm to predict from; without, the task's.
        done: (B, t, du), actions of the task that were executed before.

    Returns:
        The predictor, of actions (C, B, T, du).

    Raises:
        UnsupportedEnvironment: the same seed and actions do not repeat an episode, or an arm has
            noise or delay.
        ValueError: an id without ``start``.
    """
    task = env if isinstance(env, Task) else None
    if task is None and not isinstance(env, str):
        raise TypeError(f"env is {described(env)}; expected a Task, or the id of an arm")
    if done is not None:
        if task is None:
            raise ValueError("done is of a task, but env is an id; give the states to go on from")
        done = as_tensor("done", done, (len(task), "t", task.action_dim))
    if task is not None and task.seeds:
        return _of_seeds(task, done)
    name = task.env if task is not None else str(env)
    pusht = name.startswith("tsm/PushT-")
    if is_arm(name) and name != (arm := EnvSpec.parse(name).arm.id):
        raise UnsupportedEnvironment(
            f"{name} hides its states behind noisy sensors or delays actions, so what would follow "
            f"is no function of what is seen; the true simulator of {arm} can be asked"
        )
    if start is None and task is not None:
        start = task.start if done is None or not done.shape[1] else _reached(task, done)
    if start is None:
        raise ValueError(
            f"candidates in {name} have no common start; give start (B, dx), or a task"
        )
    begin = np.asarray(start)  # in full precision
    checked = as_tensor("start", begin, ("B", "dx"))
    if pusht and task is not None and done is not None:
        return SimulatorPredictor(checked, partial(_replayed, task, done))
    make = cache(partial(make_simulation, name))

    def outcomes(actions: Tensor) -> Tensor:
        n, n_targets, horizon, _ = actions.shape
        states, torques = np.tile(begin, (n, 1)), open_loop(actions.flatten(0, 1))
        seen = collect(make(n * n_targets), torques, horizon=horizon, states=states)
        return torch.from_numpy(seen.states[:, 1:]).unflatten(0, (n, n_targets))

    return SimulatorPredictor(checked, outcomes)


def _replayed(task: Task, done: Tensor, actions: Tensor) -> Tensor:
    """What follows ``done`` (B, t, du) by executing all of it: contacts hold what no state says."""
    n, n_targets, horizon, _ = actions.shape
    whole = torch.cat([done.expand(n, -1, -1, -1), actions], dim=2).flatten(0, 1)
    with closing(make_simulation(task.env, n * n_targets)) as run:
        states = np.tile(task.start, (n, 1))
        seen = collect(run, open_loop(whole), horizon=whole.shape[1], states=states)
    return torch.from_numpy(seen.states[:, -horizon:]).unflatten(0, (n, n_targets))


def _of_seeds(task: Task, done: Tensor | None) -> SimulatorPredictor:
    """Episodes that begin with a task's seeds and go on after ``done`` (B, t, du).

    An observation is not all of a state: each candidate is played from the reset on.
    """
    before = np.zeros((len(task), 0, task.action_dim)) if done is None else done.numpy()

    def made() -> Stepping:
        return Stepping(copies(task.env, len(task)), env_id=task.env)

    def played(run: Stepping, actions: np.ndarray) -> np.ndarray:
        run.reset(seed=task.seeds)
        run.rollout(before)
        return run.rollout(actions)

    run, checked = made(), False
    played(run, before[:, :0])
    start = torch.from_numpy(run.last).float()

    def outcomes(actions: Tensor) -> Tensor:
        nonlocal checked
        states = np.stack([played(run, candidate) for candidate in actions.numpy()])
        if not checked:
            with closing(made()) as other:
                for one in (other, run):
                    _require_repeated(run, states[-1], played(one, actions[-1].numpy()))
        checked = True
        return torch.from_numpy(states).float()

    return SimulatorPredictor(start, outcomes)


def _require_repeated(run: Stepping, first: np.ndarray, again: np.ndarray) -> None:
    """UnsupportedEnvironment where an episode (B, T, dx) comes out otherwise when played again."""
    for i, t, d in np.argwhere(first != again)[:1]:
        raise UnsupportedEnvironment(
            f"{run.id} has no oracle: the same seed and actions do not repeat it, {run.names[d]} "
            f"of episode {i} after {t + 1} steps is {first[i, t, d]:g} and then "
            f"{again[i, t, d]:g}. Plan through a model instead, tsmlib.model_predictor; or let it "
            "draw from self.np_random, and begin anew at every reset"
        )


def _reached(task: Task, done: Tensor) -> np.ndarray:
    """The states (B, dx) of an arm after ``done`` (B, t, du) from the task's starts."""
    with closing(make_simulation(task.env, len(task))) as run:
        return collect(run, open_loop(done), horizon=done.shape[1], states=task.start).states[:, -1]
