"""Jobs of a grid as tasks: finished ones are kept, the others run, and each leaves a state and a row as it ends."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from lslam.core.config.config import read_toml
from lslam.core.errors import InterruptedRunError, LslamError, OutputExistsError
from lslam.core.types.study import StudyRow
from lslam.core.untrusted import parse_toml
from lslam.io.formats.atomic import write_text
from lslam.io.remote import RemotePath
from lslam.pipeline.run_folder import spool_of
from lslam.studies.grid import Job
from lslam.studies.options import WORDS, OutputOptions, make_output, release_output
from lslam.studies.results import Results
from lslam.studies.results_csv import State, is_reusable, read_state, write_state
from lslam.studies.runner import StudyProgress, Task, WorkerPool, run_tasks
from lslam.studies.subjects import scans_of_run, simulate_once
from lslam.studies.variants import Variant
from lslam.studies.worker import WorkerContext, execute

log = logging.getLogger("lslam")
# Scans of a recording, when only the order of its runs by length matters.
_MANY = 10**6
_REQUESTS = 32  # of storage, together


def folders_of_finished(jobs: Sequence[Job]) -> set[Path]:
    """Folders of the jobs that were finished before by the same configuration, input and version."""
    # Of storage, where each answer takes its time, many are asked for together.
    with ThreadPoolExecutor(_REQUESTS if any(isinstance(job.folder, RemotePath) for job in jobs) else 1) as pool:
        answers = pool.map(lambda job: is_reusable(job.state_file, job.folder, job.digest), jobs)
        return {job.folder for job, is_finished in zip(jobs, answers, strict=True) if is_finished}


def left_to_do(output: OutputOptions, jobs: Sequence[Job]) -> list[Job]:
    """Runs that are not finished, or all unless `output.resume`."""
    finished = folders_of_finished(jobs) if output.resume else set()
    return [replace(job, goes_on=output.resume) for job in jobs if job.folder not in finished]


def output_file(folder: Path) -> Path:
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
    title : of the progress bar; tries : how often a run is begun whose process died
    """

    most_at_once: int = 1
    is_persistent: bool = True
    title: str = "studying"
    tries: int = 2

    @property
    def at_once(self) -> int:
        """Number of worker processes."""
        return min(self.most_at_once, os.cpu_count() or 1)

    def prepare(self, jobs: Sequence[Job], progress: StudyProgress) -> None:
        """Simulate the missing scenes, in parallel."""
        simulate_scenes(jobs, self.most_at_once, progress)

    def run(
        self,
        jobs: Sequence[Job],
        progress: StudyProgress,
        on_done: Callable[[Job], None] = lambda job: None,
        work: Callable[[Job, WorkerContext], None] = execute,
    ) -> None:
        """Make every run. With several at once, the longest begin.

        A job whose process died has the state `crashed`. KeyboardInterrupt ends all running jobs.
        """
        if not jobs:
            return
        pool = _pool(self.most_at_once, len(jobs), self.is_persistent, self.tries)
        load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0
        context = WorkerContext(pool.at_once, load, pool.at_once == 1 or pool.is_persistent, pool.is_persistent)
        for job in jobs:
            clear_attempt(job)
        if pool.at_once > 1:  # a long one begun last would keep one process busy while the others have no more to do
            jobs = sorted(jobs, key=lambda job: scans_of_run(_MANY, job.config.input), reverse=True)
        tasks = [
            Task(
                job.name,
                partial(work, job, context),
                output_file(job.folder),
                str(job.path) if pool.is_persistent else "",
            )
            for job in jobs
        ]

        def on_end(index: int, cause: str) -> None:
            ensure_state(jobs[index], cause, context)
            on_done(jobs[index])
            progress.on_step(jobs[index].name)

        progress.on_start(self.title, len(jobs), "runs", pool.at_once)
        run_tasks(tasks, pool, lambda index: log.debug("%s begins", jobs[index].name), on_end)


def _pool(most_at_once: int, count: int, is_persistent: bool = False, tries: int = 1) -> WorkerPool:
    """Pool for `count` runs, at most `most_at_once` and the cores at once; tries : per run; is_persistent : workers stay."""
    cores = os.cpu_count() or 1
    at_once = max(1, min(most_at_once, cores, count))
    if most_at_once > cores:
        log.info(
            "%d jobs are asked for: this machine has %d cores, so %d runs go at once", most_at_once, cores, at_once
        )
    return WorkerPool(at_once, is_persistent, tries)


