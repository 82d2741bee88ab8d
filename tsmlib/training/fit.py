"""Training: one flat loop for every model and the prior."""

import ctypes
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from tsmlib.storage.artifacts import trajectories_digest
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.checkpoint import Curve, TrainingState, resumable
from tsmlib.training.muon import Muon, matrices
from tsmlib.training.precision import native_bf16
from tsmlib.trajectory import Trajectories, Window, batches, window_at

Loss = Callable[[Window, torch.Generator], Tensor]


@runtime_checkable
class Statistics(Protocol):
    """What a model of states knows of its training data."""

    fitted: bool

    @property
    def fit(self) -> Callable[[Trajectories], object]: ...


@dataclass(frozen=True)
class TrainingOptions:
    """Windows and schedule of a training.

    past_len, future_len: steps of a window; past_len is the model's. muon: peak learning rate of Muon for the weight
    matrices (``matrices``), beside Adam for all else; 0: Adam for everything. weight_decay: of the matrices, decoupled,
    per unit of their learning rate. span: the part of one cosine schedule, from 0 to 1, that this training covers,
    where several follow each other; warm-up where it begins at 0. patience: validations without improvement before
    stopping early; 0: never.
    """

    past_len: int
    future_len: int
    steps: int
    batch_size: int = 256
    lr: float = 1e-3  # Adam's default, appendix A
    lr_final: float = 1e-5  # end of the cosine schedule
    warmup: int = 100  # steps
    muon: float = 0.0  # follows the schedule of lr, and ends at the same share of its peak
    weight_decay: float = 0.0
    span: tuple[float, float] = (0.0, 1.0)
    clip: float = 1.0  # gradient norm: windows with contact have heavy tails
    validate_every: int = 250  # steps; a checkpoint is written as often
    patience: int = 0
    bf16: bool = False  # matrix products in bfloat16 where they are native; weights are in float32

    def __post_init__(self) -> None:
        for name in ("past_len", "future_len", "steps", "batch_size", "validate_every"):
            if (value := getattr(self, name)) < 1:
                raise ValueError(f"{name} {value}: expected positive")
        if not self.clip > 0:
            raise ValueError(f"clip {self.clip}: expected above zero; math.inf never clips")
        if not (0 < self.lr < math.inf and 0 <= self.lr_final < math.inf):
            raise ValueError(
                f"lr {self.lr}, lr_final {self.lr_final}: expected lr above zero, lr_final zero or above"
            )
        for name in ("muon", "weight_decay", "warmup", "patience"):
            if not 0 <= (value := getattr(self, name)) < math.inf:
                raise ValueError(f"{name} {value}: expected zero or above")
        if not 0 <= self.span[0] < self.span[1] <= 1:
            raise ValueError(
                f"span {self.span}: expected two numbers from 0 to 1, the first below the second"
            )


def require_past(model: nn.Module, options: TrainingOptions) -> None:
    """ValueError where the windows have another past than ``model.past_len``."""
    if (needed := getattr(model, "past_len", options.past_len)) != options.past_len:
        raise ValueError(
            f"past_len is {options.past_len}, but {type(model).__name__} is given {needed} steps of past in a rollout; "
            "take TrainingOptions(past_len=model.past_len, ...)"
        )


@dataclass
class TrainingHistory(Curve):
    """Record of a ``fit`` at each validation: optimiser step, training loss since the last one, validation loss.

    bf16: whether matrix products were in bfloat16.
    """

    step: list[int] = field(default_factory=list)
    train: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)
    bf16: list[bool] = field(default_factory=list)


