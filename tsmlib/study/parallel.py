"""Several things of a run made at the same time, by processes of one thread each.

Two threads on one small network gain little over one; two networks on a thread each gain nearly all of the second core.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import torch
from tqdm.auto import tqdm

from tsmlib.runs import Run


def ahead(run: Run, calls: Sequence[tuple[Any, ...]], *, progress: str = "ahead") -> None:
    """Do ``make(run, *arguments)`` for each (make, *arguments) of ``calls``, as many at a time as there are cores.

    make: a function of ``study`` that keeps what it makes in the run's folder, such as ``load_or_train``, where the
    notebook then finds it. Calls must not need each other's results: models first, then what is made with them. At
    scale paper alone; elsewhere the notebook makes each thing when it comes to it. The first error is raised when the
    calls under way have ended; what they made is kept.
    """
    workers = min(_cores(), len(calls))
    if run.scale != "paper" or workers < 2:
        return
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin) as pool:
        under_way = [pool.submit(_make, run, *call) for call in calls]
        try:
            for done in tqdm(as_completed(under_way), total=len(calls), desc=progress):
                done.result()
        except BaseException:  # an interrupt too: no more is begun
            pool.shutdown(cancel_futures=True)
            raise


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


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
