"""Jobs of a grid as tasks: those that are finished are kept, the others run and leave a state, whatever happens to them."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from lslam.pipeline.storage import spool_of
from lslam.remote import RemotePath
from lslam.studies.grid import Job
from lslam.studies.runner import StudyProgress, Task, WorkerPool, run_tasks
from lslam.studies.states import State, is_reusable, read_state, write_state
from lslam.studies.subjects import used
from lslam.studies.worker import WorkerContext, execute

log = logging.getLogger("lslam")
# Scans of a recording, when only the order of its runs by length matters.
_MANY = 10**6
_ASKED = 32


def finished(jobs: Sequence[Job]) -> set[Path]:
    """Folders of the jobs that were run before by the same configuration, input and version."""
    # Of storage, where each answer takes its time, many are asked for together.
    with ThreadPoolExecutor(_ASKED if any(isinstance(job.folder, RemotePath) for job in jobs) else 1) as pool:
        known = pool.map(lambda job: is_reusable(job.state_file, job.folder, job.digest), jobs)
        return {job.folder for job, is_known in zip(jobs, known, strict=True) if is_known}


def pool_of(most_at_once: int, count: int, *, is_persistent: bool = False, tries: int = 1) -> WorkerPool:
    """Who makes `count` runs when the user asks for `most_at_once`: no more than there are cores."""
    cores = os.cpu_count() or 1
    at_once = max(1, min(most_at_once, cores, count))
    if most_at_once > cores:
        log.info(
            "%d jobs are asked for: this machine has %d cores, so %d runs go at once", most_at_once, cores, at_once
        )
    return WorkerPool(at_once, is_persistent, tries)


def run_jobs(
    jobs: Sequence[Job],
    pool: WorkerPool,
    progress: StudyProgress,
    title: str = "comparing",
    on_done: Callable[[Job], None] = lambda job: None,
    work: Callable[[Job, WorkerContext], None] = execute,
) -> None:
    """Run jobs in processes beside this one; on_done(job) is called here once per job, when its state is there.

    Several at once begin with those that use most scans. Every job then has a state file; one whose process died is
    `crashed`. KeyboardInterrupt ends all that run.
    """
    if not jobs:
        return
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0
    context = WorkerContext(pool.at_once, load, pool.at_once == 1 or pool.is_persistent, pool.is_persistent)
    for job in jobs:
        clear_attempt(job)
    if pool.at_once > 1:  # a long one begun last would keep one process busy while the others have no more to do
        jobs = sorted(jobs, key=lambda job: used(_MANY, job.config.input), reverse=True)
    tasks = [
        Task(
            job.name, partial(work, job, context), said_file(job.folder),
            str(job.path) if pool.is_persistent else "",
        )
        for job in jobs
    ]  # fmt: skip

    def on_end(index: int, cause: str) -> None:
        ensure_state(jobs[index], cause, context)
        on_done(jobs[index])
        progress.on_step(jobs[index].name)

    progress.on_start(title, len(jobs), "runs")
    run_tasks(tasks, pool, lambda index: log.debug("%s begins", jobs[index].name), on_end)


def said_file(folder: Path) -> Path:
    """Where what a process prints is kept that makes the run in `folder`: beside it, on this machine."""
    place = spool_of(folder) if isinstance(folder, RemotePath) else folder
    return place.with_name(f"{place.name}.out")


def ensure_state(job: Job, cause: str, context: WorkerContext) -> None:
    """See to it that a job that was run has a state, and say so when it went wrong."""
    state = read_state(job.state_file)
    if state is None:
        reason = cause or "the process left no result"
        state = State(job.digest, "crashed", reason, context.at_once, context.load, is_alone=context.is_alone)
        write_state(job.state_file, state)
    if state.status not in ("done", "degraded"):
        log.warning("%s %s: %s", job.name, state.status, state.reason)


def clear_attempt(job: Job) -> None:
    """What an earlier attempt left may be no run at all: a folder without a manifest must not stand in the way."""
    if not isinstance(job.folder, RemotePath) and job.folder.is_dir() and not (job.folder / "manifest.json").is_file():
        shutil.rmtree(job.folder, ignore_errors=True)
    job.state_file.unlink(missing_ok=True)
