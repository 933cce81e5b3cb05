"""One job in a process beside the study's: everything it can end with becomes a state."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import shutil
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache, partial
from pathlib import Path

import numpy as np

from lslam.core.errors import (
    GateError,
    InputError,
    InterruptedRunError,
    LslamError,
    OutputExistsError,
    RunFailedError,
    RunFinishedError,
)
from lslam.core.stopping import current, is_interrupt
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence, SequenceView
from lslam.pipeline.run_folder import KEYFRAMES, LOG, MANIFEST, spool_of
from lslam.studies.grid import Job
from lslam.studies.results_csv import State, write_state

# Bytes of scans a process keeps at most, and its share of what was free when it began.
_MOST, _SHARE = 2 * 10**9, 0.2
INTERRUPTED = ("interrupted", "interrupted before its end")


class ScanStore:
    """Scans by key, up to `most_bytes` of them, those used least lately forgotten first; any thread may ask."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes, self.bytes = most_bytes, 0
        self._scans: OrderedDict[tuple[int, int], Scan] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[int, int], read: Callable[[], Scan]) -> Scan:
        """The scan of `key`, read now unless it is kept. Raises what `read` raises."""
        with self._lock:
            if key in self._scans:
                self._scans.move_to_end(key)
                return self._scans[key]
        scan = read()
        with self._lock:
            if key not in self._scans:  # another thread may have read it meanwhile
                self._scans[key] = scan
                self.bytes += size_of(scan)
            while self.bytes > self.most_bytes:
                self.bytes -= size_of(self._scans.popitem(last=False)[1])
        return scan


def size_of(scan: Scan) -> int:
    """Bytes of the arrays of a scan."""
    values = (getattr(scan, f.name) for f in fields(scan))
    return sum(value.nbytes for value in values if isinstance(value, np.ndarray))


class CachedSequence(SequenceView):
    """A whole sequence whose scans come from a store; `number` distinguishes it from others there."""

    def __init__(self, whole: Sequence, store: ScanStore, number: int) -> None:
        super().__init__(whole, notes=list(whole.notes), problems=list(whole.problems))
        self._store, self._number = store, number

    def scan(self, index: int) -> Scan:
        """Scan `index`, read at most once while it is kept. Raises InputError as the sequence's own."""
        return self._store.get((self._number, index), lambda: self.whole.scan(index))


class SequenceCache:
    """Opened sequences of a process by what they were opened with."""

    def __init__(self, store: ScanStore) -> None:
        self.store = store
        self._opened: dict[object, Sequence] = {}

    def get(self, key: object, opening: Callable[[], Sequence]) -> Sequence:
        """The sequence of `key`, opened now unless it was before; each run has notes and problems of its own."""
        if key not in self._opened:
            self._opened[key] = opening()
        whole = self._opened[key]
        number = list(self._opened).index(key)
        return CachedSequence(whole, self.store, number)


def cache_limit() -> int:
    """Bytes of scans that this process may keep."""
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return _MOST // 4
    return min(_MOST, int(_SHARE * free))


@dataclass(frozen=True)
class WorkerContext:
    """What the reader of the times must know.

    at_once : runs that share the machine; load : of the machine before them; is_alone : whether no other run shares its core
    is_persistent : whether the process goes on with other runs of the same data, which it then keeps; keyframes are not
    """

    at_once: int = 1
    load: float = 0.0
    is_alone: bool = True
    is_persistent: bool = False


