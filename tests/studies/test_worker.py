"""What a run of a study leaves behind when lslam itself is wrong."""

from __future__ import annotations

import json
import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import pytest

from lslam.core.config import load_config
from lslam.odometry.icp import Icp
from lslam.pipeline import job as prepared
from lslam.studies import worker
from lslam.studies.grid import Job
from lslam.studies.results import Results
from lslam.studies.results_csv import read_state, read_study_csv
from lslam.studies.runner import Task, WorkerPool, run_tasks
from lslam.studies.variants import Variant
from lslam.studies.worker import WorkerContext, execute

MOTHS = "moths\nin the relay"


@pytest.fixture(autouse=True)
def _log_of_the_study() -> Iterator[None]:
    """`execute` silences the log of its process, which here is the tests'."""
    log = logging.getLogger("lslam")
    handlers, propagates = list(log.handlers), log.propagate
    yield
    log.handlers[:], log.propagate = handlers, propagates


def job_in(out: Path) -> Job:
    path = Path(__file__).resolve().parents[2] / "sample_data"
    config = load_config(settings=["input.count=3"], environ={})
    return Job("sample", "icp", 0, path, config, out / "runs" / "sample" / "icp-s0", "digest", "lslam sweep")


def in_the_relay(*given: object) -> None:
    raise RuntimeError(MOTHS)


def test_a_mistake_within_a_run_ends_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Icp, "register", in_the_relay)
    job = job_in(tmp_path)
    execute(job, WorkerContext())
    said = (job.folder / "log.txt").read_text()
    assert said.index("3 scans of") < said.index("Traceback (most recent call last)") < said.index("in in_the_relay")
    assert said.endswith(f"RuntimeError: {MOTHS}\n")
    results = Results("moths", tmp_path, [job], {"icp": Variant("icp", job.config, "icp")})
    results.add([job])
    (row,) = read_study_csv(tmp_path / "results.csv")
    assert row.status == "failed"
    assert row.reason == "lslam made a mistake (RuntimeError: moths): its log.txt says where"


def test_a_mistake_before_a_run_has_a_log_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "_run", in_the_relay)
    job = job_in(tmp_path)
    execute(job, WorkerContext())
    assert "in in_the_relay" in (job.folder / "log.txt").read_text()
    state = read_state(job.state_file)
    assert state is not None
    assert state.reason.startswith("lslam made a mistake (RuntimeError: moths)")


def test_what_a_mistake_before_a_run_left_is_no_obstacle_to_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_in(tmp_path)
    with monkeypatch.context() as broken:
        broken.setattr(worker, "_run", in_the_relay)
        execute(job, WorkerContext())
    execute(job, WorkerContext())
    state = read_state(job.state_file)
    assert state is not None
    assert (state.status, state.reason) == ("done", "")
    assert "in_the_relay" not in (job.folder / "log.txt").read_text()


def test_a_log_that_cannot_be_written_is_not_promised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "_run", in_the_relay)
    job = job_in(tmp_path)
    job.folder.parent.mkdir(parents=True)
    job.folder.write_text("in the way")
    execute(job, WorkerContext())
    state = read_state(job.state_file)
    assert state is not None
    assert state.reason == "lslam made a mistake (RuntimeError: moths)"


def test_a_mistake_without_a_word_is_named_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*given: object) -> None:
        raise AssertionError

    monkeypatch.setattr(worker, "_run", silent)
    job = job_in(tmp_path)
    execute(job, WorkerContext())
    state = read_state(job.state_file)
    assert state is not None
    assert state.reason == "lslam made a mistake (AssertionError): its log.txt says where"


@pytest.mark.parametrize("again", [0, 2])
def test_a_run_that_is_ended_in_a_process_of_its_own_is_interrupted_after_the_scan_at_hand(
    again: int, laps: Path, tmp_path: Path
) -> None:
    """However often it is told: the system tells the whole group, and the parent its children."""
    config = load_config(settings=["map.write=false", "report.html=false"], environ={})
    job = Job("laps", "icp", 0, laps, config, tmp_path / "runs" / "laps" / "icp-s0", "digest", "lslam sweep")

    def end_it() -> None:
        end = time.monotonic() + 120
        while not any(job.folder.glob("checkpoint/odometry-*.npz")) and time.monotonic() < end:
            time.sleep(0.01)
        (child,) = [process for process in active_children() if process.name == "lslam worker"]
        assert child.pid is not None
        for _ in range(1 + again):
            os.kill(child.pid, signal.SIGTERM)
            time.sleep(0.003)

    ended: list[str] = []
    killer = threading.Thread(target=end_it)
    task = Task("laps", partial(execute, job, WorkerContext()), tmp_path / "laps.out")
    run_tasks([task], WorkerPool(1), lambda index: killer.start(), lambda index, cause: ended.append(cause))
    killer.join()
    assert ended == ["the process ended with exit code 130"]
    state = read_state(job.state_file)
    assert state is not None
    assert state.status == "interrupted"
    manifest = json.loads((job.folder / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    scans = manifest["counts"]["scans"]
    assert 0 < scans < len(list((laps / "velodyne").iterdir()))
    newest = max((job.folder / "checkpoint").glob("odometry-*.npz"))
    assert int(newest.stem.split("-")[-1]) == scans, "the last scan is in a checkpoint"


@pytest.fixture(scope="module")
def laps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's round driven many times, by links."""
    source = Path(__file__).resolve().parents[2] / "sample_data" / "sequences" / "00" / "velodyne"
    target = tmp_path_factory.mktemp("laps") / "velodyne"
    target.mkdir()
    for k in range(94 * 20):
        (target / f"{k:06d}.bin").symlink_to(source / f"{k % 94:06d}.bin")
    return target.parent


def test_a_run_that_is_done_has_no_reason_though_it_warned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared, "describe_deskew", lambda *given: ("no deskew: the points have no times", True))
    job = job_in(tmp_path)
    execute(job, WorkerContext())
    assert "no deskew" in (job.folder / "manifest.json").read_text()
    state = read_state(job.state_file)
    assert state is not None
    assert (state.status, state.reason) == ("done", "")
