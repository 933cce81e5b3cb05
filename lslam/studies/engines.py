"""What makes the runs of a study: processes of this machine, or the workers of a cluster (`cluster`)."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from lslam.studies.grid import Job
from lslam.studies.jobs import pool_of, run_jobs
from lslam.studies.runner import StudyProgress, Task, run_tasks
from lslam.studies.scenes import simulate_once

log = logging.getLogger("lslam")


class Engine(Protocol):
    """Makes runs somewhere, `at_once` of them together."""

    @property
    def at_once(self) -> int:
        """Runs made together, at most."""
        ...

    def prepare(self, jobs: Sequence[Job], progress: StudyProgress) -> None:
        """Do what several jobs need, once."""
        ...

    def run(self, jobs: Sequence[Job], progress: StudyProgress, on_done: Callable[[Job], None]) -> None:
        """Make every run; on_done(job) is called here, once per job, when its state is beside its folder on this machine."""
        ...


@dataclass(frozen=True)
class Local:
    """Processes of this machine, `most_at_once` of them and no more than there are cores.

    is_persistent : they go on with one run after the other, with kernels compiled, data read and one thread
    title : of the progress bar
    """

    most_at_once: int = 1
    is_persistent: bool = True
    title: str = "studying"

    @property
    def at_once(self) -> int:
        """As many as are asked for and there are cores."""
        return min(self.most_at_once, os.cpu_count() or 1)

    def prepare(self, jobs: Sequence[Job], progress: StudyProgress) -> None:
        """Simulate what is not there yet, scenarios side by side."""
        simulate_scenes(jobs, self.most_at_once, progress)

    def run(self, jobs: Sequence[Job], progress: StudyProgress, on_done: Callable[[Job], None]) -> None:
        """As `run_jobs`; a run whose process died is begun once more."""
        run_jobs(
            jobs,
            pool_of(self.most_at_once, len(jobs), is_persistent=self.is_persistent, tries=2),
            progress,
            self.title,
            on_done,
        )


def simulate_scenes(jobs: Sequence[Job], most_at_once: int, progress: StudyProgress) -> None:
    """Simulate the scenes of jobs that are not there yet, each in a process of its own.

    What cannot be simulated is tried again by its runs, which then say why they failed.
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
    progress.on_start("simulating", len(tasks), "scenarios")

    def on_end(index: int, cause: str) -> None:
        log.debug("%s: %s", tasks[index].name, cause or "simulated")
        progress.on_step(tasks[index].name)

    run_tasks(tasks, pool_of(most_at_once, len(tasks)), lambda index: None, on_end)
