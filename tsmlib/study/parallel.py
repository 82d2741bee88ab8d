"""Parallel processes for models, plans and scores of a run; torch has one thread in each.

Two threads on one small network may stand in each other's way; two networks on a thread each use both cores.
"""

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any

import torch
from tqdm.auto import tqdm

from tsmlib.study.runs import Run, RunError


def precompute(
    run: Run, calls: Sequence[tuple[Callable[..., object], *tuple[object, ...]]], *, progress: str = "ahead"
) -> None:
    """Do ``make(run, *arguments)`` for each (make, *arguments) of ``calls``, as many at a time as there are cores.

    make: a function that keeps what it makes in the run's folder, such as ``plan``. Calls must not need each other's
    results. At scale paper alone; elsewhere the notebook makes each thing when it comes to it. The first error, or an
    interrupt, ends it when the calls under way have ended; what they made is kept. Raises RunError where a worker died.
    """
    workers = min(cores(), len(calls), 61)  # Windows allows no more
    if run.scale != "paper" or workers < 2:
        return
    waiting, under_way = iter(calls), set[Future[None]]()
    spawn = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin) as pool,
        tqdm(total=len(calls), desc=progress) as bar,
    ):
        while True:
            under_way |= {pool.submit(_make, run, *call) for call in islice(waiting, workers - len(under_way))}
            if not under_way:
                break
            done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            for call in done:
                try:
                    call.result()
                except BrokenProcessPool as error:
                    raise RunError(
                        "a process that made things ahead died, perhaps for want of memory. Run it again: trainings "
                        "go on where they were"
                    ) from error
                bar.update()


def _make(run: Run, make: Callable[..., Any], *arguments: Any) -> None:
    """In the worker. What is made stays in the run's folder; only that it is done goes back."""
    make(run, *arguments)


def _begin() -> None:
    """One thread for each worker, which ends when the process that started it does.

    Its progress bars would overwrite those of the others; the notebook's says how many calls are done.
    """
    torch.set_num_threads(1)
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - as long as the process lives
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
