"""Processes that end well, badly and not at all."""

from __future__ import annotations

import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from lslam.studies.runner import Task, WorkerPool, run_tasks


def write_environment(path: Path) -> None:
    path.write_text(f"{os.getpid()} {os.environ['NUMBA_NUM_THREADS']} {os.environ.get('OMP_NUM_THREADS')}")


def kill_itself() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fail() -> None:
    raise ValueError("the cat sat on it")


def chatter() -> None:
    print("on stdout", flush=True)
    os.write(2, b"on stderr\n")


def meet(own: Path, other: Path) -> None:
    """Come to an end only beside another one."""
    own.write_text("here")
    end = time.monotonic() + 60
    while not other.exists():
        if time.monotonic() > end:
            sys.exit(3)
        time.sleep(0.01)


def wait_to_be_ended(own: Path) -> None:
    try:
        own.write_text(str(os.getpid()))  # from here on it may be interrupted
        time.sleep(120)
    except KeyboardInterrupt:
        own.write_text("ended")
        raise


def go(folder: Path, *works: object, at_once: int = 1) -> dict[int, str]:
    tasks = [Task(f"task {i}", work, folder / f"{i}.out") for i, work in enumerate(works)]  # type: ignore[arg-type]
    ended: dict[int, str] = {}
    run_tasks(tasks, WorkerPool(at_once), lambda index: None, lambda index, cause: ended.update({index: cause}))
    return ended


def test_each_task_has_a_process_one_that_dies_takes_nothing_with_it_and_stdout_stays_clean(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = dict(os.environ)
    first, last = tmp_path / "first", tmp_path / "last"
    works = [partial(write_environment, first), kill_itself, fail, chatter, partial(write_environment, last)]
    ended = go(tmp_path, *works)
    assert [ended[i] for i in (0, 3, 4)] == ["", "", ""]
    assert ended[1] == "the process was killed by SIGKILL (often: out of memory)"
    assert ended[2] == "the process ended with exit code 1: ValueError: the cat sat on it"
    (pid, *threads), (other, *_) = first.read_text().split(), last.read_text().split()
    assert len({pid, other, str(os.getpid())}) == 3
    assert threads == ["1", str(before.get("OMP_NUM_THREADS"))]
    assert os.environ == before
    assert (tmp_path / "3.out").read_text() == "on stdout\non stderr\n"
    assert not (tmp_path / "0.out").exists()
    assert capfd.readouterr() == ("", "")


def test_several_at_once_meet_and_one_at_a_time_do_not(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    assert go(tmp_path, partial(meet, a, b), partial(meet, b, a), at_once=2) == {0: "", 1: ""}


def test_a_process_goes_on_with_what_it_has_read_and_a_new_one_takes_what_nobody_has(tmp_path: Path) -> None:
    a, b, c = tmp_path / "a", tmp_path / "b", tmp_path / "c"
    works = [partial(meet, a, b), partial(note, c), partial(meet, b, a), partial(note, c)]
    tasks = [
        Task(f"{i}", work, tmp_path / f"{i}.out", data)
        for i, (work, data) in enumerate(zip(works, "xxyx", strict=True))
    ]
    begun: list[int] = []
    run_tasks(tasks, WorkerPool(2, is_persistent=True), begun.append, lambda index, cause: None)
    assert begun[:2] == [0, 2]
    assert sorted(begun) == [0, 1, 2, 3]
    one_after_the_other: list[int] = []
    again = [Task("", partial(note, c), tmp_path / "out", data) for data in "xyxzy"]
    run_tasks(again, WorkerPool(1, is_persistent=True), one_after_the_other.append, lambda index, cause: None)
    assert one_after_the_other == [0, 2, 1, 4, 3]


def test_an_interruption_ends_what_runs(tmp_path: Path) -> None:
    mark = tmp_path / "mark"

    def interrupt_when_started(index: int) -> None:
        if index == 1:
            end = time.monotonic() + 60
            while not mark.exists() and time.monotonic() < end:
                time.sleep(0.01)
            raise KeyboardInterrupt

    tasks = [Task(f"{i}", partial(wait_to_be_ended, mark), tmp_path / f"{i}.out") for i in range(2)]
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, WorkerPool(2), interrupt_when_started, lambda index, cause: None)
    assert mark.read_text() == "ended"
    assert time.monotonic() - began < 60


def note(path: Path) -> None:
    with path.open("a") as stream:
        stream.write(f"{os.getpid()}\n")


def die_the_first_time(path: Path) -> None:
    note(path)
    if len(path.read_text().splitlines()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)


def keep(folder: Path, *works: object, tries: int = 2) -> list[tuple[int, str]]:
    tasks = [Task(f"task {i}", work, folder / f"{i}.out") for i, work in enumerate(works)]  # type: ignore[arg-type]
    ended: list[tuple[int, str]] = []
    pool = WorkerPool(1, is_persistent=True, tries=tries)
    run_tasks(tasks, pool, lambda index: None, lambda index, cause: ended.append((index, cause)))
    return ended


def test_a_kept_process_does_one_task_after_the_other(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert keep(tmp_path, partial(note, tmp_path / "pids"), chatter, partial(note, tmp_path / "pids")) == [
        (0, ""), (1, ""), (2, ""),
    ]  # fmt: skip
    first, second = (tmp_path / "pids").read_text().split()
    assert first == second != str(os.getpid())
    assert (tmp_path / "1.out").read_text() == "on stdout\non stderr\n"
    assert not (tmp_path / "2.out").exists()
    assert capfd.readouterr() == ("", "")


def test_a_task_whose_process_died_is_begun_once_more_and_ends_once(tmp_path: Path) -> None:
    ended = keep(tmp_path, partial(die_the_first_time, tmp_path / "a"), kill_itself, partial(note, tmp_path / "b"))
    assert sorted(ended) == [(0, ""), (1, "the process was killed by SIGKILL (often: out of memory)"), (2, "")]
    assert len((tmp_path / "a").read_text().split()) == 2


def test_an_interruption_between_two_tasks_ends_the_process_that_waits(tmp_path: Path) -> None:
    def interrupt_the_second(index: int) -> None:
        if index == 1:
            raise KeyboardInterrupt

    pids = tmp_path / "pids"
    tasks = [Task(f"{i}", partial(note, pids), tmp_path / f"{i}.out") for i in range(2)]
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, WorkerPool(1, is_persistent=True), interrupt_the_second, lambda index, cause: None)
    (pid,) = pids.read_text().split()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid), 0)


def test_kept_processes_have_one_thread_each(tmp_path: Path) -> None:
    keep(tmp_path, partial(write_environment, tmp_path / "said"))
    assert (tmp_path / "said").read_text().split()[1:] == ["1", "1"]
