"""The second process of a cold start: it compiles what the first would, and does not outlive its block."""

from __future__ import annotations

import gc
import subprocess
import sys
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

from lslam.core.config import Config
from lslam.odometry import create_odometry
from lslam.pipeline import precompile


def signatures() -> set[tuple[str, str]]:
    """Of every kernel that this process has compiled or loaded."""
    # By the type itself: `isinstance` follows weak references, to what may be gone.
    kernels = [k for k in gc.get_objects() if issubclass(type(k), Dispatcher)]
    return {(f"{k.py_func.__module__}.{k.py_func.__name__}", str(s)) for k in kernels for s in k.signatures}


def test_it_compiles_nothing_that_the_run_does_not_need() -> None:
    config = Config()
    precompile.load_kernels(config, [create_odometry(config)])
    of_run = signatures()
    precompile.main([name for name, part in precompile.KERNELS.items() if part.is_called(config)])
    assert signatures() == of_run


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """What is started in place of the compiler: processes that take long."""
    processes: list[subprocess.Popen[bytes]] = []

    class Sleeping(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, command: list[str], **options: Any) -> None:
            assert command[1:4] == ["-P", "-m", "lslam.pipeline.precompile"]
            super().__init__([sys.executable, "-c", "import time; time.sleep(60)"], **options)
            processes.append(self)

    monkeypatch.setattr(subprocess, "Popen", Sleeping)
    monkeypatch.setattr(precompile, "available_cores", lambda: 2)
    return processes


def test_it_starts_once_and_ends_with_the_block(started: list[subprocess.Popen[bytes]]) -> None:
    with precompile.helped(Config()) as start:
        assert not started
        start()
        start()
        assert [process.poll() for process in started] == [None]
    assert started[0].poll() is not None


def test_it_ends_when_the_first_process_is_interrupted(started: list[subprocess.Popen[bytes]]) -> None:
    def interrupted() -> None:
        with precompile.helped(Config()) as start:
            start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert started[0].poll() is not None


def test_a_single_core_has_no_second_process(
    started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "available_cores", lambda: 1)
    with precompile.helped(Config()) as start:
        start()
    assert not started


def test_a_process_that_cannot_be_started_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.setattr(precompile, "available_cores", lambda: 2)
    with precompile.helped(Config()) as start:
        start()
