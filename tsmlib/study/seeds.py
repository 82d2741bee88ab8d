"""Things that runs of several seeds make as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from tsmlib.storage.files import StoreError
from tsmlib.study.runs import Run
from tsmlib.training.checkpoint import TrainingStopped

T = TypeVar("T")


def require_seeds(runs: Sequence[Run]) -> None:
    """ValueError for runs of one seed, or of several scales or devices."""
    if len({run.seed for run in runs}) < len(runs) or len({(run.scale, run.device) for run in runs}) != 1:
        given = ", ".join(f"{run.scale} {run.seed} on {run.device}" for run in runs)
        raise ValueError(f"found runs of {given or 'no seed'}; expected different seeds, one scale and one device")


def make_as_one(
    what: str, runs: Sequence[Run], missing: Callable[[Run], bool], together: Callable[[Sequence[Run]], object],
    alone: Callable[[Run], T],
) -> list[T]:  # fmt: skip
    """What ``alone`` finds or makes for each run, where those that lack it first make it ``together``.

    Where that is not possible, with one seed whose loss is not finite for instance or too little memory, it is said,
    and they make it one after another; TrainingStopped for the first that could not, when the others are there.
    ValueError of ``require_seeds``.
    """
    require_seeds(runs)
    lacking = [run for run in runs if missing(run)]
    if len(lacking) > 1:
        try:
            together(lacking)
        except StoreError:
            raise
        except (TrainingStopped, torch.OutOfMemoryError, ValueError) as error:
            seeds = ", ".join(str(run.seed) for run in lacking)
            print(f"{what} of seeds {seeds} is not made as one, but one by one: {error}")
    found, stopped = list[T](), list[TrainingStopped]()
    for run in runs:
        try:
            found.append(alone(run))
        except TrainingStopped as error:
            stopped.append(error)
    if stopped:
        raise stopped[0]
    return found
