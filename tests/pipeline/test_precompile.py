"""The second process of a cold start: it compiles what the first would, and does not outlive its block."""

from __future__ import annotations

import gc
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

import lslam
from lslam.core.config import Config, load_config
from lslam.odometry import create_odometry
from lslam.pipeline import precompile

SAMPLE = Path(lslam.__file__).parents[1] / "sample_data"


def signatures() -> set[tuple[str, str]]:
    """Of every kernel that this process has compiled or loaded."""
    # By the type itself: `isinstance` follows weak references, to what may be gone.
    kernels = [k for k in gc.get_objects() if issubclass(type(k), Dispatcher)]
    return {(f"{k.py_func.__module__}.{k.py_func.__name__}", str(s)) for k in kernels for s in k.signatures}


def test_it_compiles_nothing_that_the_run_does_not_need() -> None:
    config = Config()
    precompile.load_kernels(config, [create_odometry(config)])
    precompile.load_parts(config, precompile.KERNELS)
    of_run = signatures()
    precompile.compile_ahead(config, [name for name, part in precompile.KERNELS.items() if part.applies(config)])
    assert signatures() == of_run


def test_before_the_first_scan_only_what_registers_scans_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[str] = []
    for name, part in precompile.KERNELS.items():
        note = partial(lambda name, config: loaded.append(name), name)
        monkeypatch.setitem(precompile.KERNELS, name, replace(part, warm_up=note))
    config = load_config(settings=["imu.use=true", "wheels.source=/odometry"])
    precompile.load_kernels(config, [])
    assert loaded == ["method", "imu", "wheels"]
    precompile.load_parts(config, ["loops", "walls", "map"])
    assert loaded[3:] == ["loops", "map"]


COUNTING = """
import contextlib, sys
from lslam.core.kernels import jit

@contextlib.contextmanager
def counted(log, total):
    ready = []
    jit._when_ready.append(lambda name, is_ready: ready.append(name) if is_ready else None)
    yield
    print(len(ready), total)
    del jit._when_ready[:]

jit.count_kernels = counted
from lslam.core.config import load_config
from lslam.pipeline.run import run
run(sys.argv[1], load_config(settings=["input.count=2", "loops.use=false"]))
"""


def test_all_kernels_of_scans_are_counted() -> None:
    done = subprocess.run([sys.executable, "-c", COUNTING, SAMPLE], capture_output=True, text=True, check=True)
    total = precompile.COUNTS["icp"]
    assert done.stdout.splitlines()[0] == f"{total} {total}"


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
    with precompile.helper_process():
        assert not started
        precompile.start_helper(Config())
        precompile.start_helper(Config())
        assert [process.poll() for process in started] == [None]
    assert started[0].poll() is not None


def test_it_ends_when_the_first_process_is_interrupted(started: list[subprocess.Popen[bytes]]) -> None:
    def interrupted() -> None:
        with precompile.helper_process():
            precompile.start_helper(Config())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert started[0].poll() is not None


def test_a_single_core_has_no_second_process(
    started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "available_cores", lambda: 1)
    with precompile.helper_process():
        precompile.start_helper(Config())
    assert not started


def test_a_process_that_cannot_be_started_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.setattr(precompile, "available_cores", lambda: 2)
    with precompile.helper_process():
        precompile.start_helper(Config())
