"""Predictors: candidate actions to states, through a model or through the true simulator."""

import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from tsmlib.collection import collect, open_loop
from tsmlib.envs.snapshots import Oracle
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.stepping import UnsupportedEnvironment, make_simulation
from tsmlib.models.base import Model, as_dynamics, members, rollout
from tsmlib.models.mixture import Mixture
from tsmlib.planning.base import Predictor
from tsmlib.planning.tasks import Task
from tsmlib.sampling import Noise, NoNoise, SeparateNoise, SharedNoise
from tsmlib.trajectory import Segment

FRESH = 32  # samples behind a predicted return that is reported
JUDGING = (
    8  # samples beside the mode, by which a candidate is judged (benchmarks/settings, section 3)
)


def model_predictor(model: Model, past: Segment, *, samples: int = 0, seed: int = 0) -> Predictor:
    """Predict by rolling out ``model`` from ``past`` (B, L, .): its mode, or samples of it.

    samples: 0 rolls out the mode (z = 0) of every candidate, S = 1, or of an ensemble the mode of each member, S of
    them, of a ``Mixture`` those of all its models; n draws n samples of each, S = n, with the same noise, a function of
    ``seed``, for every candidate and call.
    ValueError for samples of a deterministic model.
    """
    if samples < 0:
        raise ValueError(
            f"samples is {samples}, expected 0 (the mode) or a positive number of samples"
        )
    if samples and not as_dynamics(model).stochastic:
        raise ValueError(
            f"{samples} samples of {type(model).__name__} asked for, but it is deterministic: its one rollout is the "
            "mode, samples=0"
        )
    if not samples and isinstance(model, Mixture):
        judges = (model_predictor(each, past) for each in model.models)
        every = (
            [judge] if not isinstance(judge, EnsemblePredictor) else judge.each for judge in judges
        )
        return EnsemblePredictor(tuple(chain.from_iterable(every)))
    if not samples and members(model) > 1:
        n = members(model)
        alone = (partial(NoNoise, sys.maxsize, first=k) for k in range(n))
        together = partial(_predict, model, past, n, partial(NoNoise, len(past.states)))
        return EnsemblePredictor(
            tuple(partial(_predict, model, past, 1, noise) for noise in alone), together
        )

    def common() -> Noise:
        return SharedNoise(torch.Generator().manual_seed(seed), samples * len(past.states))

    return partial(_predict, model, past, max(1, samples), common if samples else None)


def expected_predictor(
    model: Model, past: Segment, *, samples: int = JUDGING, seed: int = 0
) -> Predictor:
    """Predict for an expectation over the model's futures (Eqs. 2 and 3): its mode and ``samples`` samples.

    An ``EnsemblePredictor``, whose first member is the mode, so that ``cem(screened=0.25)`` sorts the candidates by the
    mode and judges the best quarter by the mean over all. A deterministic model has its one rollout, an ensemble the
    modes of its members.

    Samples have the same noise, a function of ``seed``, for every candidate and call. ``fresh_predictor`` needs a seed
    that is none of ``samples * seed`` and the ``samples - 1`` after it.
    """
    if samples < 1:
        raise ValueError(
            f"samples is {samples}, expected at least 1; the mode alone is model_predictor(model, past)"
        )
    mode = model_predictor(model, past)
    if not as_dynamics(model).stochastic or isinstance(mode, EnsemblePredictor):
        return mode

    def common() -> Noise:
        seeds = range(samples * seed, samples * (seed + 1))
        each = SeparateNoise(tuple(torch.Generator().manual_seed(one) for one in seeds))
        return SharedNoise(each, samples * len(past.states))

    return EnsemblePredictor((mode, partial(_predict, model, past, samples, common)))


@dataclass(frozen=True)
class EnsemblePredictor:
    """Predict by several predictors: by the mode of each member of an ensemble, or by a model's mode and its samples.

    each: by themselves, the first S = 1, by which ``cem`` screens. together: all at once, where one rollout can.
    """

    each: tuple[Predictor, ...]
    together: Predictor | None = None

    def __call__(self, actions: Tensor) -> Tensor:
        """(C, B, T, du) -> (S, C, B, T, dx)."""
        return (
            self.together(actions)
            if self.together
            else torch.cat([predict(actions) for predict in self.each])
        )


