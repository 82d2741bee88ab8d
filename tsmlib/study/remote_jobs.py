"""Workarounds for Snakemake's executor for Slurm, which may forget jobs, and waits for ever for those that are held."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Protocol


class Job(Protocol):
    """What is asked of a submitted job."""

    external_jobid: str | None


def ask_again(executor: type) -> None:
    """Change an executor class of Snakemake's: jobs of which a check of their status says nothing are asked of again.

    ``check_active_jobs`` is given all jobs, reports those that ended, and returns those that run; the others are
    dropped. That of snakemake-executor-plugin-slurm 2.8 returns none where no command for the status succeeded, as
    while a controller is away and sacct, which it asks then, keeps no accounts: the workflow would wait for ever.
    Jobs that Slurm holds are cancelled first (``cancel_held``), so that Snakemake tries them again.
    """
    check: Callable[[object, Sequence[Job]], AsyncIterator[Job]] = executor.check_active_jobs  # type: ignore[attr-defined]
    ended = set[str | None]()

    def noted(report: Callable[..., None]) -> Callable[..., None]:
        def noting(self: object, job: Job, *given: object, **named: object) -> None:
            ended.add(job.external_jobid)
            report(self, job, *given, **named)

        return noting

    async def checked(self: object, active_jobs: Sequence[Job]) -> AsyncIterator[Job]:
        running = set[str | None]()
        await asyncio.to_thread(cancel_held, active_jobs)
        async for job in check(self, active_jobs):
            running.add(job.external_jobid)
            yield job
        for job in active_jobs:
            if job.external_jobid not in running | ended:
                yield job

    for name in ("report_job_success", "report_job_error"):
        setattr(executor, name, noted(getattr(executor, name)))
    executor.check_active_jobs = checked  # type: ignore[attr-defined]


def cancel_held(jobs: Sequence[Job]) -> None:
    """Cancel those jobs that Slurm put back into its queue and holds, as one whose node failed twice may be: nobody but
    a person would let them run."""
    told = subprocess.run(
        ["squeue", "--noheader", "--me", "--states=PENDING", "--format=%i|%r"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    own = {job.external_jobid for job in jobs}
    for line in told.stdout.splitlines():
        name, _, reason = line.partition("|")
        if name in own and {"requeued", "held"} <= set(reason.replace("_", " ").split()):
            subprocess.run(["scancel", name], check=False)
