"""fit(): one flat loop for every model and the prior."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from tsmlib.trajectory import Segment, Trajectories, Window, batches, windows

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

    def rows(self) -> list[dict[str, float]]:
        """One dict per validation."""
        return [
            dict(step=s, seconds=t, train=a, validation=b)
            for s, t, a, b in zip(self.step, self.seconds, self.train, self.validation, strict=True)
        ]


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
    warmup: int = 100,
    clip: float = 1.0,  # gradient norm: windows with contact have heavy tails
    validate_every: int = 250,
    patience: int = 0,  # validations without improvement before stopping early; 0: never
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: str = "",
) -> Curve:
    """Minimise ``loss`` over random windows with Adam; leave the weights with the best validation loss in ``model``.

    Windows are drawn as a function of (seed, step), so a resumed run continues as if it had not stopped.
    Raises TrainingStopped at the first loss that is not finite, with the best weights so far in ``model``.
    """
    optimizer = torch.optim.Adam(model.parameters(), lr=lr)
    state = Progress(model, optimizer)
    if checkpoint is not None:
        checkpoint.resume(state)
    generator = torch.Generator()
    data, held_out = train.padded(past_len), fixed_windows(validation, past_len, future_len)
    draw = batches(data, past_len=past_len, future_len=future_len, batch_size=batch_size, generator=generator)
    start, total, counted = time.perf_counter() - state.seconds, 0.0, 0
    bar = tqdm(total=steps, initial=state.step, desc=progress, disable=not progress, mininterval=1.0)
    for step in range(state.step, steps):
        generator.manual_seed(seed * 1_000_003 + step)
        for group in optimizer.param_groups:
            group["lr"] = schedule(step, steps, lr, lr_final, warmup)
        value = loss(next(draw), generator)
        if not torch.isfinite(value):
            state.restore_best()
            raise TrainingStopped(
                f"the training loss became {value.item()} at step {step} of {steps}; the weights of step "
                f"{state.best_step} are kept. Check the data, or train with a smaller lr than {lr:g}"
            )
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        nn.utils.clip_grad_norm_(model.parameters(), clip)
        optimizer.step()
        total, counted = total + value.item(), counted + 1
        bar.update()
        if (step + 1) % validate_every == 0 or step + 1 == steps:
            state.step, state.seconds = step + 1, time.perf_counter() - start
            state.record(total / counted, validate(loss, held_out, seed))
            bar.set_postfix(train=state.curve.train[-1], validation=state.curve.validation[-1])
            total, counted = 0.0, 0
            if checkpoint is not None:
                checkpoint.write(state)
            if patience and state.step - state.best_step >= patience * validate_every:
                break
    bar.close()
    state.restore_best()
    return state.curve


class Progress:
    """All that a run needs to continue: weights, Adam's moments, the step, the best weights and the curve so far."""

    def __init__(self, model: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        self.model, self.optimizer = model, optimizer
        self.step, self.seconds, self.curve = 0, 0.0, Curve()
        self.best, self.best_step, self.best_loss = _copy(model.state_dict()), 0, math.inf

    def record(self, train: float, validation: float) -> None:
        self.curve.step.append(self.step)
        self.curve.seconds.append(self.seconds)
        self.curve.train.append(train)
        self.curve.validation.append(validation)
        if validation < self.best_loss:
            self.best, self.best_step, self.best_loss = _copy(self.model.state_dict()), self.step, validation

    def restore_best(self) -> None:
        self.model.load_state_dict(self.best)


def schedule(step: int, steps: int, lr: float, lr_final: float, warmup: int) -> float:
    """Linear warm-up, then half a cosine from ``lr`` to ``lr_final``."""
    if step < warmup:
        return lr * (step + 1) / warmup
    return lr_final + (lr - lr_final) * 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))


def fixed_windows(data: Trajectories, past_len: int, future_len: int, n_windows: int = 2000) -> Window:
    """The same windows at every validation: evenly spread over episodes and starts."""
    segment = data.padded(past_len)
    n_starts = data.horizon - future_len + 1
    chosen = np.linspace(0, len(data) * n_starts - 1, min(n_windows, len(data) * n_starts)).round().astype(np.int64)
    index = torch.from_numpy(chosen)
    return windows(segment, index // n_starts, index % n_starts, past_len, future_len)


@torch.no_grad()
def validate(loss: Loss, window: Window, seed: int) -> float:
    """The loss on fixed windows with fixed noise."""
    return loss(window, torch.Generator().manual_seed(seed)).item()


def _copy(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in state.items()}