@torch.enable_grad()  # an interrupt within torch.no_grad, in a notebook, may leave gradients off
def fit(
    model: nn.Module,
    loss: Loss,
    train: Trajectories,
    validation: Trajectories,
    options: TrainingOptions,
    *,
    seed: int = 0,
    device: str = "cpu",  # where it is trained, such as "cuda"; the model comes back to the CPU
    checkpoint: Path | None = None,  # a folder of its own
    progress: str = "",  # title of the progress bar; none without
    callback: Callback | None = None,  # at every validation
) -> TrainingHistory:
    """Minimise ``loss`` over random windows; leave the weights with the best validation loss in ``model``.

    Windows and noise are functions of (seed, step), so a run that is resumed from ``checkpoint``, a folder, continues
    as if it had not stopped. Raises TrainingStopped at the first loss or gradient that is not finite, with the best
    weights so far in ``model``, and StoreError for a checkpoint of another run, or one that another process writes.
    A model of states whose features have no statistics yet takes those of ``train`` first. Parameters with
    ``requires_grad`` False stay as they are. ValueError where the windows have another past than ``model.past_len``.
    """
    require_past(model, options)
    features = getattr(model, "features", None)
    if isinstance(features, Statistics) and not features.fitted:
        features.fit(train)
    o, generator, lengths = options, torch.Generator(), (options.past_len, options.future_len)
    held_out = Window(*(segment.to(device) for segment in fixed_windows(validation, *lengths)))
    draw = batches(
        train.tensors().to(device),
        past_len=o.past_len,
        future_len=o.future_len,
        batch_size=o.batch_size,
        generator=generator,
    )
    identity = asdict(options) | dict(
        seed=seed,
        loss=getattr(loss, "__name__", "loss"),
        env=train.env,
        episodes=len(train),
        data=[trajectories_digest(data) for data in (train, validation)],
    )
    if frozen := [name for name, weight in model.named_parameters() if not weight.requires_grad]:
        identity["frozen"] = frozen
    bf16 = o.bf16 and native_bf16(device)
    keep_freed_memory()
    with _trained_on(device, model):
        state = TrainingState(
            model, optimizers(model, o), TrainingHistory(), o.steps, identity, checkpoint
        )
        with resumable(state, purpose=f"training, seed {seed}", progress=progress) as bar:
            began, losses = time.process_time() - state.seconds, []
            for step in range(state.step, o.steps):
                if o.patience and step - state.best_step >= o.patience * o.validate_every:
                    break
                generator.manual_seed(seed * 1_000_003 + step)
                losses.append(_update(state, loss, draw, generator, step, o, bf16))
                bar.update()
                if (step + 1) % o.validate_every == 0 or step + 1 == o.steps:
                    state.step, state.seconds = step + 1, time.process_time() - began
                    _record(state, sum(losses) / len(losses), validate(loss, held_out, seed), bf16)
                    if callback is not None:
                        callback(_newest(state))
                    state.save()
                    bar.set_postfix(
                        train=state.curve.train[-1], validation=state.curve.validation[-1]
                    )
                    losses = []
    state.restore_best()
    return state.curve


