"""Policies of several training seeds, learned as one: each in the model of its seed, weights with a leading dimension.

Each policy has starts, targets, noise, gradient norm, record and checkpoint of its own, and is to float tolerance what
``learn_policy`` makes of it alone. Ten as one take about as long as five one after another, on a CPU too
(benchmarks/settings, section 11).

Letters in shapes: S policies, each of M copies, n episodes of each copy, T horizon.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from copy import deepcopy
from itertools import groupby
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from tqdm.auto import tqdm

from tsmlib.models.base import EnsembleModel, Model
from tsmlib.models.features import Features
from tsmlib.models.recurrence import as_operations
from tsmlib.policies.learning import (
    NOT_FINITE,
    Draw,
    Learner,
    LearningCurve,
    LearningOptions,
    Measure,
    clip,
    discounted,
    imagine,
    learning_rate,
)
from tsmlib.policies.networks import Policy
from tsmlib.rewards import Reward
from tsmlib.sampling import GivenNoise, Noise, RecordedNoise
from tsmlib.training.checkpoint import resumable
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

    The arguments are those of ``learn_policy``, one for each policy. Checkpoints are those of ``learn_policy``: what
    was stopped goes on together or alone. Seconds of a curve are CPU time of all policies together.

    ValueError where there are not as many of each, for models that are no ``nn.Module`` or draw their noise by other
    means than ``tsmlib.sampling``, for ensembles, and for a reward that ``learn_policy`` refuses. TrainingStopped where
    states or gradients of one are not finite, with the weights of the last record in all policies.
    """
    o = options or LearningOptions()
    measures, checkpoints = measures or [None] * len(policies), checkpoints or [None] * len(policies)
    counts = [len(given) for given in (policies, models, draws, seeds, measures, checkpoints)]
    if len(set(counts)) > 1 or not policies:
        words = ("policies", "models", "draws", "seeds", "measures", "checkpoints")
        found = ", ".join(f"{count} {word}" for count, word in zip(counts, words, strict=True))
        raise ValueError(f"found {found}; expected as many of each, and one at least")
    for model in models:
        if not isinstance(model, nn.Module) or isinstance(model, EnsembleModel):
            raise ValueError(f"a {type(model).__name__} cannot be one of several models; learn in it by learn_policy")
    learners = [
        Learner.of(policy, model, reward, draw, o, seed, measure=measure, checkpoint=checkpoint)
        for policy, model, draw, seed, measure, checkpoint in zip(
            policies, models, draws, seeds, measures, checkpoints, strict=True
        )
    ]
    with ExitStack() as held:
        for learner in learners:
            held.enter_context(resumable(learner.state, purpose=f"learning a policy, seed {learner.seed}", progress=""))
        done = [learner.state.step for learner in learners]
        bar = held.enter_context(
            tqdm(total=len(learners) * o.iterations, initial=sum(done), desc=progress, disable=not progress)
        )
        for _, group in groupby(sorted(learners, key=_step), key=_step):
            together = _Together(list(group))
            try:
                together.learn(bar)
            except BaseException:
                for learner in together.learners:
                    learner.state.restore_best()
                raise
    return [learner.state.curve for learner in learners]


def _step(learner: Learner) -> int:
    return learner.state.step


class _Imagination(nn.Module):
    """``imagine`` in a model as a module, which can be called with other weights."""

    def __init__(self, learner: Learner) -> None:
        super().__init__()
        self.policy, self.options = learner.policy, learner.options
        assert isinstance(learner.model, nn.Module)
        self.model = learner.model

    def forward(self, start: Tensor, target: Tensor, noise: GivenNoise | RecordedNoise) -> tuple[Tensor, Tensor]:
        o = self.options
        seen = imagine(
            self.policy, cast(Model, self.model), start, target, horizon=o.horizon, noise=o.noise,
            generator=cast(Noise, noise),
        )  # fmt: skip
        return seen.states, seen.actions


