"""Training: one flat loop for every model and the prior."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.checks import require_callable, require_count, require_seed, require_type
from tsmlib.models.base import require_robot
from tsmlib.storage.artifacts import trajectories_digest
from tsmlib.storage.files import Json, PathLike
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.checkpoint import Curve, TrainingState, resumable
from tsmlib.training.muon import Muon, matrices
from tsmlib.training.options import TrainingOptions, schedule
from tsmlib.trajectory import Trajectories, Window, batches, window_at

Loss = Callable[[Window, torch.Generator], Tensor]
CALL = "as in tsmlib.fit(model, data, validation, options, loss=model.loss)"


@dataclass(repr=False)
class TrainingHistory(Curve):
    """Record of a ``fit``, with one entry for each validation.

    Attributes:
        step: updates done.
        train: mean training loss since the last entry.
        validation: loss on fixed windows of the held-out data.
    """

    step: list[int] = field(default_factory=list)
    train: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)

    def __repr__(self) -> str:
        """Updates and validation losses, first to last."""
        ends = self.validation[:: max(1, len(self.validation) - 1)]
        losses = " to ".join(f"{loss:.4g}" for loss in ends)
        return f"TrainingHistory({max(self.step, default=0)} steps, validation loss {losses})"


@torch.enable_grad()  # an interrupt within torch.no_grad, in a notebook, may leave gradients off
def fit(
    model: nn.Module,
    data: Trajectories,
    validation: Trajectories | None = None,
    options: TrainingOptions | None = None,
    loss: Loss | None = None,
    *,
    seed: int = 0,
    device: str = "cpu",
    checkpoint: PathLike | None = None,
    progress: bool | str = True,
    callback: Callback | None = None,
) -> TrainingHistory:
    """Train a model, or an action prior, on random windows of episodes.

    The weights with the best validation loss are left in ``model``. Windows and noise are functions
    of (seed, step), so a run that is resumed from ``checkpoint`` continues as if it had not
    stopped. Parameters with ``requires_grad`` False stay as they are.

    Args:
        model: made by ``TSM.for_data(data)``, say; one that was made without data takes the robot
            and the statistics of these.
        data: training episodes.
        validation: held-out episodes of the same robot; None for a tenth of ``data``, by episodes.
        options: windows and schedule; None for ``TrainingOptions()``.
        loss: (window, generator) -> a scalar tensor; None for ``model.loss``.
        seed: of windows and noise.
        device: where it is trained, such as "cuda"; the model comes back to the CPU.
        checkpoint: a folder of its own, from which a training that was stopped goes on.
        progress: whether to show a progress bar, or its title.
        callback: called with a ``Progress`` at every validation.

    Returns:
        The losses at every validation.

    Raises:
        TypeError: arguments of other kinds.
        ValueError: the model, the data and the validation data are not of one robot, or the windows
            do not fit the model or the episodes.
        TrainingStopped: a loss or a gradient that is not finite; the model has its best weights.
        StoreError: ``checkpoint`` is of another run, or another process writes it.
    """
    loss, train, validation, o = checked(model, data, validation, options, loss)
    require_robot(model, train.robot, "the model and its training data")
    if callback is not None:
        require_callable("callback", callback, "a function of a Progress")
    require_seed("seed", seed)
    require_type("progress", progress, (bool, str), "True, False or the title of a bar")
    if checkpoint is not None:
        require_type("checkpoint", checkpoint, (str, Path), "the path of a folder")
    if (take_robot := getattr(model, "take_robot", None)) is not None:
        take_robot(train)
    past_len, future_len = o.lengths
    held_out = fixed_windows(validation, past_len, future_len)
    held_out = Window(*(segment.to(require_device(device)) for segment in held_out))
    generator, title = torch.Generator(), type(model).__name__ if progress is True else progress
    draw = batches(
        train.tensors().to(device),
        past_len=past_len,
        future_len=future_len,
        batch_size=o.batch_size,
        generator=generator,
    )
    keep_freed_memory()
    with _trained_on(device, model):
        identity: dict[str, Json] = asdict(o)
        if checkpoint is not None:
            identity |= _identity(model, loss, train, validation, held_out, seed)
        state = TrainingState(
            model, optimizers(model, o), TrainingHistory(), o.steps, identity, checkpoint
        )
        with resumable(state, purpose=f"training, seed {seed}", progress=title) as bar:
            began, losses = time.process_time() - state.seconds, []
            for step in range(state.step, o.steps):
                if o.patience and step - state.best_step >= o.patience * o.validate_every:
                    break
                generator.manual_seed(seed * 1_000_003 + step)
                losses.append(_update(state, loss, draw, generator, step, o))
                bar.update()
                if (step + 1) % o.validate_every == 0 or step + 1 == o.steps:
                    state.step, state.seconds = step + 1, time.process_time() - began
                    record = _record(state, losses, validate(loss, held_out, seed))
                    if callback is not None:
                        callback(Progress(state.step, state.seconds, record))
                    state.save()
                    bar.set_postfix(record)
                    losses = []
    state.restore_best()
    return state.curve


def checked(
    model: nn.Module,
    data: Trajectories,
    validation: Trajectories | None,
    options: TrainingOptions | None,
    loss: Loss | None,
) -> tuple[Loss, Trajectories, Trajectories, TrainingOptions]:
    """Loss, training and held-out data and options, without what is None; see ``fit``."""
    require_type("model", model, nn.Module, f"a model, {CALL}")
    if callable(data):  # public scripts give the loss second, before data, validation and options
        loss, data, validation, options = cast(Any, (data, validation, options, loss))
    if not any(weight.requires_grad for weight in model.parameters()):
        raise ValueError("model has no weight to train; expected one with requires_grad")
    require_type("data", data, Trajectories, f"Trajectories, {CALL}")
    loss = cast(Loss, getattr(model, "loss", None) if loss is None else loss)
    require_callable("loss", loss, f"a function (window, generator) -> scalar, {CALL}")
    if validation is None:
        data, validation = data.split(0.9)
    require_type("validation", validation, Trajectories, f"Trajectories, {CALL}")
    data.robot.require_same(validation.robot, "training and validation data")
    options = TrainingOptions() if options is None else options
    require_type("options", options, TrainingOptions, "tsmlib.TrainingOptions(...)")
    return loss, data, validation, options.for_model(model, data)


def require_device(device: str) -> str:
    """The name of a device that is there; ValueError otherwise."""
    require_type("device", device, str, "'cpu' or 'cuda'")
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device is {device!r:.80}; expected 'cpu' or 'cuda': {reason}") from error
    return device


def _identity(
    model: nn.Module,
    loss: Loss,
    train: Trajectories,
    validation: Trajectories,
    held_out: Window,
    seed: int,
) -> dict[str, Json]:
    """What this run is, by values: the loss is known by what it gives for the first weights."""
    return {
        "seed": seed,
        "env": train.env,
        "episodes": len(train),
        "data": [trajectories_digest(part) for part in (train, validation)],
        "loss of the first weights": validate(loss, held_out, seed),
        "frozen": [name for name, w in model.named_parameters() if not w.requires_grad],
    }


def _update(
    state: TrainingState[TrainingHistory],
    loss: Loss,
    draw: Iterator[Window],
    generator: torch.Generator,
    step: int,
    o: TrainingOptions,
) -> float:
    """One step of the optimisers; the loss before it."""
    lr = schedule(step, o.steps, o.lr, o.lr_final, o.warmup or 0, o.span)
    for name, optimizer in state.optimizers.items():
        for group in optimizer.param_groups:
            group["lr"] = lr if name == "adam" else lr / o.lr * o.muon
    value = loss(next(draw), generator)
    if not isinstance(value, Tensor) or value.ndim or not value.requires_grad:
        raise TypeError(
            f"loss gave {value!r:.80}; expected a scalar tensor with a gradient, a function of "
            "the model's weights"
        )
    _require_finite(state, "training loss", value.item(), step)
    state.model.zero_grad(set_to_none=True)
    value.backward()
    if all(weight.grad is None for weight in state.model.parameters()):
        raise ValueError(
            f"loss has no gradient for any weight of this {type(state.model).__name__}; expected "
            "a function of the weights of the model that is trained, such as loss=model.loss"
        )
    norm = nn.utils.clip_grad_norm_(state.model.parameters(), o.clip)
    _require_finite(state, "gradient", norm.item(), step)  # before it reaches the weights
    for optimizer in state.optimizers.values():
        optimizer.step()
    return value.item()


def _record(
    state: TrainingState[TrainingHistory], losses: list[float], validation: float
) -> dict[str, float]:
    """The record of a validation, which is added to the curve."""
    _require_finite(state, "validation loss", validation, state.step)
    record = {"train": sum(losses) / len(losses), "validation": validation}
    for name, value in (record | {"step": state.step, "seconds": state.seconds}).items():
        getattr(state.curve, name).append(value)
    if validation < state.best_loss:
        state.keep(validation)
    return record


def _require_finite(
    state: TrainingState[TrainingHistory], what: str, value: float, step: int
) -> None:
    if not math.isfinite(value):
        raise state.stopped(f"the {what} became {value}", step)


def keep_freed_memory() -> None:
    """Let the process keep what it frees, where its allocator is glibc's.

    Otherwise the large tensors of an update go back to the system after it and are fetched anew,
    page by page, for the next, which takes a tenth of the time.
    """
    trim_threshold, mmap_max = -1, -4  # in malloc.h
    with suppress(OSError, TypeError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(mmap_max, 0)
        mallopt(trim_threshold, 2**31 - 1)


def optimizers(model: nn.Module, o: TrainingOptions) -> dict[str, torch.optim.Optimizer]:
    """Adam, and Muon where it has a learning rate and the model a matrix, by their names."""
    inside = matrices(model) if o.muon else []
    known = {id(weight) for weight in inside}
    others = [weight for weight in model.parameters() if id(weight) not in known]
    made: dict[str, torch.optim.Optimizer] = {}
    if others:
        made["adam"] = torch.optim.Adam(others, lr=o.lr, fused=True)
    if inside:
        made["muon"] = Muon(inside, lr=o.muon)
    return made


@contextmanager
def _trained_on(device: str, model: nn.Module) -> Iterator[None]:
    """The model on ``device``, with no autocast left on by somebody else; then on the CPU again."""
    kind = torch.device(device).type
    try:
        model.to(device)
        torch.set_autocast_enabled(kind, False)
        yield
    finally:
        model.to("cpu")


def fixed_windows(
    data: Trajectories, past_len: int, future_len: int, n_windows: int = 2000
) -> Window:
    """The same windows every time: evenly spread over all that lie within an episode.

    Args:
        data: episodes.
        past_len: L, steps of the past.
        future_len: K, steps of the future.
        n_windows: at most so many.

    Returns:
        The windows, (B, L, .) and (B, K, .).
    """
    require_type("data", data, Trajectories, "tsmlib.Trajectories")
    for name, value in (("past_len", past_len), ("n_windows", n_windows)):
        require_count(name, value)
    counts = data.window_counts(require_count("future_len", future_len), "validation data")
    chosen = np.linspace(0, counts.sum() - 1, min(n_windows, int(counts.sum()))).round()
    at = window_at(torch.from_numpy(chosen.astype(np.int64)), torch.from_numpy(counts))
    return data.windows(*at, past_len, future_len)


@torch.no_grad()
def validate(loss: Loss, window: Window, seed: int) -> float:
    """The loss on fixed windows with fixed noise."""
    return loss(window, torch.Generator().manual_seed(seed)).item()
