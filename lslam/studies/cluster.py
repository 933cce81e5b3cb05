"""Runs on a Dask cluster: workers need lslam, and the recordings or scenarios; run folders are sent back."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shutil
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lslam.core import __version__
from lslam.core.errors import InputError, OutputError, RunFailedError, UsageError, cause
from lslam.core.extras import install_command
from lslam.core.untrusted import whole_number
from lslam.io.remote import RemotePath, as_path
from lslam.studies.grid import Job
from lslam.studies.jobs import clear_attempt, ensure_state, simulate_scenes
from lslam.studies.runner import StudyProgress
from lslam.studies.worker import WorkerContext, execute

log = logging.getLogger("lslam")
_ANSWER_S, _WORKERS_S = 10, 30
# A scheduler that went away is waited for so long: whatever restarts it has to begin a new process, and workers too.
_PATIENCE_S, _PAUSE_S = 300.0, 1.0
_LOCAL = "local:"
# A worker may have several threads, but a run is to have its process alone.
_ALONE = threading.Lock()


@contextmanager
def connect(scheduler: str | None, local: str | None, title: str, *, is_persistent: bool = True) -> Iterator[Cluster]:
    """Cluster of a scheduler "tcp://host:port", or a local one of N workers, "local:N"; `is_persistent` as in `Cluster`.

    Raises UsageError when Dask is missing or `local` is no number of workers; InputError when the scheduler does not answer.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise UsageError(f"--scheduler and --cluster need Dask: {install_command('cluster')}") from None
    for name in ("distributed", "distributed.client"):  # what goes wrong is said in one sentence, not in its tracebacks
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if local is not None:
        count = _count(local)
        env = {"NUMBA_NUM_THREADS": "1"}
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL, env=env
            ) as workers,
            Client(workers) as client,
        ):
            yield Cluster(client, workers.scheduler_address, title, is_here=True, is_persistent=is_persistent)
        return
    assert scheduler is not None
    cluster = Cluster(_client(scheduler), scheduler, title, is_persistent=is_persistent)
    try:
        yield cluster
    finally:
        cluster.client.close()


def _client(scheduler: str) -> Any:
    """Dask client of the scheduler. Raises InputError when the scheduler does not answer."""
    import dask
    from distributed import Client

    try:
        with dask.config.set({"distributed.comm.timeouts.connect": f"{_ANSWER_S}s"}):
            return Client(scheduler, timeout=_ANSWER_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"the scheduler {scheduler} does not answer within {_ANSWER_S} s ({type(error).__name__}): is `dask scheduler` "
            "running there, and its port open?"
        ) from None


@dataclass
class Cluster:
    """Workers of a Dask scheduler: is_here : on this disk; is_persistent : they cache sequences and delete keyframes."""

    client: Any
    address: str
    title: str
    is_here: bool = False
    is_persistent: bool = True

    @property
    def at_once(self) -> int:
        """Number of runs at once: one per worker."""
        return max(1, len(self._workers()))

    def prepare(self, jobs: Sequence[Job], progress: StudyProgress) -> None:
        """Check that the workers can make the runs; simulate here the scenes that all workers can read here.

        Raises InputError naming the worker that lacks lslam, this version of it, or a recording; RunFailedError without any.
        """
        try:
            self.client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError:
            raise RunFailedError(
                f"the scheduler {self.address} has no workers: start some, `dask worker {self.address} --nthreads 1`"
            ) from None
        paths = _paths_to_check(job.path for job in jobs if job.scene is None)
        for worker, answer in self.client.run(_inspect, paths, on_error="return").items():
            if isinstance(answer, BaseException):
                raise InputError(f"worker {worker} cannot run lslam: {answer}; install it there")
            version, missing = answer
            if version != __version__:
                raise InputError(f"worker {worker} has lslam {version}, this is {__version__}: install the same there")
            if missing:
                raise InputError(
                    f"worker {worker} does not have {missing[0]}: the recordings must lie there as they do here"
                )
        if self.is_here:
            simulate_scenes(jobs, self.at_once, progress)

    def run(self, jobs: Sequence[Job], progress: StudyProgress, on_done: Callable[[Job], None]) -> None:
        """Make every run on some worker. The scheduler restarts runs of a worker that died.

        Runs are also restarted after a lost scheduler is back. Raises RunFailedError when it stays away.
        """
        if not jobs:
            return
        progress.on_start(self.title, len(jobs), "runs", self.at_once)
        rest = list(jobs)
        while rest := self._attempt(rest, progress, on_done):
            count = f"{len(jobs) - len(rest)} of {len(jobs)} runs"
            log.warning("the scheduler %s went away after %s: it is waited for", self.address, count)
            self._reconnect(count)

    def _attempt(self, jobs: Sequence[Job], progress: StudyProgress, on_done: Callable[[Job], None]) -> list[Job]:
        """Make the runs. Returns those left over if the scheduler is lost."""
        from distributed import as_completed

        for job in jobs:
            clear_attempt(job)
        context = WorkerContext(self.at_once, is_alone=False, is_persistent=self.is_persistent)
        rest = {
            self.client.submit(perform, job, context, key=f"lslam-{k}-{job.digest}", pure=False): job
            for k, job in enumerate(jobs)
        }
        try:
            for future in as_completed(list(rest)):
                error = future.exception()
                if future.cancelled() or self.client.status != "running":
                    break
                job = rest.pop(future)
                if error is None and not isinstance(job.folder, RemotePath):
                    unpack(future.result(), job)
                ensure_state(job, "" if error is None else f"its worker failed: {error}", context)
                on_done(job)
                progress.on_step(job.name)
                future.release()
        finally:
            if self.client.status == "running":
                self.client.cancel(list(rest), force=True)
        return list(rest.values())

    def _reconnect(self, count: str) -> None:
        """A new client, once the scheduler answers and has a worker; raises RunFailedError, which says the `count`, if not."""
        with contextlib.suppress(Exception):  # of a connection that is lost
            self.client.close(timeout=1)
        until = time.monotonic() + _PATIENCE_S
        while True:
            with contextlib.suppress(InputError, TimeoutError, OSError):
                self.client = _client(self.address)
                self.client.wait_for_workers(1, timeout=max(until - time.monotonic(), 1.0))
                return
            if time.monotonic() > until:
                raise RunFailedError(
                    f"the scheduler {self.address} went away after {count}: start it, and the same command with "
                    "--resume goes on"
                )
            time.sleep(_PAUSE_S)

    def _workers(self) -> dict[str, Any]:
        """Workers of the scheduler by address."""
        return dict(self.client.scheduler_info(n_workers=-1)["workers"])


