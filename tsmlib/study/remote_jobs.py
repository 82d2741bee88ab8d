"""A workaround for Snakemake's executor for Slurm, which may forget jobs."""

from __future__ import annotations

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
        async for job in check(self, active_jobs):
            running.add(job.external_jobid)
            yield job
        for job in active_jobs:
            if job.external_jobid not in running | ended:
                yield job

    for name in ("report_job_success", "report_job_error"):
        setattr(executor, name, noted(getattr(executor, name)))
    executor.check_active_jobs = checked  # type: ignore[attr-defined]
