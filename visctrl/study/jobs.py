"""Many runs on the local cores. The result does not depend on the number of workers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visctrl.robots.errors import VisctrlError
from visctrl.study.workers import Died, LocalWorkers, default_workers

if TYPE_CHECKING:
    from visctrl.runtime.plan import Plan
    from visctrl.runtime.run_directory import RunDirectory
__all__ = ["Job", "default_workers", "run_job", "run_jobs"]


@dataclass(frozen=True)
class Job:
    """One run: a scenario and settings laid over it, each as ``--set`` takes it.

    out : run directory, or None to keep only the summary.
    image_motion : also keep where the features were in the image, in the run directory (see
        `visctrl.reproduce.image_motion`).
    """

    scenario: str
    settings: tuple[str, ...] = ()
    out: Path | None = None
    image_motion: bool = False


class WorkerDiedError(VisctrlError):
    """The process of a run died, and died again when it was repeated."""

    exit_code = 3


def plan_of(job: Job) -> Plan:
    """Return the plan of a job's run.

    Raises
    ------
    InputError
        The scenario or a setting cannot be used.
    """
    from visctrl.runtime.config import load_scenario, parse_setting
    from visctrl.runtime.plan import make_plan
    from visctrl.runtime.registry import REGISTRIES

    overrides = [parse_setting(text) for text in job.settings]
    return make_plan(load_scenario(job.scenario, overrides, REGISTRIES.backends.known()))


def directory_of(job: Job) -> RunDirectory | None:
    """Return where the run's files go: those of the same job, run earlier, are replaced.

    Raises
    ------
    InputError, DiskError
        The directory holds something else, or cannot be written to.
    """
    from visctrl.runtime.run_directory import RunDirectory

    return None if job.out is None else RunDirectory(job.out, overwrite=True)


def run_job(job: Job) -> dict[str, Any]:
    """Run one job and return its summary (see `visctrl.runtime.summary.summarise`).

    Raises
    ------
    InputError
        The scenario or a setting cannot be used.
    """
    from visctrl.runtime.session import run_session

    plan, directory = plan_of(job), directory_of(job)
    if not job.image_motion or job.out is None:
        return run_session(plan, directory).summary
    from visctrl.reproduce.image_motion import ImageMotion

    motion = ImageMotion()
    summary = run_session(plan, directory, observers=[motion]).summary
    motion.save(job.out)
    return summary


def run_jobs(
    jobs: Sequence[Job],
    workers: int,
    on_done: Callable[[int, dict[str, Any]], None],
    work: Callable[[Job], dict[str, Any]] = run_job,
) -> list[dict[str, Any]]:
    """Run jobs in fresh processes and return their summaries in the jobs' order.

    Parameters
    ----------
    jobs : sequence of Job
    workers : int
        Processes at a time.
    on_done : callable
        Called in this process as (index, summary) whenever a run has ended.
    work : callable
        What a process does with a job: a function of some module.

    Raises
    ------
    WorkerDiedError
        The process of a run died twice; the message names the run.
    """
    results: dict[int, dict[str, Any]] = {}
    with closing(
        LocalWorkers(workers).each(partial(_run_numbered, work), list(enumerate(jobs)))
    ) as done:
        for (index, job), summary in done:
            if isinstance(summary, Died):
                named = " ".join((job.scenario, *job.settings))
                raise WorkerDiedError(f"run {index} ({named}): {summary.reason}")
            results[index] = summary
            on_done(index, summary)
    return [results[index] for index in range(len(jobs))]


def _run_numbered(
    work: Callable[[Job], dict[str, Any]], numbered: tuple[int, Job]
) -> dict[str, Any]:
    return work(numbered[1])