def keep_freed_memory() -> None:
    """Let the process keep what it frees, where its allocator is glibc's.

    Otherwise the large tensors of an update go back to the system after it and are fetched anew, page by page, for the
    next, which takes a tenth of the time.
    """
    trim_threshold, mmap_max = -1, -4  # in malloc.h
    with suppress(OSError, TypeError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(mmap_max, 0)
        mallopt(trim_threshold, 2**31 - 1)


def optimizers(
    model: nn.Module,
    o: TrainingOptions,
    *,
    weights: Mapping[str, Tensor] | None = None,
    lr: float | Tensor | None = None,
    muon: float | Tensor | None = None,
    capturable: bool = False,
) -> dict[str, torch.optim.Optimizer]:
    """Adam, and Muon where it has a learning rate and the model a matrix.

    weights: in place of the model's, by name, with a leading dimension of copies. lr, muon: rates in place of those of
    the options, as tensors for a CUDA graph, which ``capturable`` is for.
    """
    named = dict(model.named_parameters())
    of: Mapping[str, Tensor] = named if weights is None else weights
    known = {id(weight) for weight in (matrices(model) if o.muon or o.weight_decay else [])}
    inside = [of[name] for name, weight in named.items() if id(weight) in known]
    others = [of[name] for name, weight in named.items() if id(weight) not in known]
    held = [{"params": others, "weight_decay": 0.0}]
    if not o.muon:
        held.append({"params": inside, "weight_decay": o.weight_decay})
    made: dict[str, torch.optim.Optimizer] = {}
    if held := [group for group in held if group["params"]]:
        made["adam"] = torch.optim.AdamW(
            held, lr=o.lr if lr is None else lr, fused=True, capturable=capturable
        )
    if o.muon and inside:
        rate, copies = o.muon if muon is None else muon, weights is not None
        made["muon"] = Muon(inside, lr=rate, weight_decay=o.weight_decay, copies=copies)
    return made


def _update(
    state: TrainingState[TrainingHistory],
    loss: Loss,
    draw: Iterator[Window],
    generator: torch.Generator,
    step: int,
    o: TrainingOptions,
    bf16: bool,
) -> float:
    """One step of the optimisers; the loss before it."""
    lr = schedule(step, o.steps, o.lr, o.lr_final, o.warmup, o.span)
    for name, optimizer in state.optimizers.items():
        for group in optimizer.param_groups:
            group["lr"] = lr if name == "adam" else lr / o.lr * o.muon
    window = next(draw)
    torch.clear_autocast_cache()  # which one left on would never clear
    with torch.autocast(window.past.states.device.type, torch.bfloat16, enabled=bf16):
        value = loss(window, generator)
    _require_finite(state, "training loss", value.item(), step)
    state.model.zero_grad(set_to_none=True)
    value.backward()
    norm = nn.utils.clip_grad_norm_(state.model.parameters(), o.clip)
    _require_finite(state, "gradient", norm.item(), step)  # before it reaches the weights
    for optimizer in state.optimizers.values():
        optimizer.step()
    return value.item()


def _record(
    state: TrainingState[TrainingHistory], train: float, validation: float, bf16: bool
) -> None:
    _require_finite(state, "validation loss", validation, state.step)
    state.curve.step.append(state.step)
    state.curve.seconds.append(state.seconds)
    state.curve.train.append(train)
    state.curve.validation.append(validation)
    state.curve.bf16.append(bf16)
    if validation < state.best_loss:
        state.keep(validation)


def _newest(state: TrainingState[TrainingHistory]) -> Progress:
    """The last record of a training."""
    curve = state.curve
    return Progress(
        state.step, state.seconds, {"train": curve.train[-1], "validation": curve.validation[-1]}
    )


def _require_finite(
    state: TrainingState[TrainingHistory], what: str, value: float, step: int
) -> None:
    if not math.isfinite(value):
        raise state.stopped(f"the {what} became {value}", step)


@contextmanager
def _trained_on(device: str, model: nn.Module) -> Iterator[None]:
    """The model on ``device``, with no autocast left on by somebody else; then on the CPU again."""
    kind = torch.device(device).type
    try:
        model.to(device)
        torch.set_autocast_enabled(kind, False)
        yield
    finally:
        torch.set_autocast_enabled(kind, False)
        model.to("cpu")


def schedule(
    step: int,
    steps: int,
    lr: float,
    lr_final: float,
    warmup: int,
    span: tuple[float, float] = (0.0, 1.0),
) -> float:
    """Linear warm-up, then half a cosine from ``lr`` to ``lr_final``; or the part of it that ``span`` covers."""
    first, last = span
    warmup = 0 if first else warmup  # which the training before it had
    if step < warmup:
        return lr * (step + 1) / warmup
    done, of = step - warmup, max(1, steps - warmup)
    return lr_final + (lr - lr_final) * 0.5 * (
        1 + math.cos(math.pi * (first * of + (last - first) * done) / of)
    )


def fixed_windows(
    data: Trajectories, past_len: int, future_len: int, n_windows: int = 2000
) -> Window:
    """The same windows at every validation: evenly spread over episodes and starts, and never across an end."""
    counts = torch.from_numpy(data.window_counts(future_len, "validation"))
    n_all = int(counts.sum())
    chosen = np.linspace(0, n_all - 1, min(n_windows, n_all)).round().astype(np.int64)
    return data.windows(*window_at(torch.from_numpy(chosen), counts), past_len, future_len)


@torch.no_grad()
def validate(loss: Loss, window: Window, seed: int) -> float:
    """The loss on fixed windows with fixed noise."""
    return loss(window, torch.Generator().manual_seed(seed)).item()
