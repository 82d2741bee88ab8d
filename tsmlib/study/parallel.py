"""Parallel processes for the jobs of a run; torch has one thread in each.

Two threads on one small network may stand in each other's way; two networks on a thread each use both cores.
"""

import json
import multiprocessing
import os
import re
import sys
import threading
from collections.abc import Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

import torch
from tqdm.auto import tqdm

from tsmlib.storage import files
from tsmlib.storage.provenance import provenance
from tsmlib.study.jobs import Job, complete
from tsmlib.study.parameters import ParameterError
from tsmlib.study.runs import Run, RunError


def precompute(run: Run, jobs: Iterable[Job], *, progress: str = "jobs") -> None:
    """Make jobs, and what they need before them, as many at a time as ``cores`` says.

    Of those that could begin, the longest first. At scale paper alone; elsewhere the notebook makes each thing when it
    comes to it. No process is started where the last call for the notebook made the same jobs and no file changed since
    (``_state``). The first error, or an interrupt, ends it when the jobs under way have ended; what they made is kept.
    Raises RunError where a worker died, ParameterError for a wrong TSM_JOBS.
    """
    wanted = complete(run, jobs)
    workers = min(cores(), len(wanted), 61)  # Windows allows no more
    if run.scale != "paper" or workers < 2:
        return
    last = run.dir / ".precomputed" / f"{run.notebook}.json"
    if last.exists() and last.read_text() == _state(run, wanted):
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
    files.write_bytes(last, _state(run, wanted).encode())


def _state(run: Run, jobs: Mapping[str, Job]) -> str:
    """All that decides whether jobs are still made: the code, their settings, and when their files were written."""
    paths = {name: run.dir / f"{name}.safetensors" for name in jobs}
    written = {name: path.stat().st_mtime_ns if path.exists() else None for name, path in paths.items()}
    stated = {name: [job.settings(run), written[name]] for name, job in jobs.items()}
    return json.dumps({"code": provenance()["code"], "jobs": stated}, sort_keys=True)


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
    """Processes at a time: TSM_JOBS, else the CPU cores that this process may use."""
    if text := os.environ.get("TSM_JOBS", ""):
        if not re.fullmatch("[1-9][0-9]{0,5}", text, re.ASCII):
            raise ParameterError(f"TSM_JOBS is {text!r:.80}, expected a whole number from 1 to 999999, or nothing.")
        return int(text)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