class _Together:
    """Weights and moments of policies that have come equally far, stacked."""

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
        for part in self.module.modules():
            if isinstance(part, Features):
                part.settle()
        self.asked = self._asked()
        if first.state.step:
            self._take_moments()

    def _asked(self) -> list[torch.Size]:
        """Shapes of the noise of n episodes of one copy, in the order in which it is drawn."""
        noise, learner = RecordedNoise(), self.learners[0]
        start, target, _ = learner.episodes(0, self.options.episodes)
        with torch.no_grad():
            try:
                self.module(start, target, noise)
            except (AttributeError, TypeError) as error:
                raise ValueError(
                    f"{type(learner.model).__name__} draws its noise by other means than those of tsmlib.sampling; "
                    "learn in it by learn_policy"
                ) from error
        return [torch.Size((draw.shape[0] // self.copies, *draw.shape[1:])) for draw in noise.draws]

    def _take_moments(self) -> None:
        """Those of the policies' own optimisers."""
        for i, weight in enumerate(self.weights.values()):
            own = [learner.state.optimizers["adam"].state[learner.trained[i]] for learner in self.learners]
            self.optimizer.state[weight] = {
                name: torch.stack([moments[name] for moments in own]) if value.ndim else value.clone()
                for name, value in own[0].items()
            }

    def give_back(self) -> None:
        """Weights and moments, to each policy and its own optimiser."""
        for k, learner in enumerate(self.learners):
            for own, weight in zip(learner.trained, self.weights.values(), strict=True):
                own.detach().copy_(weight.detach()[k])
                learner.state.optimizers["adam"].state[own] = {
                    name: (value[k] if value.ndim else value).clone()
                    for name, value in self.optimizer.state[weight].items()
                }

    def learn(self, bar: tqdm) -> None:
        """To the end, with records and checkpoints as ``learn_policy`` makes them."""
        o, states = self.options, [learner.state for learner in self.learners]
        if not states[0].step:
            for learner in self.learners:
                learner.record()
        for iteration in range(states[0].step, o.iterations):
            began = time.process_time()
            self._update(iteration)
            for state in states:
                state.step, state.seconds = iteration + 1, state.seconds + time.process_time() - began
            bar.update(len(states))
            if states[0].step % o.record_every == 0 or states[0].step == o.iterations:
                self.give_back()
                for learner in self.learners:
                    learner.record()
                for state in states:
                    state.save()
                bar.set_postfix(predicted=-sum(state.best_loss for state in states) / len(states))

    def _update(self, iteration: int) -> None:
        """One step of the optimiser for all policies."""
        o, seeds = self.options, len(self.learners)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(iteration, o.lr, o.lr_decay, o.lr_final)
        drawn, noise = [], []
        for learner in self.learners:
            start, target, separate = learner.episodes(iteration, o.episodes)
            drawn.append((start, target))
            noise.append(
                [
                    torch.cat([torch.randn(shape, generator=g, dtype=start.dtype) for g in separate.generators])
                    for shape in self.asked
                ]
            )
        starts, targets = (torch.stack(part) for part in zip(*drawn, strict=True))
        numbers = [torch.stack(part).to(self.device) for part in zip(*noise, strict=True)]
        with as_operations():
            seen = vmap(self._imagined)(
                self.weights, self.fixed, starts.to(self.device), targets.to(self.device), numbers
            )
        states, actions = (part.to(starts.device) for part in seen)
        values = [
            discounted(learner.rewarded(targets[k], Segment(states[k], actions[k]), iteration), o.gamma).mean(1)
            for k, learner in enumerate(self.learners)
        ]  # Eq. 4, (M,) of each
        self.optimizer.zero_grad(set_to_none=True)
        (-torch.stack(values).sum()).backward()
        gradients = [w.grad.view(-1, *w.shape[2:]) for w in self.weights.values() if w.grad is not None]  # (S M, ...)
        finite = torch.isfinite(clip(gradients, o.clip)).unflatten(0, (seeds, -1)).all(1)
        if not finite.all():
            raise self.learners[int(finite.int().argmin())].state.stopped(NOT_FINITE, iteration)
        self.optimizer.step()

    def _imagined(
        self, weights: dict[str, Tensor], fixed: dict[str, Tensor], start: Tensor, target: Tensor, noise: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """States and actions (M n, T, .) of one policy."""
        return functional_call(self.module, {**weights, **fixed}, (start, target, GivenNoise(list(noise))))
