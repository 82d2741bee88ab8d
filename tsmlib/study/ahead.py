"""Several things of a run made at the same time, by processes of one thread each.

Two threads on one small network gain little over one; two networks on a thread each gain nearly all of the second core.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import torch
from tqdm.auto import tqdm

from tsmlib.runs import Run


def ahead(run: Run, make: Callable[..., Any], things: Sequence[tuple[Any, ...]], *, progress: str = "") -> None:
    """Call ``make(run, *thing)`` for each of ``things``, as many at a time as there are cores, in other processes.

    make: a function of ``study`` that keeps what it makes in the run's folder, such as ``load_or_train``, where the
    notebook then finds it. Things must not depend on each other: models first, then what is made with them. At scale
    paper alone; elsewhere the notebook makes each thing when it comes to it. The first error is raised when the others
    have ended; what they made is kept.
    """
    workers = min(_cores(), len(things))
    if run.scale != "paper" or workers < 2:
        return
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin) as pool:
        calls = [pool.submit(_call, make, run, *thing) for thing in things]
        try:
            for call in tqdm(as_completed(calls), total=len(calls), desc=progress or make.__name__):
                call.result()
        except BaseException:  # an interrupt too: no more is begun
            pool.shutdown(cancel_futures=True)
            raise


def _call(make: Callable[..., Any], run: Run, *thing: Any) -> None:
    """In the worker. What is made stays in the run's folder; only that it is done goes back."""
    make(run, *thing)


def _begin() -> None:
    """One thread for each worker, which ends when the process that started it does."""
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
