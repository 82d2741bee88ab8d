"""Parallel processes for the jobs of a run; torch has one thread in each.

Two threads on one small network may stand in each other's way; two networks on a thread each use both cores.
"""

import multiprocessing
import os
import sys
import threading
from collections.abc import Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

import torch
from tqdm.auto import tqdm

from tsmlib.study.jobs import Job, complete
from tsmlib.study.runs import Run, RunError


def precompute(run: Run, jobs: Iterable[Job], *, progress: str = "jobs") -> None:
    """Make jobs, and what they need before them, as many at a time as there are cores.

    Of those that could begin, the longest first. At scale paper alone; elsewhere the notebook makes each thing when it
    comes to it. The first error, or an interrupt, ends it when the jobs under way have ended; what they made is kept.
    Raises RunError where a worker died.
    """
    wanted = complete(run, jobs)
    workers = min(cores(), len(wanted), 61)  # Windows allows no more
    if run.scale != "paper" or workers < 2:
        return
    waiting = dict(sorted(wanted.items(), key=lambda item: -item[1].seconds(run)))
    under_way: dict[Future[None], str] = {}
    spawn = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin) as pool,
        tqdm(total=len(waiting), desc=progress) as bar,
    ):
        while waiting or under_way:
            missing = {*waiting, *under_way.values()}
            ready = [job for job in waiting.values() if not missing & {other.name for other in job.needs(run)}]
            for job in ready[: workers - len(under_way)]:
                under_way[pool.submit(_make, run, waiting.pop(job.name))] = job.name
            done, _ = wait(under_way, return_when=FIRST_COMPLETED)
            for call in done:
                try:
                    call.result()
                except BrokenProcessPool as error:
                    raise RunError(
                        "a process that made things ahead died, perhaps for want of memory. Run it again: trainings "
                        "go on where they were"
                    ) from error
                del under_way[call]
                bar.update()


def _make(run: Run, job: Job) -> None:
    """In the worker. What is made stays in the run's folder; only that it is done goes back."""
    job.make(run)


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
