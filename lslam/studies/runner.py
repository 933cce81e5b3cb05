"""Tasks in processes of their own, a few at once: one that dies takes nothing with it but itself."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path

log = logging.getLogger("lslam")
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class Task:
    """work : called without arguments in the process, so it must be picklable; said : file for what the process prints."""

    name: str
    work: Callable[[], None]
    said: Path


def run_tasks(
    tasks: Sequence[Task], at_once: int, on_start: Callable[[int], None], on_end: Callable[[int, str], None]
) -> None:
    """Run every task, at most `at_once` together; on_start(index) and on_end(index, how it died or "") are called here.

    Processes are spawned, not forked: a fork of a process whose kernels have run is a process that may hang. An exception,
    KeyboardInterrupt included, ends those that run, politely first.
    """
    waiting = list(range(len(tasks)))[::-1]
    running: dict[int, tuple[int, BaseProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                index = waiting.pop()
                on_start(index)
                process = _start(tasks[index], at_once)
                running[process.sentinel] = (index, process)
            for sentinel in connection.wait(list(running)):
                assert isinstance(sentinel, int)
                index, process = running.pop(sentinel)
                process.join()
                on_end(index, _cause(process.exitcode, tasks[index].said))
                process.close()
    finally:
        _end([process for _, process in running.values()])


def _start(task: Task, at_once: int) -> BaseProcess:
    process = get_context("spawn").Process(target=_child, args=(task,), name=f"lslam {task.name}", daemon=False)
    with _thread_limits(at_once):
        process.start()
    return process


@contextlib.contextmanager
def _thread_limits(at_once: int) -> Iterator[None]:
    """What a process that starts now shall know before it imports anything: its share of the cores."""
    share = str(max(1, (os.cpu_count() or 1) // at_once))
    limits = {"NUMBA_NUM_THREADS": "1"}
    if at_once > 1:
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


def _child(task: Task) -> None:
    """In the new process: Ctrl-C is the parent's, which then asks with SIGTERM; results on stdout are the parent's too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=_follow_parent, daemon=True).start()
    task.said.parent.mkdir(parents=True, exist_ok=True)
    with task.said.open("wb") as stream:
        for number in (1, 2):
            os.dup2(stream.fileno(), number)
    try:
        task.work()
    except KeyboardInterrupt:
        sys.exit(130)
    if not task.said.stat().st_size:
        task.said.unlink()


def _follow_parent() -> None:
    """A study killed at once leaves nobody behind who goes on computing and holds the run folder."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _cause(exit_code: int | None, said: Path) -> str:
    """How the process died, in one sentence; empty when it came to its end."""
    if exit_code in (0, None):
        return ""
    assert exit_code is not None
    if exit_code > 0:
        return f"the process ended with exit code {exit_code}{_last_words(said)}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    hint = " (often: out of memory)" if name == "SIGKILL" else ""
    return f"the process was killed by {name}{hint}{_last_words(said)}"


def _last_words(said: Path) -> str:
    try:
        lines = [line.strip() for line in said.read_text(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    return f": {lines[-1][:200]}" if lines else ""


def _end(processes: list[BaseProcess]) -> None:
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()