def simulate_scenes(jobs: Sequence[Job], most_at_once: int, progress: StudyProgress) -> None:
    """Simulate missing scenes, each in a process; after a failure its runs try again, and report the reason."""
    missing = {job.path: job for job in jobs if job.scene is not None and not job.path.is_dir()}
    if not missing:
        return
    tasks = []
    for path, job in missing.items():
        assert job.scene is not None
        work = partial(simulate_once, job.scene, job.seed, path.parents[2])
        tasks.append(Task(f"{job.scene.name} {job.seed}", work, output_file(path.parents[1])))
    pool = _pool(most_at_once, len(tasks))
    progress.on_start("simulating", len(tasks), "scenarios", pool.at_once)

    def on_end(index: int, cause: str) -> None:
        log.debug("%s: %s", tasks[index].name, cause or "simulated")
        progress.on_step(tasks[index].name)

    run_tasks(tasks, pool, lambda index: None, on_end)


@contextmanager
def study_folder(output: OutputOptions, mark: str, jobs: Sequence[Job]) -> Iterator[None]:
    """Make the folder of a study before the block, and remove it if the block fails before anything else is in it.

    Raises as `make_output`; InterruptedRunError, with the number of finished `jobs`, for Ctrl-C or SIGTERM in the block.
    """
    make_output(output, mark)
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; {len(folders_of_finished(jobs))} of {len(jobs) or 'all'} runs are finished in {output.out}: the same "
            "command with --resume goes on"
        ) from None
    except LslamError:
        release_output(output.out, mark)
        raise


@dataclass(frozen=True)
class ExpandedStudy:
    """All runs of a study, and the meaning of its variants, by name.

    name : of the study or batch, which `text` in the file `mark` describes; metric : the error it judges by
    """

    name: str
    mark: str
    text: str
    jobs: list[Job] = field(default_factory=list)
    variants: dict[str, Variant] = field(default_factory=dict)
    metric: str = "ate_se3"


def check_same(
    output: OutputOptions, mark: str, text: str, names_of: Callable[[dict[str, Any]], Sequence[str]]
) -> None:
    """Check that the output folder is of this study or batch, when it is to be resumed.

    A changed study may continue in its folder, since runs are reused by digest.

    text : for the file `mark`; names_of : names of the content of such a text, of which both must share one

    Raises OutputExistsError for a folder of another study; ConfigError for a damaged `mark`.
    """
    if not output.resume or not (output.out / mark).is_file():
        return
    what = WORDS[mark]
    theirs, ours = names_of(read_toml(output.out / mark, what)), names_of(parse_toml(text))
    if not set(theirs) & set(ours):
        raise OutputExistsError(
            f"output folder {output.out} holds {what} {theirs[0]!r} and --resume would go on in it with {what} {ours[0]!r}: "
            "name another folder with --out"
        )


def make_runs(
    study: ExpandedStudy,
    output: OutputOptions,
    engine: Engine,
    progress: StudyProgress | None = None,
    on_rows: Callable[[Sequence[StudyRow]], None] = lambda rows: None,
) -> list[StudyRow]:
    """Make every run that is not finished yet; results.csv and results.parquet in `output.out` grow as they end.

    on_rows : called with all rows so far

    Raises LslamError as `study_folder` and the engine; OutputExistsError when a run's own folder holds something else.
    Finished runs are kept, and `resume` goes on.
    """
    progress = progress or StudyProgress()
    jobs = study.jobs
    results = Results(study.name, output.out, jobs, study.variants, study.metric)
    with study_folder(output, study.mark, jobs):
        if not output.overwrite:
            results.check()
        write_text(output.out / study.mark, study.text)
        left = left_to_do(output, jobs)
        folders = {job.folder for job in left}
        _check_folders(left, output)
        results.add([job for job in jobs if job.folder not in folders])
        engine.prepare(left, progress)

        def on_done(job: Job) -> None:
            results.add([job])
            on_rows(results.rows)

        on_rows(results.rows)
        try:
            engine.run(left, progress, on_done)
        finally:
            results.flush()
    return results.rows


def _check_folders(jobs: Sequence[Job], output: OutputOptions) -> None:
    """Raise OutputExistsError if a run's own folder exists, unless `overwrite`, or `resume` and this study made it."""
    for job in jobs:
        may_replace = output.overwrite or (output.resume and job.state_file.is_file())
        if output.out not in job.folder.parents and job.folder.exists() and not may_replace:
            raise OutputExistsError(
                f"the folder {job.folder} of {job.name} exists: name another, or --overwrite replaces it"
            )
