"""Policies of several training seeds, learned as one: each in the model of its seed, weights with a leading dimension.

Each policy has starts, targets, noise, gradient norm, record and checkpoint of its own, and is to float tolerance what
``learn_policy`` makes of it alone. Ten as one take about as long as five one after another, on a CPU too
(benchmarks/settings, section 11). On a GPU imagined episodes and their gradient are captured once, as CUDA graphs,
where a graph can hold the model.

Letters in shapes: S policies, each of M copies, n episodes of each copy, T horizon.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from copy import deepcopy
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from tqdm.auto import tqdm

from tsmlib.models.base import EnsembleModel, Model
from tsmlib.models.config import Configured
from tsmlib.models.features import Features
from tsmlib.models.recurrence import as_operations
from tsmlib.policies.learning import (
    NOT_FINITE,
    Draw,
    Learner,
    LearningCurve,
    LearningOptions,
    Measure,
    clip_gradients,
    discounted,
    imagine,
    learning_rate,
)
from tsmlib.policies.networks import Policy
from tsmlib.rewards import Reward
from tsmlib.sampling import GivenNoise, Noise, RecordedNoise
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json
from tsmlib.training.checkpoint import TrainingStopped, resumable
from tsmlib.trajectory import Segment


@torch.enable_grad()  # see training.fit
def learn_stacked(
    policies: Sequence[Policy],
    models: Sequence[nn.Module],
    reward: Callable[[Tensor], Reward],
    draws: Sequence[Draw],
    options: LearningOptions | None = None,
    *,
    seeds: Sequence[int],
    measures: Sequence[Measure | None] = (),
    checkpoints: Sequence[Path | None] = (),
    progress: str = "",  # title of the progress bar; none without
) -> list[LearningCurve]:
    """``learn_policy`` of several policies of one configuration, each in its own of as many models, at once.

    policies, models, draws, seeds, measures, checkpoints: one for each policy. Checkpoints are those of
    ``learn_policy``, so that what was stopped goes on in either way; policies that had come less far are learned first,
    until they can join the others. Seconds of a curve are CPU time of all ``policies`` of the curve.

    ValueError where there are not as many of each or they are not alike, for ensembles and models without ``begin``,
    and for a reward that ``learn_policy`` refuses; FloatingPointError and StoreError as in ``learn_policy``.
    TrainingStopped, naming the seed, where states or gradients of one are not finite: all policies have the weights of
    their last record.
    """
    o = options or LearningOptions()
    measures, checkpoints = measures or [None] * len(policies), checkpoints or [None] * len(policies)
    _require(dict(
        policies=policies, models=models, draws=draws, seeds=seeds, measures=measures, checkpoints=checkpoints
    ))  # fmt: skip
    _require_alike(policies)
    _require_alike(models)
    learners = []
    for k, (policy, model) in enumerate(zip(policies, models, strict=True)):
        learners.append(Learner.of(
            policy, cast(Model, model), reward, draws[k], o, seeds[k], measure=measures[k], checkpoint=checkpoints[k]
        ))  # fmt: skip
    with ExitStack() as held:
        for learner in learners:
            held.enter_context(resumable(learner.state, purpose=f"learning a policy, seed {learner.seed}", progress=""))
        done = sum(learner.state.step for learner in learners)
        bar = held.enter_context(
            tqdm(total=len(learners) * o.iterations, initial=done, desc=progress, disable=not progress)
        )
        while (least := min(learner.state.step for learner in learners)) < o.iterations:
            ahead = [learner.state.step for learner in learners if learner.state.step > least]
            group = [learner for learner in learners if learner.state.step == least]
            try:
                _Stack(group).learn(min(ahead, default=o.iterations), bar)
            except BaseException:
                for learner in group:
                    learner.state.restore_best()
                raise
    return [learner.state.curve for learner in learners]


def _require(given: dict[str, Sequence[object]]) -> None:
    """As many of each, and models that can be stacked."""
    if len({len(each) for each in given.values()}) > 1 or not given["policies"]:
        found = ", ".join(f"{len(each)} {word}" for word, each in given.items())
        raise ValueError(f"found {found}; expected as many of each, and one at least")
    for model in given["models"]:
        if not isinstance(model, nn.Module) or isinstance(model, EnsembleModel) or not hasattr(model, "begin"):
            raise ValueError(f"a {type(model).__name__} cannot be one of several models; learn in it by learn_policy")


def _require_alike(modules: Sequence[nn.Module]) -> None:
    """One class, one configuration, weights of one shape."""
    first, *others = ({"class": type(each).__name__} | _made_of(each) for each in modules)
    for other in others:
        if differs := [f"{name} {value!r} and {other.get(name)!r}" for name, value in first.items()
                       if other.get(name) != value]:  # fmt: skip
            raise ValueError(f"{first['class']}s that are stacked must be alike; found {'; '.join(differs[:3])}")


def _made_of(module: nn.Module) -> dict[str, Json]:
    return {**artifacts.layout(module.state_dict()), **(module.config() if isinstance(module, Configured) else {})}


class _Imagination(nn.Module):
    """``imagine`` in a model as a module, which can be called with other weights."""

    def __init__(self, learner: Learner) -> None:
        super().__init__()
        self.policy, self.model, self.options = learner.policy, cast(nn.Module, learner.model), learner.options

    def forward(self, start: Tensor, target: Tensor, noise: GivenNoise | RecordedNoise) -> tuple[Tensor, Tensor]:
        o = self.options
        seen = imagine(
            self.policy, cast(Model, self.model), start, target, horizon=o.horizon, noise=o.noise,
            generator=cast(Noise, noise),
        )  # fmt: skip
        return seen.states, seen.actions


class _Stack:
    """Weights and moments of policies that have come equally far."""

    def __init__(self, learners: Sequence[Learner]) -> None:
        self.learners, first = learners, learners[0]
        self.options, self.copies = first.options, first.policy.copies
        modules = [_Imagination(learner) for learner in learners]
        weights, buffers = stack_module_state([*modules])
        learned = {f"policy.{name}" for name, weight in first.policy.named_parameters() if weight.requires_grad}
        self.weights = {name: weight.detach().requires_grad_() for name, weight in weights.items() if name in learned}
        self.fixed = {name: weight.detach() for name, weight in weights.items() if name not in learned} | buffers
        self.device = next(iter(self.weights.values())).device
        self.optimizer = torch.optim.Adam(self.weights.values(), lr=self.options.lr)
        self.module = deepcopy(modules[0])
        self.draws = self._recorded_draws()
        for own in (self.module.policy.features, getattr(self.module.model, "features", None)):
            if isinstance(own, Features) and own.fitted:
                own.settle()
        if first.state.step:
            for i, weight in enumerate(self.weights.values()):
                own = [learner.state.optimizers["adam"].state[learner.trained[i]] for learner in learners]
                self.optimizer.state[weight] = {
                    name: torch.stack([moments[name] for moments in own]) if value.ndim else value.clone()
                    for name, value in own[0].items()
                }
        self.imagined = self._captured() if self.device.type == "cuda" else self._together

    def _recorded_draws(self) -> list[torch.Size]:
        """Shapes of the noise of n episodes of one copy, in the order in which it is drawn."""
        noise, learner = RecordedNoise(), self.learners[0]
        start, target, _ = learner.episodes(0, self.options.episodes)
        with torch.no_grad():
            self.module(start, target, noise)
        return [torch.Size((draw.shape[0] // self.copies, *draw.shape[1:])) for draw in noise.draws]

    def unstack(self) -> None:
        """Weights and moments, into each policy and its own optimiser."""
        for k, learner in enumerate(self.learners):
            for own, weight in zip(learner.trained, self.weights.values(), strict=True):
                own.detach().copy_(weight.detach()[k])
                learner.state.optimizers["adam"].state[own] = {
                    name: (value[k] if value.ndim else value).clone()
                    for name, value in self.optimizer.state[weight].items()
                }

    def learn(self, until: int, bar: tqdm) -> None:
        """Until an iteration that ends with a record; records and checkpoints as ``learn_policy`` makes them."""
        o, states = self.options, [learner.state for learner in self.learners]
        for learner in self.learners:
            learner.state.curve.policies = max(learner.state.curve.policies, len(states))
            if not learner.state.step:
                learner.record()
        for iteration in range(states[0].step, until):
            began = time.process_time()
            self._update(iteration)
            spent = time.process_time() - began
            for state in states:
                state.step, state.seconds = iteration + 1, state.seconds + spent
            bar.update(len(states))
            if states[0].step % o.record_every == 0 or states[0].step == o.iterations:
                self.unstack()
                for learner in self.learners:
                    learner.record()
                for state in states:
                    state.save()
                bar.set_postfix(predicted=-sum(state.best_loss for state in states) / len(states))

    def _update(self, iteration: int) -> None:
        """One step of the optimiser for all policies."""
        o = self.options
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(iteration, o.lr, o.lr_decay, o.lr_final)
        starts, targets, *noise = self._episodes(iteration)
        given = [part.to(self.device) for part in (starts, targets, *noise)]
        states, actions = (part.to(starts.device) for part in self.imagined(*given, *self.weights.values()))
        values = []
        for k, learner in enumerate(self.learners):
            try:
                rewards = learner.checked_rewards(targets[k], Segment(states[k], actions[k]), iteration)
            except TrainingStopped as error:
                raise _of(learner, error) from None
            values.append(discounted(rewards, o.gamma).mean(1))  # Eq. 4, (M,)
        self.optimizer.zero_grad(set_to_none=True)
        (-torch.stack(values).sum()).backward()
        gradients = [w.grad.view(-1, *w.shape[2:]) for w in self.weights.values() if w.grad is not None]  # (S M, ...)
        finite = torch.isfinite(clip_gradients(gradients, o.clip)).unflatten(0, (len(values), -1)).all(1)
        if not finite.all():
            learner = self.learners[int(finite.int().argmin())]
            raise _of(learner, learner.state.stopped(NOT_FINITE, iteration))
        self.optimizer.step()

    def _episodes(self, iteration: int) -> list[Tensor]:
        """Starts, targets and noise of an iteration, (S, M n, .) each."""
        drawn = []
        for learner in self.learners:
            start, target, separate = learner.episodes(iteration, self.options.episodes)
            noise = [
                torch.cat([torch.randn(shape, generator=g, dtype=start.dtype) for g in separate.generators])
                for shape in self.draws
            ]
            drawn.append([start, target, *noise])
        return [torch.stack(part) for part in zip(*drawn, strict=True)]

    def _captured(self) -> Callable[..., tuple[Tensor, Tensor]]:
        """``_together`` and its gradient as CUDA graphs: imagined episodes are many small operations. The function
        itself, with a warning, where a model does what no graph can hold."""
        given = [part.to(self.device) for part in self._episodes(0)]
        try:
            recorded = torch.cuda.make_graphed_callables(self._together, (*given, *self.weights.values()))
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            warnings.warn(f"{type(self.module.model).__name__} is not captured as a CUDA graph: {error}", stacklevel=2)
            return self._together
        return cast("Callable[..., tuple[Tensor, Tensor]]", recorded)

    def _together(self, starts: Tensor, targets: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """States and actions (S, M n, T, .) of all policies. rest: noise, then the weights."""
        noise, weights = list(rest[: len(self.draws)]), dict(zip(self.weights, rest[len(self.draws) :], strict=True))
        with as_operations():
            return vmap(self._imagined)(weights, self.fixed, starts, targets, noise)

    def _imagined(
        self, weights: dict[str, Tensor], fixed: dict[str, Tensor], start: Tensor, target: Tensor, noise: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """States and actions (M n, T, .) of one policy."""
        return functional_call(self.module, {**weights, **fixed}, (start, target, GivenNoise(list(noise))))


def _of(learner: Learner, error: TrainingStopped) -> TrainingStopped:
    return TrainingStopped(f"seed {learner.seed}: {error}")
