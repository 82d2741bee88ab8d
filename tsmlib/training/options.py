"""Options of a training: its windows and the schedule of its learning rates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torch import nn

from tsmlib.checks import require_count, require_number
from tsmlib.trajectory import Trajectories


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
        warmup: updates in which the learning rates rise from zero; None for 100, and no more than a
            tenth of all.
        muon: peak learning rate of Muon for the weight matrices, beside Adam for all else; it
            follows the schedule of lr. 0: Adam for everything.
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
    warmup: int | None = None
    muon: float = 0.0
    span: tuple[float, float] = (0.0, 1.0)
    clip: float = 1.0
    validate_every: int = 250
    patience: int = 0

    def __post_init__(self) -> None:
        for name in ("past_len", "future_len", "steps", "batch_size", "validate_every"):
            if (value := getattr(self, name)) is not None or not name.endswith("_len"):
                require_count(name, value)
        require_count("patience", self.patience, least=0)
        if self.warmup is not None:
            require_count("warmup", self.warmup, least=0)
        for name in ("lr_final", "muon"):
            require_number(name, getattr(self, name), 0)
        require_number("lr", self.lr, 0, above=True)
        if not isinstance(self.clip, float) or self.clip != math.inf:
            require_number("clip", self.clip, 0, above=True)
        if not isinstance(self.span, tuple | list) or len(self.span) != 2:
            raise TypeError(f"span is {self.span!r:.80}; expected two numbers, as in (0.0, 1.0)")
        first, last = (require_number("span", value, 0, 1) for value in self.span)
        if first >= last:
            raise ValueError(f"span is {self.span}; expected the first number below the second")

    @property
    def lengths(self) -> tuple[int, int]:
        """Steps of the past and of the future of a window, both known."""
        if self.past_len is None or self.future_len is None:
            raise ValueError("past_len or future_len is None; options.for_model(model, data) asks")
        return self.past_len, self.future_len

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
        warmup = min(100, self.steps // 10) if self.warmup is None else self.warmup
        return replace(self, past_len=past_len, future_len=future_len, warmup=warmup)


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