def _predict(
    model: Model, past: Segment, draws: int, noise: Callable[[], Noise] | None, actions: Tensor
) -> Tensor:
    """``draws`` rollouts of every candidate, or the mode without noise: (C, B, T, du) -> (S, C, B, T, dx)."""
    n, n_targets, _, du = actions.shape
    if du != past.actions.shape[2]:
        raise ValueError(
            f"actions have {du} dimensions, those of the past {past.actions.shape[2]}; give the search space "
            "the size of this robot's actions: DirectActions(task.horizon, task.action_dim)"
        )
    rows = actions[:, None].expand(-1, draws, -1, -1, -1).flatten(0, 2)  # (C S B, T, du)
    pasts = Segment(*(part.repeat(n * draws, 1, 1) for part in past))
    states = rollout(model, pasts, rows, generator=noise() if noise else None)
    return states.unflatten(0, (n, draws, n_targets)).transpose(0, 1)


def fresh_predictor(model: Model, past: Segment, *, seed: int, samples: int = FRESH) -> Predictor:
    """What the return of a finished plan is predicted with: samples that had no part in choosing it.

    ``seed`` must not be the planner's. A deterministic model has no samples: its one rollout predicts.
    """
    return model_predictor(
        model, past, samples=samples if as_dynamics(model).stochastic else 0, seed=seed
    )


def simulator_predictor(
    env: str | Task, start: np.ndarray | None = None, *, done: Tensor | None = None
) -> Predictor:
    """Predict by executing in the true simulator, in bulk: S = 1. Not differentiable.

    env: a task, from its starts; ``done`` (B, t, du): after these actions. Of an episode that ended the last state
    repeats; ``rewards.until`` says what counts then. UnsupportedEnvironment where no state can be set.

    An arm, by its id or a task, from ``start`` (B, dx): any state can be one, also one in the middle of an episode, and
    ``done``, which led there, has no more part in it; without ``start`` a task's is executed first. In MuJoCo what
    follows is what would have followed, up to rounding; in pymunk, contacts that last forget the force with which they
    press. UnsupportedEnvironment for an arm with noise or delay; ValueError for an id without ``start``.
    """
    if isinstance(env, Task) and env.seeds:
        sofar = np.zeros((len(env), 0, env.action_dim)) if done is None else done.numpy()
        begun = Oracle(env.env, env.seeds, sofar)

        def outcomes(actions: Tensor) -> Tensor:
            return torch.from_numpy(begun.outcomes(actions.numpy())).float()[None]

        return outcomes
    name = env.env if isinstance(env, Task) else env
    if name.startswith("tsm/") and name != (arm := EnvSpec.parse(name).arm.id):
        raise UnsupportedEnvironment(
            f"{name} hides its states behind noisy sensors or delays actions, so what would follow is no function of "
            f"what is seen; the true simulator of {arm} can be asked"
        )
    if start is None and isinstance(env, Task):
        start = env.start if done is None or not done.shape[1] else _reached(env, done)
    if start is None:
        raise ValueError(
            f"candidates in {name} have no common start; give start (B, dx), or a task"
        )
    make = cache(partial(make_simulation, name))

    def predict(actions: Tensor) -> Tensor:
        n, n_targets, horizon, _ = actions.shape
        begin = np.tile(start, (n, 1))
        seen = collect(
            make(n * n_targets), open_loop(actions.flatten(0, 1)), horizon=horizon, states=begin
        )
        return torch.from_numpy(seen.states[:, 1:]).unflatten(0, (n, n_targets))[None]

    return predict


def _reached(task: Task, done: Tensor) -> np.ndarray:
    """The states (B, dx) of an arm after ``done`` (B, t, du) from the task's starts."""
    with closing(make_simulation(task.env, len(task))) as run:
        return collect(run, open_loop(done), horizon=done.shape[1], states=task.start).states[:, -1]
