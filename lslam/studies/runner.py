"""Tasks in worker processes, a few at once: a crash affects only its own task."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from lslam.core.stopping import handle_signals, is_too_late

log = logging.getLogger("lslam")
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class StudyProgress:
    """Progress callbacks of a study: on_start(stage, steps, unit, number made at once), then on_step(note) per step."""

    on_start: Callable[[str, int, str, int], None] = lambda stage, total, unit, at_once: None
    on_step: Callable[[str], None] = lambda note: None


@dataclass(frozen=True)
class Task:
    """Task for a worker.

    work : called without arguments in the process, so it must be picklable; output : file for what the process prints
    data : what it reads, empty when a process that did something before is as good as a new one
    """

    name: str
    work: Callable[[], object]
    output: Path
    data: str = ""


@dataclass(frozen=True)
class WorkerPool:
    """How worker processes make tasks.

    at_once : tasks together; is_persistent : a process goes on with the next task, so that its kernels stay compiled and its data
        read, and has one thread, so that it needs one core; otherwise each task has a new process
    tries : how often a task is begun whose process died
    """

    at_once: int
    is_persistent: bool = False
    tries: int = 1


@dataclass
class _Worker:
    """A worker process with its task."""

    process: BaseProcess
    pipe: Connection
    index: int = -1
    has_read: set[str] = field(default_factory=set)


def run_tasks(
    tasks: Sequence[Task], pool: WorkerPool, on_start: Callable[[int], None], on_end: Callable[[int, str], None]
) -> None:
    """Run every task; on_start(index) and, once per task, on_end(index, cause of the process's death or "") are called here.

    They begin in order, but for a process that goes on with what it has read as long as there is such a task, and turns to
    what no other has read before it reads what another has.
    Processes are spawned, not forked: a fork of a process whose kernels have run is a process that may hang. An exception,
    KeyboardInterrupt included, ends those that run, politely first.
    """
    waiting = [(index, 1) for index in range(len(tasks))]
    tries: dict[int, int] = {}
    idle: list[_Worker] = []
    busy: list[_Worker] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < pool.at_once:
                data = [tasks[index].data for index, _ in waiting]
                index, tries[index] = waiting.pop(_choice(data, idle[-1] if idle else None, [*busy, *idle]))
                on_start(index)
                worker = idle.pop() if idle else _hire(pool)
                worker.index = index
                worker.has_read.add(tasks[index].data)
                busy.append(worker)
                with contextlib.suppress(OSError):  # it died while it was idle: its pipe says so below
                    worker.pipe.send(tasks[index])
            for pipe in connection.wait([worker.pipe for worker in busy]):
                worker = next(worker for worker in busy if worker.pipe is pipe)
                busy.remove(worker)
                cause = _ending(worker, tasks[worker.index].output, pool.is_persistent)
                if cause is None:
                    idle.append(worker)
                if cause and tries[worker.index] < pool.tries:
                    log.warning("%s is begun anew: %s", tasks[worker.index].name, cause)
                    waiting.append((worker.index, tries[worker.index] + 1))
                else:
                    on_end(worker.index, cause or "")
    finally:
        _end([worker.process for worker in [*busy, *idle]])


def _choice(data: Sequence[str], worker: _Worker | None, workers: Sequence[_Worker]) -> int:
    """Index of the next task: one whose data this worker has cached, else data that no worker has, else the first."""
    own = set() if worker is None else worker.has_read
    of_all = {name for other in workers for name in other.has_read}
    orders = (name in own for name in data), (name not in of_all for name in data)
    return next((k for marks in orders for k, is_next in enumerate(marks) if is_next), 0)


def _hire(pool: WorkerPool) -> _Worker:
    """Start a worker process with a pipe to it."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_child, args=(theirs,), name="lslam worker", daemon=False)
    with _thread_limits(pool):
        process.start()
    theirs.close()
    return _Worker(process, ours)


def _ending(worker: _Worker, output: Path, is_persistent: bool) -> str | None:
    """None if the process is persistent and ready for more, else the cause of its death, empty for a normal end."""
    try:
        worker.pipe.recv()
        if is_persistent:
            return None
        worker.pipe.send(None)
    except (EOFError, OSError):
        pass  # gone in the middle of its task
    worker.process.join()
    cause = _cause(worker.process.exitcode, output)
    worker.process.close()
    worker.pipe.close()
    return cause


@contextlib.contextmanager
def _thread_limits(pool: WorkerPool) -> Iterator[None]:
    """Environment that limits the threads of a new process to its share of the cores, read at import."""
    share = "1" if pool.is_persistent else str(max(1, (os.cpu_count() or 1) // pool.at_once))
    limits = {"NUMBA_NUM_THREADS": "1"}
    if pool.at_once > 1 or pool.is_persistent:
        limits |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), share)
    before = {name: os.environ.get(name) for name in limits}
    os.environ.update(limits)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _child(pipe: Connection) -> None:
    """Main loop of a worker process; it ignores Ctrl-C, since the parent then sends SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    # A group that is ended asks twice, the system and the parent; who has no patience left kills.
    with handle_signals([signal.SIGTERM], may_force=False) as stop:
        try:
            while (task := pipe.recv()) is not None:
                _do(task)
                pipe.send(True)
                stop.check()
        except (KeyboardInterrupt, EOFError):
            is_too_late()
            sys.exit(130)


def _do(task: Task) -> None:
    """Work on a task in this process; stdout and stderr go to its output file, which is removed when empty."""
    task.output.parent.mkdir(parents=True, exist_ok=True)
    with task.output.open("wb") as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)
    task.work()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    if not task.output.stat().st_size:
        task.output.unlink()


def _follow_parent() -> None:
    """End this process if the parent dies, so that none goes on computing and holding the run folder."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _cause(exit_code: int | None, output: Path) -> str:
    """Cause of the process's death in one sentence; empty when it ended normally."""
    if exit_code in (0, None):
        return ""
    assert exit_code is not None
    if exit_code > 0:
        return f"the process ended with exit code {exit_code}{_last_words(output)}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    hint = " (often: out of memory)" if name == "SIGKILL" else ""
    return f"the process was killed by {name}{hint}{_last_words(output)}"


def _last_words(output: Path) -> str:
    """Last line of a process's output, after a colon; empty without output."""
    try:
        lines = [line.strip() for line in output.read_text(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    return f": {lines[-1][:200]}" if lines else ""


def _end(processes: list[BaseProcess]) -> None:
    """Terminate the processes, and kill those that live on after `_PATIENCE_S`."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()