def execute(job: Job, context: WorkerContext) -> None:
    """Run the job into its folder, replacing what is there unless the run is resumed, and write its state.

    Errors of the run become its state. Raises KeyboardInterrupt after the state is written, so that the process ends.
    """
    # What the run says is in its log.txt; the screen belongs to the study.
    log = logging.getLogger("lslam")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
    log.propagate = False
    job.state_file.unlink(missing_ok=True)
    _drop_lone_log(job.folder)
    began, waited = time.monotonic(), _waited_s()
    status, reason = "failed", ""
    try:
        status, reason = _run(job, context.is_persistent)
    except (KeyboardInterrupt, InterruptedRunError):
        status, reason = INTERRUPTED
        raise KeyboardInterrupt from None
    except RunFailedError as error:
        status, reason = "diverged", str(error).removeprefix("the run diverged: ")
    except LslamError as error:
        reason = str(error)
    except MemoryError:
        reason = "out of memory: use fewer points (preprocess.range_max) or larger voxels (map.voxel)"
    except Exception as error:
        if is_interrupt(error):
            status, reason = INTERRUPTED
            raise KeyboardInterrupt from None
        what = ": ".join([type(error).__name__, *str(error).strip().splitlines()[:1]])
        reason = f"lslam made a mistake ({what}){_keep_traceback(job.folder, error)}"
    finally:
        current().is_gentle = False
        seconds = time.monotonic() - began
        if context.is_persistent and status != "interrupted":  # one of hundreds: nothing asks for its clouds again
            shutil.rmtree(job.folder / KEYFRAMES, ignore_errors=True)
        state = State(
            job.digest,
            status,
            reason,
            context.at_once,
            context.load,
            round(seconds, 3),
            context.is_alone,
            round((_waited_s() - waited) / max(seconds, 1e-9), 4),
            platform.node(),
        )
        write_state(job.state_file, state)


def _keep_traceback(folder: Path, error: Exception) -> str:
    """Append the traceback of an error to the run's log.txt. Returns the end of a sentence that says so; empty if it fails."""
    folder = spool_of(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / LOG).open("a", encoding="utf-8", errors="backslashreplace") as stream:
            stream.writelines(traceback.format_exception(error))
    except OSError:
        return ""
    return f": its {LOG} says where"


def _drop_lone_log(folder: Path) -> None:
    """Remove a folder that holds only the log of an error, since it is no run folder and could not be replaced."""
    folder = spool_of(folder)
    with contextlib.suppress(OSError):  # what is in the way is said when the run is made
        if not (folder / MANIFEST).exists():
            (folder / LOG).unlink(missing_ok=True)


def _waited_s() -> float:
    """Seconds that threads of this process were ready to go and had no core; 0 where the system does not say."""
    waited = 0
    for path in Path("/proc/self/task").glob("*/schedstat"):
        with contextlib.suppress(OSError, ValueError, IndexError):  # a thread may end meanwhile
            waited += int(path.read_text().split()[1])
    return waited / 1e9


def _run(job: Job, is_persistent: bool) -> tuple[str, str]:
    """Status and reason of a run that came to its end; raises InputError where the job was refused."""
    from lslam.pipeline.run import run
    from lslam.pipeline.watch import RunOutcome, watch_run

    if job.refusal:
        raise InputError(job.refusal)
    outcomes: list[RunOutcome] = []
    config = job.config
    key = (
        job.path,
        job.data_root,
        config.input.vertical_correction_deg,
        config.imu.use,
        config.gnss.mode != "off",
        tuple(sorted(job.reading.items())),
    )
    opening = partial(_open, job)
    sequence = _sequences().get(key, opening) if is_persistent else opening()
    watch = watch_run(current(), on_end=outcomes.append)

    def make(goes_on: bool) -> None:
        """Make the run, or resume it; a failed gate of its own (input.strict) does not count here."""
        with contextlib.suppress(GateError):
            run(
                sequence,
                job.config,
                out=job.folder,
                ground_truth=job.truth,
                overwrite=True,
                resume=goes_on,
                command=job.command,
                watch=watch,
                reading={name: str(value) for name, value in job.reading.items() if value is not None},
            )

    # What lies there may be another run, or a finished one that left no state: it is replaced.
    with contextlib.suppress(OutputExistsError, RunFinishedError):
        make(job.goes_on)
    if not outcomes:
        make(False)
    manifest = outcomes[-1].record.manifest
    status = str(manifest["status"])
    return status, "" if status == "done" else "; ".join(manifest["problems"])  # a run that is done may have warned


def _open(job: Job) -> Sequence:
    """Open the recording of a job; simulate it first where it is missing."""
    from lslam.pipeline.check import open_recording
    from lslam.studies.subjects import simulate_once

    if job.scene is not None:
        simulate_once(job.scene, job.seed, job.path.parents[2])
    return open_recording(job.path, job.config, data_root=job.data_root, **job.reading)


@cache
def _sequences() -> SequenceCache:
    """The cache of opened sequences of this process."""
    return SequenceCache(ScanStore(cache_limit()))