def perform(job: Job, context: WorkerContext) -> bytes:
    """On a worker: make the run in a local folder. Returns it as an archive, with the run's state.

    A run folder in storage is uploaded by the worker with its state, and the archive is empty.
    """
    from distributed import get_worker

    worker = get_worker()
    _forget_samples(worker)
    own = Path(worker.local_directory)
    path = job.path
    if job.scene is not None and not path.is_dir():
        path = own / "scenes" / path.relative_to(path.parents[2])
    if isinstance(job.folder, RemotePath):
        with _ALONE:
            execute(replace(job, path=path), context)
        return b""
    with _ALONE, tempfile.TemporaryDirectory(dir=own) as scratch:
        execute(replace(job, path=path, folder=Path(scratch) / "run"), context)
        return pack(Path(scratch))


def _forget_samples(worker: Any) -> None:
    """Clear the stack samples of a worker: Dask keeps an hour of them, 0.3 MB for each second of short runs."""
    for name in ("profile_history", "profile_keys_history"):
        with contextlib.suppress(AttributeError):
            getattr(worker, name).clear()


def pack(folder: Path) -> bytes:
    """Archive of all files of a folder."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder))
    return stream.getvalue()


def unpack(archive: bytes, job: Job) -> None:
    """Unpack run folder and state to the job's paths, the state last. Raises OutputError."""
    part = job.folder.with_name(f"{job.folder.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        # A tar file's `filter`, without which it may lead out of the folder, is not in Python 3.11 before 3.11.4.
        with zipfile.ZipFile(io.BytesIO(archive)) as stream:
            stream.extractall(part)
        shutil.rmtree(job.folder, ignore_errors=True)
        if (part / "run").is_dir():
            os.replace(part / "run", job.folder)
        os.replace(part / "run.json", job.state_file)
        shutil.rmtree(part)
    except OSError as error:
        raise OutputError(f"{error.filename or job.folder} cannot be written: {cause(error)}") from None


def _inspect(paths: list[str]) -> tuple[str, list[str]]:
    """On a worker: its version of lslam, and the paths that are missing there."""
    return __version__, [path for path in paths if not as_path(path).exists()]


def _paths_to_check(paths: Iterable[Path]) -> list[str]:
    """Paths that each worker shall look for: all on disks, and one of each folder in storage."""
    places = {path.parent if isinstance(path, RemotePath) else path: str(path) for path in paths}
    return sorted(places.values())


def _count(local: str) -> int:
    """Number of workers in "local:N". Raises UsageError for another text."""
    number = local.removeprefix(_LOCAL)
    if not local.startswith(_LOCAL) or not whole_number(number):
        raise UsageError(f"--cluster {local}: local:N with N workers, for example local:2")
    return int(number)
