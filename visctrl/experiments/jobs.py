"""Many runs on the local cores. The result does not depend on the number of workers."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Job:
    """One run: a scenario and settings laid over it, each as ``--set`` takes it.

    out : run directory, or None to keep only the summary.
    image_motion : also keep where the features were in the image, in the run directory (see
        `visctrl.experiments.image_motion`).
    """

    scenario: str
    settings: tuple[str, ...] = ()
    out: Path | None = None
    image_motion: bool = False


def run_job(job: Job) -> dict[str, Any]:
    """Run one job and return its summary (see `visctrl.runtime.summary.summarise`).

    Raises
    ------
    InputError
        The scenario or a setting cannot be used.
    """
    from visctrl.config import load_scenario, parse_setting
    from visctrl.runtime.plan import make_plan
    from visctrl.runtime.registry import REGISTRIES
    from visctrl.runtime.session import run_session

    overrides = [parse_setting(text) for text in job.settings]
    plan = make_plan(load_scenario(job.scenario, overrides, REGISTRIES.backends.known()))
    if not job.image_motion or job.out is None:
        return run_session(plan, job.out).summary
    from visctrl.experiments.image_motion import ImageMotion

    motion = ImageMotion()
    summary = run_session(plan, job.out, observers=[motion]).summary
    motion.save(job.out)
    return summary


def run_jobs(
    jobs: Sequence[Job], workers: int, on_done: Callable[[int, dict[str, Any]], None]
) -> list[dict[str, Any]]:
    """Run jobs in fresh processes and return their summaries in the jobs' order.

    Parameters
    ----------
    jobs : sequence of Job
    workers : int
        Processes at a time.
    on_done : callable
        Called in this process as (index, summary) whenever a run has ended.
    """
    results: dict[int, dict[str, Any]] = {}
    # Spawned, not forked: a forked child would share PyBullet's and OpenCV's threads and locks.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_one_thread) as pool:
        futures = {pool.submit(run_job, job): index for index, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                index = futures[future]
                results[index] = future.result()
                on_done(index, results[index])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [results[index] for index in range(len(jobs))]


def default_workers() -> int:
    """Return how many runs go side by side: one a core."""
    return os.cpu_count() or 1


def _one_thread() -> None:
    """Keep one worker to one core; they are as many as there are cores."""
    import cv2

    cv2.setNumThreads(1)
