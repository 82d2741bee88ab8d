"""Trainings of several copies of a model as one: weights with a leading dimension of copies, as of several seeds.

Each copy has data, windows, noise, gradient norm and best weights of its own, and is to float tolerance what ``fit``
makes of it alone. On a GPU an update is recorded once, as a CUDA graph, and replayed.

Letters in shapes: S copies, B batch, N episodes, L steps of past, T steps of an episode.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value, stack_module_state, vmap
from tqdm.auto import tqdm

from tsmlib.models.features import Features
from tsmlib.models.recurrence import as_operations
from tsmlib.sampling import Draw, GivenNoise, RecordedNoise
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.training.fit import TrainingHistory, TrainingOptions, fixed_windows, optimizers, schedule
from tsmlib.training.precision import native_bf16
from tsmlib.trajectory import Segment, Trajectories, TrajectoryError, Window, windows

AHEAD = 50  # updates whose windows and noise are drawn at a time
WARM_UP = 3  # updates before one is recorded


def stacked(train: Sequence[Trajectories], past_len: int, device: str = "cpu") -> Segment:
    """Training data of all copies, as of ``Trajectories.padded``: (S, N, L + T, .).

    TrajectoryError where episodes are not all of one number and length.
    """
    for data in train:
        data.require_equal_lengths("training several copies as one")
    if len(shapes := {data.states.shape for data in train}) > 1:
        found = " and ".join(str(shape) for shape in sorted(shapes))
        raise TrajectoryError(f"copies would be trained on states of shapes {found}; expected one shape")
    first = train[0].padded(past_len)
    stack = Segment(*(torch.empty(len(train), *part.shape, dtype=part.dtype, device=device) for part in first))
    for copy, data in enumerate(train):
        for whole, part in zip(stack, data.padded(past_len), strict=True):
            whole[copy] = part
    return stack


def fit_stacked(
    models: Sequence[nn.Module],
    loss: str,
    train: Segment,
    validation: Trajectories,
    options: TrainingOptions,
    *,
    seeds: Sequence[int],
    device: str = "cpu",
    compiled: bool = False,  # fewer and larger kernels; compiling takes a minute or more
    progress: str = "",  # title of the progress bar; none without
) -> list[TrainingHistory]:
    """Minimise a loss of several models of one configuration at once; leave in each the weights that were best for it.

    loss: name of a method of theirs. train: (S, N, L + T, .), see ``stacked``, L being ``options.past_len``. seeds: of
    each copy's windows and noise. compiled: losses and gradients by ``torch.compile``. Seconds of the records are by
    the clock, of all copies together. On a CPU ten take 0.74 to 1.5 times as long
    as by ``fit`` in turn (docs/speed.md).

    ValueError where there are not as many models, seeds and data, for frozen weights, for features without statistics
    or copies in whose data other dimensions change, for windows with another past than the models', and for a loss that
    draws its noise by other means than ``tsmlib.sampling``. TrajectoryError for episodes that are too
    short. TrainingStopped where a loss is not finite at a validation, with the best weights so far in all models.
    Nothing is stored on the way, and ``options.patience`` is not looked at.
    """
    o, began = options, time.perf_counter()
    _require(models, train, o, seeds)
    histories = [TrainingHistory() for _ in models]
    stack = _Stack(models, loss, train, validation, o, seeds, device, compiled)
    update = stack.recorded() if stack.stream is not None else stack.update
    with torch.cuda.stream(stack.stream), tqdm(total=o.steps, desc=progress, disable=not progress) as bar:
        for first in range(0, o.steps, o.validate_every):
            end = min(first + o.validate_every, o.steps)
            for step in range(first, end, AHEAD):
                stack.draw(range(step, min(step + AHEAD, end)))
                for _ in range(step, min(step + AHEAD, end)):
                    update()
                bar.update(min(AHEAD, end - step))
            trained, validated = stack.total / (end - first), stack.validate()
            stack.total.zero_()
            values = torch.stack([trained, validated], dim=1).tolist()
            bar.set_postfix(validation=sum(value[1] for value in values) / len(values))
            for history, (before, after) in zip(histories, values, strict=True):
                history.step.append(end)
                history.seconds.append(time.perf_counter() - began)
                history.train.append(before)
                history.validation.append(after)
                history.bf16.append(stack.bf16)
            if bad := [seed for seed, value in zip(seeds, values, strict=True) if not all(map(math.isfinite, value))]:
                stack.restore(models)
                raise TrainingStopped(
                    f"the loss of seed {bad[0]} is not finite at step {end} of {o.steps}; all copies stop, with their "
                    f"best weights. {TrainingHistory.remedy}, or take a smaller lr than {o.lr}"
                )
        stack.restore(models)
    return histories


def _require(models: Sequence[nn.Module], train: Segment, o: TrainingOptions, seeds: Sequence[int]) -> None:
    """Errors of ``fit_stacked`` that can be told beforehand."""
    if not len(models) == len(seeds) == len(train.states):
        raise ValueError(
            f"found {len(models)} models, {len(seeds)} seeds and data of {len(train.states)} copies; expected as many "
            "of each"
        )
    for model in models:
        if (needed := getattr(model, "past_len", o.past_len)) != o.past_len:
            raise ValueError(
                f"past_len is {o.past_len}, but {type(model).__name__} is given {needed} steps of past; take "
                "TrainingOptions(past_len=model.past_len, ...)"
            )
        if frozen := [name for name, weight in model.named_parameters() if not weight.requires_grad]:
            raise ValueError(f"{frozen[0]} requires no gradient; train a model with frozen weights by fit")
        if isinstance(features := getattr(model, "features", None), Features) and not features.fitted:
            raise ValueError(f"a {type(model).__name__} has no statistics of its data; make it by for_data")
    moving = {tuple(f.moving.tolist()) for model in models if isinstance(f := getattr(model, "features", 0), Features)}
    if len(moving) > 1:
        raise ValueError("in the data of some copies other state dimensions change than in others'; train them by fit")
    if (steps := train.actions.shape[2] - o.past_len) < o.future_len:
        raise TrajectoryError(
            f"episodes of {steps} steps are too short for windows of {o.future_len} future steps; collect episodes of "
            f"at least {o.future_len} steps"
        )


class _Loss(nn.Module):
    """A loss of a model as a module, which can be called with other weights."""

    def __init__(self, net: nn.Module, loss: str) -> None:
        super().__init__()
        self.net, self.loss = net, loss

    def forward(self, window: Window, noise: Any) -> Tensor:
        return getattr(self.net, self.loss)(window, noise)


class _Stack:
    """Weights, moments, and tables of what the next updates take; all stay in their place, as a CUDA graph needs it."""

    def __init__(
        self, models: Sequence[nn.Module], loss: str, train: Segment, validation: Trajectories, o: TrainingOptions,
        seeds: Sequence[int], device: str, compiled: bool,
    ) -> None:  # fmt: skip
        self.options, self.seeds, self.copies, self.device = o, seeds, len(models), torch.device(device)
        self.stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        copies: list[nn.Module] = [_Loss(model, loss) for model in models]
        weights, self.buffers = stack_module_state(copies)
        self.buffers = {name: buffer.to(self.device) for name, buffer in self.buffers.items()}
        self.weights = {name: w.detach().to(self.device) for name, w in weights.items()}
        self.module = _Loss(deepcopy(models[0]).to(self.device), loss)
        if isinstance(features := getattr(self.module.net, "features", None), Features):
            features.settle()
        self.bf16 = o.bf16 and native_bf16(self.device)
        self.gradients = vmap(grad_and_value(self._training_loss))
        if compiled:
            self.gradients = torch.compile(self.gradients, fullgraph=True, dynamic=False)
        self.train = Segment(*(part.to(self.device) for part in train))
        held_out = fixed_windows(validation, o.past_len, o.future_len)
        self.asked, fixed = (_draws(models[0], loss, of) for of in (_sized(held_out, o.batch_size), held_out))
        self.held_out = Window(*(segment.to(self.device) for segment in held_out))
        drawn = [_drawn(fixed, torch.Generator().manual_seed(seed)) for seed in seeds]
        self.held_out_noise = [torch.stack(parts).to(self.device) for parts in zip(*drawn, strict=True)]
        table = AHEAD, self.copies
        self.episodes, self.starts = (
            torch.zeros(*table, o.batch_size, dtype=torch.long, device=self.device) for _ in range(2)
        )
        self.drawn = [
            torch.zeros(*table, *draw.shape, dtype=None if draw.below is None else torch.long, device=self.device)
            for draw in self.asked
        ]
        self.rates = torch.zeros(AHEAD, device=self.device)
        self.at, self.total = torch.zeros(1, dtype=torch.long, device=self.device), self.rates.new_zeros(self.copies)
        self.lr, self.muon = self.rates.new_zeros(()), self.rates.new_zeros(())
        own = {name.removeprefix("net."): weight for name, weight in self.weights.items()}
        made = optimizers(models[0], o, weights=own, lr=self.lr, muon=self.muon, capturable=self.stream is not None)
        self.optimizers = list(made.values())
        self.best = {name: weight.clone() for name, weight in self.weights.items()}
        self.best_loss = torch.full_like(self.total, math.inf)

    def draw(self, steps: range) -> None:
        """Fill the tables: the same windows and noise for (seed, step) as ``fit`` draws."""
        o, n, length = self.options, *self.train.actions.shape[1:3]
        last, generator = length - o.past_len - o.future_len, torch.Generator()
        rows = []
        for step in steps:
            for seed in self.seeds:
                generator.manual_seed(seed * 1_000_003 + step)
                episodes = torch.randint(n, (o.batch_size,), generator=generator)
                starts = torch.randint(last + 1, (o.batch_size,), generator=generator)
                rows.append([episodes, starts, *_drawn(self.asked, generator)])
        for table, parts in zip([self.episodes, self.starts, *self.drawn], zip(*rows, strict=True), strict=True):
            _upload(torch.stack(parts).unflatten(0, (len(steps), -1)), table)
        rates = [schedule(step, o.steps, o.lr, o.lr_final, o.warmup, o.span) for step in steps]
        _upload(torch.tensor(rates), self.rates)
        self.at.zero_()

    def update(self) -> None:
        """One step of the optimisers of all copies, by the next line of the tables."""
        o, taken = self.options, [table.index_select(0, self.at)[0] for table in (self.episodes, self.starts)]
        noise = [table.index_select(0, self.at)[0] for table in self.drawn]
        self.lr.copy_(self.rates.index_select(0, self.at)[0])
        torch.mul(self.lr, o.muon / o.lr, out=self.muon)
        with as_operations():
            gradients, losses = self.gradients(self.weights, self.buffers, self._windows(*taken), noise)
        squares = [gradient.flatten(1).square().sum(1) for gradient in gradients.values()]
        share = (o.clip / (torch.stack(squares).sum(0).sqrt() + 1e-6)).clamp(max=1.0)
        for name, gradient in gradients.items():  # laid out as the weight is: fused optimisers look at memory alone
            shared = gradient * share.view(-1, *[1] * (gradient.ndim - 1))
            self.weights[name].grad = shared.contiguous()
        for optimizer in self.optimizers:
            optimizer.step()
        self.total += losses
        self.at += 1

    def recorded(self) -> Callable[[], None]:
        """``update`` as a CUDA graph, after a few updates that are taken back: a graph needs moments that are there."""
        first = [weight.clone() for weight in self.weights.values()]
        self.draw(range(WARM_UP))
        current = torch.cuda.current_stream(self.device)
        assert self.stream is not None
        self.stream.wait_stream(current)
        with torch.cuda.stream(self.stream):
            for _ in range(WARM_UP):
                self.update()
        self.stream.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self.stream):
            self.update()
        for weight, before in zip(self.weights.values(), first, strict=True):
            weight.copy_(before)
        for optimizer in self.optimizers:
            for state in optimizer.state.values():
                for value in state.values():
                    value.zero_()
        self.total.zero_()
        torch.cuda.synchronize(self.device)
        return graph.replay

    @torch.no_grad()
    def validate(self) -> Tensor:
        """(S,) losses on fixed windows with fixed noise; keeps the weights that are the best of their copy."""
        with as_operations():
            found = vmap(self._loss, in_dims=(0, 0, None, 0))(
                self.weights, self.buffers, self.held_out, self.held_out_noise
            )
        better = found < self.best_loss
        self.best_loss = torch.where(better, found, self.best_loss)
        for name, weight in self.weights.items():
            self.best[name] = torch.where(better.view(-1, *[1] * (weight.ndim - 1)), weight, self.best[name])
        return found

    def restore(self, models: Sequence[nn.Module]) -> None:
        """Each copy's best weights, into its model."""
        for i, model in enumerate(models):
            own = {name.removeprefix("net."): weight[i].cpu() for name, weight in self.best.items()}
            model.load_state_dict(own, strict=False)

    def _loss(self, weights: dict[str, Tensor], buffers: dict[str, Tensor], of: Window, noise: list[Tensor]) -> Tensor:
        """Of one copy, in float32."""
        return functional_call(self.module, {**weights, **buffers}, (of, GivenNoise(list(noise))))

    def _training_loss(
        self, weights: dict[str, Tensor], buffers: dict[str, Tensor], of: Window, noise: list[Tensor]
    ) -> Tensor:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            return self._loss(weights, buffers, of, noise)

    def _windows(self, episodes: Tensor, starts: Tensor) -> Window:
        """(S, B) twice -> windows (S, B, ., .)."""
        n = self.train.states.shape[1]
        first = torch.arange(self.copies, device=self.device)[:, None] * n
        flat = Segment(*(part.flatten(0, 1) for part in self.train))
        o, rows = self.options, (episodes + first).flatten()
        cut = windows(flat, rows, starts.flatten(), o.past_len, o.future_len)
        return Window(*(Segment(*(part.unflatten(0, (self.copies, -1)) for part in segment)) for segment in cut))


def _draws(model: nn.Module, loss: str, window: Window) -> list[Draw]:
    """What a loss draws on a window, in its order."""
    noise = RecordedNoise()
    try:
        with torch.no_grad():
            getattr(model, loss)(window, noise)
    except TypeError as error:
        raise ValueError(
            f"{type(model).__name__}.{loss} draws its noise by other means than those of tsmlib.sampling; train "
            "such models by fit"
        ) from error
    return noise.draws


def _sized(window: Window, rows: int) -> Window:
    """A window of so many rows."""
    index = torch.arange(rows) % len(window.past.states)
    return Window(*(Segment(*(part[index] for part in segment)) for segment in window))


def _drawn(draws: Sequence[Draw], generator: torch.Generator) -> list[Tensor]:
    return [draw.sample(generator) for draw in draws]


def _upload(rows: Tensor, table: Tensor) -> None:
    """Into the first rows of a table, without waiting for a GPU."""
    if table.device.type == "cuda":
        rows = rows.pin_memory()
    table[: len(rows)].copy_(rows, non_blocking=True)
