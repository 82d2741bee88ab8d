"""fit(): one flat loop for every model and the prior."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from tsmlib.storage.artifacts import digest
from tsmlib.storage.files import only_writer
from tsmlib.training.checkpoint import TrainingHistory, TrainingState
from tsmlib.trajectory import Trajectories, TrajectoryError, Window, batches, windows

Loss = Callable[[Window, torch.Generator], Tensor]


@torch.enable_grad()  # an interrupt within torch.no_grad, in a notebook, may leave gradients off
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
    device: str = "cpu",  # where it is trained, such as "cuda"; the model comes back to the processor
    checkpoint: Path | None = None,  # a folder of its own
    progress: str = "",  # title of the progress bar; none without
) -> TrainingHistory:
    """Minimise ``loss`` over random windows with Adam; leave the weights with the best validation loss in ``model``.

    Windows and noise are functions of (seed, step), so a run that is resumed from ``checkpoint``, a folder, continues
    as if it had not stopped. Raises TrainingStopped at the first loss or gradient that is not finite, with the best
    weights so far in ``model``, and StoreError for a checkpoint of another run, or one that another process writes.
    """
    if steps < 1 or batch_size < 1 or validate_every < 1:
        raise ValueError(f"steps {steps}, batch_size {batch_size}, validate_every {validate_every}: expected positive")
    identity = dict(
        past_len=past_len, future_len=future_len, steps=steps, batch_size=batch_size, lr=lr, lr_final=lr_final,
        warmup=warmup, clip=clip, validate_every=validate_every, patience=patience, seed=seed, bf16=bf16,
        loss=getattr(loss, "__name__", "loss"), env=train.env, episodes=len(train),
        data=[_digest(data) for data in (train, validation)],
    )  # fmt: skip
    generator, kind = torch.Generator(), torch.device(device).type
    held_out = Window(*(segment.to(device) for segment in fixed_windows(validation, past_len, future_len)))
    draw = batches(
        train.padded(past_len).to(device),
        past_len=past_len, future_len=future_len, batch_size=batch_size, generator=generator,
    )  # fmt: skip
    with contextlib.ExitStack() as stack:
        stack.callback(model.to, "cpu")
        optimizer = torch.optim.Adam(model.to(device).parameters(), lr=lr, fused=True)
        state = TrainingState(model, optimizer)
        torch.set_autocast_enabled(kind, False)  # or this on
        stack.callback(torch.set_autocast_enabled, kind, False)
        if checkpoint is not None:
            stack.enter_context(only_writer(checkpoint, f"training, seed {seed}"))
            state.load(checkpoint, identity)
        began, total, counted = time.process_time() - state.seconds, 0.0, 0
        bar = stack.enter_context(
            tqdm(total=steps, initial=state.step, desc=progress, disable=not progress, mininterval=1.0)
        )
        for step in range(state.step, steps):
            if patience and step - state.best_step >= patience * validate_every:
                break
            generator.manual_seed(seed * 1_000_003 + step)
            for group in optimizer.param_groups:
                group["lr"] = schedule(step, steps, lr, lr_final, warmup)
            torch.clear_autocast_cache()  # which one left on would never clear
            with torch.autocast(kind, torch.bfloat16, enabled=bf16):
                value = loss(next(draw), generator)
            if not torch.isfinite(value):
                raise state.stopped("training loss", value.item(), f"{step} of {steps}", lr)
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            norm = nn.utils.clip_grad_norm_(model.parameters(), clip)
            if not torch.isfinite(norm):  # before it reaches the weights
                raise state.stopped("gradient", norm.item(), f"{step} of {steps}", lr)
            optimizer.step()
            total, counted = total + value.item(), counted + 1
            bar.update()
            if (step + 1) % validate_every == 0 or step + 1 == steps:
                state.step, state.seconds = step + 1, time.process_time() - began
                held_out_loss = validate(loss, held_out, seed)
                if not math.isfinite(held_out_loss):
                    raise state.stopped("validation loss", held_out_loss, f"{step + 1} of {steps}", lr)
                state.record(total / counted, held_out_loss)
                bar.set_postfix(train=state.curve.train[-1], validation=state.curve.validation[-1])
                total, counted = 0.0, 0
                if checkpoint is not None:
                    state.save(checkpoint, identity)
    state.restore_best()
    return state.curve


def _digest(data: Trajectories) -> str:
    return digest({"states": torch.from_numpy(data.states), "actions": torch.from_numpy(data.actions)})[:16]


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
