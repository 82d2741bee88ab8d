"""Training: one flat loop for every model and the prior."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.checks import (
    require_callable,
    require_count,
    require_number,
    require_seed,
    require_type,
)
from tsmlib.models.base import require_robot
from tsmlib.storage.artifacts import trajectories_digest
from tsmlib.storage.files import PathLike
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.checkpoint import Curve, TrainingState, resumable
from tsmlib.training.muon import Muon, matrices
from tsmlib.trajectory import Trajectories, Window, batches, window_at

Loss = Callable[[Window, torch.Generator], Tensor]
CALL = "as in tsmlib.fit(model, data, validation, options, loss=model.loss)"


@dataclass(frozen=True)
class TrainingOptions:
    """Windows and schedule of a training.

    Args:
        past_len: steps of a window's past; None, the model's own, and nothing else fits.
        future_len: steps of a window's future; None for two segments of H steps, 20 of a model
            without segments, and no more than the data have.
        steps: updates.
        batch_size: windows of an update.
        lr: peak learning rate of Adam; its default (appendix A).
        lr_final: learning rate at the end of the cosine schedule.
        warmup: updates in which the learning rates rise from zero.
        muon: peak learning rate of Muon for the weight matrices, beside Adam for all else; it
            follows the schedule of lr. 0: Adam for everything.
        weight_decay: of the matrices, decoupled, per unit of their learning rate.
        span: the part of one schedule, from 0 to 1, that this training covers, where several follow
            each other; it warms up where it begins at 0.
        clip: largest norm of a gradient, since windows with contact have heavy tails; math.inf
            never clips.
        validate_every: updates from one validation to the next; a checkpoint is written as often.
        patience: validations without improvement after which it stops early; 0: never.
    """

    past_len: int | None = None
    future_len: int | None = None
    steps: int = 2000
    batch_size: int = 256
    lr: float = 1e-3
    lr_final: float = 1e-5
    warmup: int = 100
    muon: float = 0.0
    weight_decay: float = 0.0
    span: tuple[float, float] = (0.0, 1.0)
    clip: float = 1.0
    validate_every: int = 250
    patience: int = 0

    def __post_init__(self) -> None:
        for name in ("past_len", "future_len", "steps", "batch_size", "validate_every"):
            if (value := getattr(self, name)) is not None or name in ("steps", "batch_size"):
                require_count(name, value)
        for name in ("warmup", "patience"):
            require_count(name, getattr(self, name), least=0)
        for name in ("lr_final", "muon", "weight_decay"):
            require_number(name, getattr(self, name), 0)
        require_number("lr", self.lr, 0, above=True)
        if self.clip != math.inf:
            require_number("clip", self.clip, 0, above=True)
        if not isinstance(self.span, tuple | list) or len(self.span) != 2:
            raise TypeError(f"span is {self.span!r:.80}; expected two numbers, as in (0.0, 1.0)")
        first, last = (require_number("span", value, 0, 1) for value in self.span)
        if first >= last:
            raise ValueError(f"span is {self.span}; expected the first number below the second")

    def for_model(self, model: nn.Module, data: Trajectories) -> TrainingOptions:
        """Fill in what is None.

        Args:
            model: whose ``past_len`` and segments the windows have.
            data: training episodes, of which the longest holds the windows.

        Returns:
            Options with all numbers.

        Raises:
            ValueError: ``past_len`` is not the model's.
        """
        past_len = getattr(model, "past_len", self.past_len or 1)
        if self.past_len not in (None, past_len):
            raise ValueError(
                f"past_len is {self.past_len}, but {type(model).__name__} is given {past_len} "
                "steps of past in a rollout; leave it out, or take past_len=model.past_len"
            )
        future_len, segment = self.future_len, getattr(model, "code_len", None)
        if future_len is None and segment is not None:
            future_len = segment * max(1, min(2, data.horizon // segment))
        elif future_len is None:
            future_len = min(20, data.horizon)
        return replace(self, past_len=past_len, future_len=future_len)


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
        losses = [f"{loss:.4g}" for loss in self.validation[:: max(1, len(self.validation) - 1)]]
        return f"TrainingHistory({max(self.step, default=0)} steps, validation loss {' to '.join(losses)})"


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
    loss = _require_model(model, loss)
    train, validation = _split(data, validation)
    own = require_type("options", options or TrainingOptions(), TrainingOptions, CALL)
    seed, callback = require_seed("seed", seed), _optional("callback", callback)
    require_robot(model, train.robot, "the model and its training data")
    o = own.for_model(model, train)
    if hasattr(model, "take_robot"):
        model.take_robot(train)
    lengths = {"past_len": o.past_len, "future_len": o.future_len}
    held_out = fixed_windows(validation, o.past_len, o.future_len)
    held_out = Window(*(segment.to(require_device(device)) for segment in held_out))
    generator, title = torch.Generator(), type(model).__name__ if progress is True else progress
    episodes = train.tensors().to(device)
    draw = batches(episodes, **lengths, batch_size=o.batch_size, generator=generator)
    keep_freed_memory()
    with _trained_on(device, model):
        identity = asdict(o) | _identity(model, loss, train, validation, held_out, seed)
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


def _require_model(model: object, loss: Loss | None) -> Loss:
    """The loss of a model that can be trained."""
    require_type("model", model, nn.Module, CALL)
    if loss is None and not hasattr(model, "loss"):
        raise TypeError(f"model is a {type(model).__name__}, which has no loss; give one, {CALL}")
    if not any(weight.requires_grad for weight in model.parameters()):
        raise ValueError("model has no weight to train; expected one with requires_grad")
    return require_callable("loss", model.loss if loss is None else loss, CALL)


def _split(
    data: Trajectories, validation: Trajectories | None
) -> tuple[Trajectories, Trajectories]:
    """Training and held-out data of one robot."""
    require_type("data", data, Trajectories, CALL)
    if validation is None:
        return data.split(0.9)
    require_type("validation", validation, Trajectories, CALL)
    data.robot.require_same(validation.robot, "training and validation data")
    return data, validation


def _optional(name: str, value: Callback | None) -> Callback | None:
    return value if value is None else require_callable(name, value, "called with a Progress")


def require_device(device: object) -> str:
    """The name of a device that is there; ValueError otherwise."""
    try:
        torch.zeros(1, device=require_type("device", device, str))
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device is {device!r:.80}; expected 'cpu' or 'cuda': {reason}") from error
    return str(device)


def _identity(
    model: nn.Module,
    loss: Loss,
    train: Trajectories,
    validation: Trajectories,
    held_out: Window,
    seed: int,
) -> dict[str, object]:
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
    lr = schedule(step, o.steps, o.lr, o.lr_final, o.warmup, o.span)
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
    known = {id(weight) for weight in (matrices(model) if o.muon or o.weight_decay else [])}
    inside = [weight for weight in model.parameters() if id(weight) in known]
    others = [weight for weight in model.parameters() if id(weight) not in known]
    groups = [{"params": others, "weight_decay": 0.0}]
    if not o.muon:
        groups.append({"params": inside, "weight_decay": o.weight_decay})
    made: dict[str, torch.optim.Optimizer] = {}
    if groups := [group for group in groups if group["params"]]:
        made["adam"] = torch.optim.AdamW(groups, lr=o.lr, fused=True)
    if o.muon and inside:
        made["muon"] = Muon(inside, lr=o.muon, weight_decay=o.weight_decay)
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


def schedule(
    step: int,
    steps: int,
    lr: float,
    lr_final: float,
    warmup: int,
    span: tuple[float, float] = (0.0, 1.0),
) -> float:
    """Linear warm-up, then half a cosine from ``lr`` to ``lr_final``, or its part ``span``."""
    first, last = span
    warmup = 0 if first else warmup  # which the training before it had
    if step < warmup:
        return lr * (step + 1) / warmup
    done, of = step - warmup, max(1, steps - warmup)
    part = (first * of + (last - first) * done) / of
    return lr_final + (lr - lr_final) * 0.5 * (1 + math.cos(math.pi * part))


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
    require_type("data", data, Trajectories)
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
