"""Jobs of a grid as tasks: those that are finished are kept, the others run and leave a state, whatever happens to them."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from lslam.studies.grid import Job
from lslam.studies.plan import Follow
from lslam.studies.runner import Task, run_tasks
from lslam.studies.states import State, is_reusable, read_state, write_state
from lslam.studies.worker import execute

log = logging.getLogger("lslam")


def finished(jobs: Sequence[Job]) -> set[Path]:
    """Folders of the jobs that were run before by the same configuration, input and version."""
    return {job.folder for job in jobs if is_reusable(job.state_file, job.folder, job.digest)}


def run_jobs(
    jobs: Sequence[Job], most_at_once: int, follow: Follow, work: Callable[[Job, int, float], None] = execute
) -> None:
    """Run jobs, each in a process of its own, at most `most_at_once` and no more than there are cores.

    Every job then has a state file; a process that died is `crashed`. KeyboardInterrupt ends all that run.
    """
    if not jobs:
        return
    cores = os.cpu_count() or 1
    at_once = min(most_at_once, cores, len(jobs))
    if most_at_once > cores:
        log.info(
            "%d jobs are asked for: this machine has %d cores, so %d runs go at once", most_at_once, cores, at_once
        )
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0
    for job in jobs:
        _make_room(job)
    tasks = [
        Task(job.name, partial(work, job, at_once, load), job.folder.with_name(f"{job.folder.name}.out"))
        for job in jobs
    ]

    def on_end(index: int, cause: str) -> None:
        job = jobs[index]
        state = read_state(job.state_file)
        if state is None:
            state = State(job.digest, "crashed", cause or "the process left no result", at_once, load)
            write_state(job.state_file, state)
        if state.status not in ("done", "degraded"):
            log.warning("%s %s: %s", job.name, state.status, state.reason)
        follow.on_step(job.name)

    follow.on_start("comparing", len(jobs), "runs")
    run_tasks(tasks, at_once, lambda index: log.debug("%s begins", jobs[index].name), on_end)


def _make_room(job: Job) -> None:
    """What an earlier attempt left may be no run at all: a folder without a manifest must not stand in the way."""
    if job.folder.is_dir() and not (job.folder / "manifest.json").is_file():
        shutil.rmtree(job.folder, ignore_errors=True)
    job.state_file.unlink(missing_ok=True)
