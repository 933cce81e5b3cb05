"""Data that stay read: read once, forgotten within bounds, and never another run's notes."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from lslam.core.config.config import load_config
from lslam.core.types.scan import Scan
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.studies.grid import Job
from lslam.studies.jobs import Local
from lslam.studies.results_csv import read_state
from lslam.studies.runner import StudyProgress, Task
from lslam.studies.worker import ScanStore, SequenceCache, cache_limit, size_of

pytestmark = pytest.mark.usefixtures("forked_runs")
SHARES_TOWNS = False  # what is asked is who traces a scan


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("block", count=4, lidar="sample")


def test_a_scan_is_read_once_until_it_must_make_room(drive: SimulatedDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = [drive.scan(i) for i in range(4)]
    read: list[int] = []

    def scan(index: int) -> Scan:
        read.append(index)
        return scans[index]

    monkeypatch.setattr(drive, "scan", scan)
    store = ScanStore(sum(size_of(s) for s in scans[:3]) + 10)
    sequence = SequenceCache(store).get("drive", lambda: drive)
    assert [sequence.scan(i) is scans[i] for i in (0, 1, 0, 2, 0)] == [True] * 5
    assert read == [0, 1, 2]
    sequence.scan(3)  # 1 was used least lately
    sequence.scan(0)
    sequence.scan(1)
    assert read == [0, 1, 2, 3, 1]
    assert store.bytes <= store.most_bytes


def test_a_sequence_is_opened_once_and_each_run_has_notes_of_its_own(drive: SimulatedDrive) -> None:
    kept = SequenceCache(ScanStore(10**9))
    opened: list[int] = []

    def opening() -> SimulatedDrive:
        opened.append(1)
        return drive

    first = kept.get("drive", opening)
    first.notes.append("about this run")
    second = kept.get("drive", opening)
    other = kept.get("another", opening)
    assert len(opened) == 2
    assert second.notes == drive.notes == []
    assert len(second) == 4
    assert np.array_equal(second.scan(1).points, drive.scan(1).points)
    assert other.scan(1) is not second.scan(1)


def test_a_scan_that_two_threads_read_at_once_counts_once(drive: SimulatedDrive) -> None:
    scan, both = drive.scan(0), threading.Barrier(2, timeout=20)
    store = ScanStore(2 * size_of(scan))

    def read() -> Scan:
        both.wait()
        return scan

    threads = [threading.Thread(target=store.get, args=((0, 0), read)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.bytes == size_of(scan)


def test_cached_sequences_are_distinguished_by_their_options(tmp_path: Path) -> None:
    """A topic is of bags only, so the second run fails unless it is given the first one's sequence."""
    path = Path(__file__).resolve().parents[2] / "sample_data"
    config = load_config(None, ["input.count=2", "map.write=false", "report.html=false", "loops.use=false"], {})
    jobs = [
        Job("sample", "icp", k, path, config, tmp_path / str(k), str(k), "", reading=reading)
        for k, reading in enumerate([{}, {"lidar_topic": "/points"}])
    ]
    Local().run(jobs, StudyProgress())
    states = [read_state(job.state_file) for job in jobs]
    assert states[0] is not None
    assert states[1] is not None
    assert states[0].status in ("done", "degraded")
    assert (states[1].status, states[1].reason.partition(" is ")[0]) == ("failed", "--lidar-topic")


def test_several_at_once_begin_with_what_takes_longest_and_one_keeps_the_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = [
        Job("sample", f"{k}", 0, tmp_path, load_config(None, [setting], {}), tmp_path / f"{k}", "", "")
        for k, setting in enumerate(["input.skip_frames=3", "input.count=9", "input.skip_frames=2", "input.start=5"])
    ]
    begun: list[Task] = []

    def fake(tasks: list[Task], *given: object) -> None:
        begun[:] = tasks

    monkeypatch.setattr("lslam.studies.jobs.run_tasks", fake)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    for engine, order in (
        (Local(2), "3201"),
        (Local(2, is_persistent=False), "3201"),
        (Local(1), "0123"),
    ):
        engine.run(jobs, StudyProgress())
        assert [task.name for task in begun] == [f"sample {k} seed 0" for k in order]
        assert {task.data for task in begun} == {str(tmp_path) if engine.is_persistent else ""}


def test_memory_is_bounded_by_what_is_free() -> None:
    assert 0 < cache_limit() <= 2 * 10**9
