"""Jobs of a grid as tasks: finished ones are kept, the others run, and each leaves a state even if it crashes."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from lslam.io.remote import RemotePath
from lslam.pipeline.run_folder import spool_of
from lslam.studies.grid import Job
from lslam.studies.results_csv import State, is_reusable, read_state, write_state
from lslam.studies.runner import StudyProgress, Task, WorkerPool, run_tasks
from lslam.studies.subjects import simulate_once, used
from lslam.studies.worker import WorkerContext, execute

log = logging.getLogger("lslam")
# Scans of a recording, when only the order of its runs by length matters.
_MANY = 10**6
_ASKED = 32


def finished(jobs: Sequence[Job]) -> set[Path]:
    """Folders of the jobs that were finished before by the same configuration, input and version."""
    # Of storage, where each answer takes its time, many are asked for together.
    with ThreadPoolExecutor(_ASKED if any(isinstance(job.folder, RemotePath) for job in jobs) else 1) as pool:
        known = pool.map(lambda job: is_reusable(job.state_file, job.folder, job.digest), jobs)
        return {job.folder for job, is_known in zip(jobs, known, strict=True) if is_known}


def pool_of(most_at_once: int, count: int, *, is_persistent: bool = False, tries: int = 1) -> WorkerPool:
    """Worker pool for `count` runs, of at most `most_at_once` at once and no more than there are cores."""
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
    """Run jobs in worker processes; on_done(job) is called in this process once per job, when its state file exists.

    With several at once, the longest jobs begin. A job whose process died has the state `crashed`. KeyboardInterrupt ends all
    running jobs.
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
            job.name,
            partial(work, job, context),
            said_file(job.folder),
            str(job.path) if pool.is_persistent else "",
        )
        for job in jobs
    ]

    def on_end(index: int, cause: str) -> None:
        ensure_state(jobs[index], cause, context)
        on_done(jobs[index])
        progress.on_step(jobs[index].name)

    progress.on_start(title, len(jobs), "runs", pool.at_once)
    run_tasks(tasks, pool, lambda index: log.debug("%s begins", jobs[index].name), on_end)


def said_file(folder: Path) -> Path:
    """File for the output of the process of the run in `folder`, beside it, on this machine."""
    place = spool_of(folder) if isinstance(folder, RemotePath) else folder
    return place.with_name(f"{place.name}.out")


def ensure_state(job: Job, cause: str, context: WorkerContext) -> None:
    """Write a state for a job that left none, and log its failure."""
    state = read_state(job.state_file)
    if state is None:
        reason = cause or "the process left no result"
        state = State(job.digest, "crashed", reason, context.at_once, context.load, is_alone=context.is_alone)
        write_state(job.state_file, state)
    if state.status not in ("done", "degraded"):
        log.warning("%s %s: %s", job.name, state.status, state.reason)


def clear_attempt(job: Job) -> None:
    """Remove remains of an earlier attempt: a folder without a manifest would block the run."""
    if not isinstance(job.folder, RemotePath) and job.folder.is_dir() and not (job.folder / "manifest.json").is_file():
        shutil.rmtree(job.folder, ignore_errors=True)
    job.state_file.unlink(missing_ok=True)


class Engine(Protocol):
    """Interface for making runs, `at_once` of them together."""

    @property
    def at_once(self) -> int:
        """Runs made together, at most."""
        ...

    def prepare(self, jobs: Sequence[Job], progress: StudyProgress) -> None:
        """Do work that several jobs need, once."""
        ...

    def run(self, jobs: Sequence[Job], progress: StudyProgress, on_done: Callable[[Job], None]) -> None:
        """Make every run; on_done(job) is called here once per job, when its state file is on this machine."""
        ...


@dataclass(frozen=True)
class Local:
    """Engine of worker processes on this machine, at most `most_at_once` and no more than there are cores.

    is_persistent : processes make several runs, with kernels compiled, data cached and one thread
    title : of the progress bar
    """

    most_at_once: int = 1
    is_persistent: bool = True
    title: str = "studying"

    @property
    def at_once(self) -> int:
        """Number of worker processes."""
        return min(self.most_at_once, os.cpu_count() or 1)

    def prepare(self, jobs: Sequence[Job], progress: StudyProgress) -> None:
        """Simulate the missing scenes, in parallel."""
        simulate_scenes(jobs, self.most_at_once, progress)

    def run(self, jobs: Sequence[Job], progress: StudyProgress, on_done: Callable[[Job], None]) -> None:
        """As `run_jobs`; a run whose process died is tried once more."""
        run_jobs(
            jobs,
            pool_of(self.most_at_once, len(jobs), is_persistent=self.is_persistent, tries=2),
            progress,
            self.title,
            on_done,
        )


def simulate_scenes(jobs: Sequence[Job], most_at_once: int, progress: StudyProgress) -> None:
    """Simulate the missing scenes of jobs, each in a process of its own.

    A failed simulation is tried again by its runs, which then report the reason.
    """
    missing = {job.path: job for job in jobs if job.scene is not None and not job.path.is_dir()}
    if not missing:
        return
    tasks = []
    for path, job in missing.items():
        assert job.scene is not None
        said = path.parents[1].with_name(f"{path.parents[1].name}.out")
        parent = path.parents[2]
        tasks.append(Task(f"{job.scene.name} {job.seed}", partial(simulate_once, job.scene, job.seed, parent), said))
    pool = pool_of(most_at_once, len(tasks))
    progress.on_start("simulating", len(tasks), "scenarios", pool.at_once)

    def on_end(index: int, cause: str) -> None:
        log.debug("%s: %s", tasks[index].name, cause or "simulated")
        progress.on_step(tasks[index].name)

    run_tasks(tasks, pool, lambda index: None, on_end)
