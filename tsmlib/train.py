"""fit(): one flat loop for every model and the prior."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from tsmlib import store
from tsmlib.trajectory import Trajectories, TrajectoryError, Window, batches, windows

Loss = Callable[[Window, torch.Generator], Tensor]


class TrainingStopped(RuntimeError):
    """The loss was not finite; the model holds the last good weights. The message names step and remedy."""


@dataclass
class Curve:
    """What a fit recorded at each validation: optimiser step, seconds, training and validation loss."""

    step: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    train: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)


def fit(
    model: nn.Module,
    loss: Loss,
    train: Trajectories,
    validation: Trajectories,
    *,
    past_len: int,
    future_len: int,
    steps: int,
    batch_size: int = 256,
    lr: float = 1e-3,  # Adam's default, appendix A
    lr_final: float = 1e-5,  # end of the cosine schedule
    warmup: int = 100,  # steps
    clip: float = 1.0,  # gradient norm: windows with contact have heavy tails
    validate_every: int = 250,  # steps; a checkpoint is written as often
    patience: int = 0,  # validations without improvement before stopping early; 0: never
    seed: int = 0,
    bf16: bool = False,  # matrix products in bfloat16, weights in float32
    checkpoint: Path | None = None,
    progress: str = "",  # title of the progress bar; none without
) -> Curve:
    """Minimise ``loss`` over random windows with Adam; leave the weights with the best validation loss in ``model``.

    Windows and noise are functions of (seed, step), so a run that is resumed from ``checkpoint`` continues as if it
    had not stopped. Raises TrainingStopped at the first loss that is not finite, with the best weights so far in
    ``model``, and store.StoreError for a checkpoint of another run.
    """
    if steps < 1 or batch_size < 1 or validate_every < 1:
        raise ValueError(f"steps {steps}, batch_size {batch_size}, validate_every {validate_every}: expected positive")
    optimizer = torch.optim.Adam(model.parameters(), lr=lr)
    state = Progress(model, optimizer)
    identity = dict(
        past_len=past_len, future_len=future_len, steps=steps, batch_size=batch_size, lr=lr, lr_final=lr_final,
        warmup=warmup, clip=clip, validate_every=validate_every, patience=patience, seed=seed, bf16=bf16,
        loss=getattr(loss, "__name__", "loss"), env=train.env, episodes=len(train),
    )  # fmt: skip
    if checkpoint is not None and checkpoint.exists():
        state.load(checkpoint, identity)
    generator = torch.Generator()
    held_out = fixed_windows(validation, past_len, future_len)
    draw = batches(
        train.padded(past_len),
        past_len=past_len, future_len=future_len, batch_size=batch_size, generator=generator,
    )  # fmt: skip
    began, total, counted = time.perf_counter() - state.seconds, 0.0, 0
    bar = tqdm(total=steps, initial=state.step, desc=progress, disable=not progress, mininterval=1.0)
    for step in range(state.step, steps):
        if patience and step - state.best_step >= patience * validate_every:
            break
        generator.manual_seed(seed * 1_000_003 + step)
        for group in optimizer.param_groups:
            group["lr"] = schedule(step, steps, lr, lr_final, warmup)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            value = loss(next(draw), generator)
        if not torch.isfinite(value):
            raise state.stopped("training", value.item(), f"{step} of {steps}", lr)
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        nn.utils.clip_grad_norm_(model.parameters(), clip)
        optimizer.step()
        total, counted = total + value.item(), counted + 1
        bar.update()
        if (step + 1) % validate_every == 0 or step + 1 == steps:
            state.step, state.seconds = step + 1, time.perf_counter() - began
            held_out_loss = validate(loss, held_out, seed)
            if not math.isfinite(held_out_loss):
                raise state.stopped("validation", held_out_loss, f"{step + 1} of {steps}", lr)
            state.record(total / counted, held_out_loss)
            bar.set_postfix(train=state.curve.train[-1], validation=state.curve.validation[-1])
            total, counted = 0.0, 0
            if checkpoint is not None:
                state.save(checkpoint, identity)
    bar.close()
    state.restore_best()
    return state.curve


class Progress:
    """All that a run needs to continue: weights, Adam's moments, the step, the best weights and the curve so far."""

    def __init__(self, model: nn.Module, optimizer: torch.optim.Optimizer, curve: Any = None) -> None:
        self.model, self.optimizer = model, optimizer
        self.step, self.seconds = 0, 0.0
        self.curve: Any = Curve() if curve is None else curve  # a dataclass of lists
        self.best, self.best_step, self.best_loss = _copy(model.state_dict()), 0, math.inf

    def record(self, train: float, validation: float) -> None:
        """Add a point to the curve; keep the weights if they are the best so far."""
        self.curve.step.append(self.step)
        self.curve.seconds.append(self.seconds)
        self.curve.train.append(train)
        self.curve.validation.append(validation)
        if validation < self.best_loss:
            self.best, self.best_step, self.best_loss = _copy(self.model.state_dict()), self.step, validation

    def restore_best(self) -> None:
        """Put the weights with the best validation loss into the model."""
        self.model.load_state_dict(self.best)

    def stopped(self, which: str, loss: float, at: str, lr: float) -> TrainingStopped:
        """Go back to the best weights; the error to raise."""
        self.restore_best()
        return TrainingStopped(
            f"the {which} loss became {loss} at step {at}; the weights of step {self.best_step} are kept. "
            f"Check the data, or train with a smaller lr than {lr:g}"
        )

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write one checkpoint, replacing the one before it in a single step."""
        adam = self.optimizer.state_dict()["state"]
        tensors = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self.best.items()}
        tensors |= {f"adam.{i}.{name}": tensor for i, moments in adam.items() for name, tensor in moments.items()}
        header = dict(
            identity=identity, step=self.step, seconds=self.seconds, curve=asdict(self.curve),
            best_step=self.best_step, best_loss=self.best_loss,
        )  # fmt: skip
        store.save(path, tensors, kind="checkpoint", header=header)

    def load(self, path: Path, identity: dict[str, Any]) -> None:
        """Continue from a checkpoint of the same run; StoreError names what differs otherwise."""
        tensors, header = store.load(path, kind="checkpoint")
        differs = [
            f"{k} is {header['identity'].get(k)!r}, now {v!r}"
            for k, v in identity.items()
            if header["identity"].get(k) != v
        ]
        if differs:
            raise store.StoreError(
                f"{path} is the checkpoint of another run: {'; '.join(differs)}. Delete it to start anew"
            )
        groups: dict[str, dict[str, Tensor]] = {"model": {}, "best": {}, "adam": {}}
        for name, tensor in tensors.items():
            group, _, rest = name.partition(".")
            groups[group][rest] = tensor
        try:
            self.model.load_state_dict(groups["model"])
        except RuntimeError as error:
            first = str(error).partition("\n\t")[2].partition("\n")[0]
            raise store.StoreError(
                f"{path} holds the weights of another model: {first} Delete it to start anew"
            ) from error
        self.best = groups["best"]
        moments: dict[int, dict[str, Tensor]] = {}
        for name, tensor in groups["adam"].items():
            index, _, moment = name.partition(".")
            moments.setdefault(int(index), {})[moment] = tensor
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
        self.step, self.seconds, self.curve = header["step"], header["seconds"], type(self.curve)(**header["curve"])
        self.best_step, self.best_loss = header["best_step"], header["best_loss"]


def schedule(step: int, steps: int, lr: float, lr_final: float, warmup: int) -> float:
    """Linear warm-up, then half a cosine from ``lr`` to ``lr_final``."""
    if step < warmup:
        return lr * (step + 1) / warmup
    return lr_final + (lr - lr_final) * 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))


def fixed_windows(data: Trajectories, past_len: int, future_len: int, n_windows: int = 2000) -> Window:
    """The same windows at every validation: evenly spread over episodes and starts."""
    segment = data.padded(past_len)
    n_starts = data.horizon - future_len + 1
    if n_starts < 1 or not len(data):
        raise TrajectoryError(
            f"{len(data)} held-out episodes of {data.horizon} steps hold no window of {future_len} future steps; "
            f"collect some of at least {future_len} steps"
        )
    chosen = np.linspace(0, len(data) * n_starts - 1, min(n_windows, len(data) * n_starts)).round().astype(np.int64)
    index = torch.from_numpy(chosen)
    return windows(segment, index // n_starts, index % n_starts, past_len, future_len)


@torch.no_grad()
def validate(loss: Loss, window: Window, seed: int) -> float:
    """The loss on fixed windows with fixed noise."""
    return loss(window, torch.Generator().manual_seed(seed)).item()


def _copy(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in state.items()}
