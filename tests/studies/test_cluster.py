"""A Dask cluster on loopback: a worker that is killed costs time, and what the cluster lacks is said in one sentence."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from distributed import LocalCluster

from lslam.cli.options import engine_of
from lslam.core.config.study import parse_study
from lslam.core.errors import InputError, RunFailedError, UsageError
from lslam.core.types.study import StudyRow
from lslam.studies import cluster
from lslam.studies.cluster import Cluster, connect, pack, unpack
from lslam.studies.grid import Job
from lslam.studies.options import OutputOptions
from lslam.studies.results_csv import State, read_state, read_study_csv, write_state
from lslam.studies.runner import StudyProgress
from lslam.studies.study_runs import Sweep, expand_study, run_sweep
from lslam.studies.worker import WorkerContext

TREE = {
    "sequences": [{"scenario": "block", "lidar": "sample", "columns": 256, "scans": 12}],
    "methods": ["icp"],
    "parameters": {"preprocess.source_voxel": [0.6, 0.7, 0.8, 0.9, 1.0, 1.1]},
    "config": {"loops": {"use": False}, "preprocess": {"downsample": "grid"}},
}


@pytest.fixture(scope="module")
def workers() -> Iterator[LocalCluster]:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as made:
        yield made


def job(tmp_path: Path) -> Job:
    """Of a recording that lies nowhere."""
    sweep = Sweep(parse_study(TREE, "tiny", "tiny"), OutputOptions(tmp_path / "out"))
    return replace(expand_study(sweep).jobs[0], scene=None, path=Path("/nowhere/00"))


def test_a_worker_killed_in_the_middle_loses_nothing_and_counts_nothing_twice(
    workers: LocalCluster, tmp_path: Path
) -> None:
    sweep = Sweep(parse_study(TREE, "tiny", "tiny"), OutputOptions(tmp_path / "out"))
    victim = next(iter(workers.workers.values())).pid
    steps: list[str] = []

    def kill_one(rows: list[StudyRow]) -> None:
        if len(rows) == 1:
            os.kill(victim, signal.SIGKILL)

    with connect(workers.scheduler_address, None, "studying") as engine:
        assert engine.at_once == 2
        rows = run_sweep(sweep, engine, StudyProgress(on_step=steps.append), kill_one)  # type: ignore[arg-type]
    assert len(steps) == len(set(steps)) == 6
    assert [row.parameters["preprocess.source_voxel"] for row in rows] == [0.6, 0.7, 0.8, 0.9, 1.0, 1.1]
    assert {row.status for row in rows} == {"done"}
    assert not any(row.is_timing_comparable for row in rows), "others may share the worker's machine"
    assert not (sweep.output.out / "simulated").exists(), "workers simulate by themselves"
    for row in rows:
        assert (sweep.output.out / row.folder / "trajectory.tum").is_file(), "run folders come home"
    assert [repr(row) for row in read_study_csv(sweep.output.out / "results.csv")] == [repr(row) for row in rows]


def test_workers_without_the_recording_are_named(workers: LocalCluster, tmp_path: Path) -> None:
    with (
        connect(workers.scheduler_address, None, "studying") as engine,
        pytest.raises(InputError, match=r"worker tcp://.* does not have /nowhere/00: the recordings must lie there"),
    ):
        engine.prepare([job(tmp_path)], StudyProgress())


def test_workers_of_another_version_are_named(
    workers: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "__version__", "9.9")
    with (
        connect(workers.scheduler_address, None, "studying") as engine,
        pytest.raises(InputError, match=r"worker tcp://.* has lslam .*, this is 9\.9: install the same"),
    ):
        engine.prepare([job(tmp_path)], StudyProgress())


def test_workers_without_lslam_are_named(
    workers: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(paths: list[str]) -> None:
        raise ModuleNotFoundError("No module named 'lslam'")

    monkeypatch.setattr(cluster, "_inspect", fail)
    with (
        connect(workers.scheduler_address, None, "studying") as engine,
        pytest.raises(InputError, match=r"worker tcp://.* cannot run lslam: No module named 'lslam'; install it there"),
    ):
        engine.prepare([job(tmp_path)], StudyProgress())


def test_a_scheduler_without_workers_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_WORKERS_S", 1)
    with (
        LocalCluster(n_workers=0, threads_per_worker=1, dashboard_address=None, silence_logs=50) as empty,
        connect(empty.scheduler_address, None, "studying") as engine,
        pytest.raises(RunFailedError, match=r"has no workers: start some, `dask worker tcp://"),
    ):
        engine.prepare([job(tmp_path)], StudyProgress())


def test_an_unreachable_scheduler_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_ANSWER_S", 1)
    for address in ("tcp://127.0.0.1:9", "nonsense://there"):
        with (
            pytest.raises(InputError, match=f"the scheduler {address} does not answer within 1 s"),
            connect(address, None, "studying"),
        ):
            pass


def test_the_error_about_missing_dask_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install .*\[cluster\]"), connect("tcp://127.0.0.1:9", None, ""):
        pass


class Gone:
    """A client whose runs end as they are told to, and as many futures."""

    def __init__(self, status: str, *errors: Exception | None) -> None:
        self.status, self.errors = status, list(errors)
        self.given: list[tuple[object, ...]] = []

    def scheduler_info(self, n_workers: int) -> dict[str, Any]:
        return {"workers": {}}

    def submit(self, work: object, *words: object, **more: object) -> Gone:
        self.given.append(words)
        return Gone(self.status, self.errors.pop(0))

    def exception(self) -> Exception | None:
        return self.errors[0]

    def cancelled(self) -> bool:
        return self.status == "connecting"

    def release(self) -> None:
        """Nothing is held."""

    def cancel(self, futures: list[Gone], force: bool) -> None:
        """Likewise."""

    def close(self, timeout: float) -> None:
        """Likewise."""


def test_a_lost_scheduler_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("distributed.as_completed", iter)
    monkeypatch.setattr(cluster, "_PATIENCE_S", 0)
    monkeypatch.setattr(cluster, "_ANSWER_S", 1)
    engine = Cluster(Gone("connecting", None), "tcp://127.0.0.1:9", "studying")
    with pytest.raises(
        RunFailedError, match=r"tcp://127.0.0.1:9 went away after 0 of 1 runs: start it, and .*--resume"
    ):
        engine.run([job(tmp_path)], StudyProgress(), lambda job: None)


def test_a_scheduler_that_is_restarted_gets_the_runs_that_are_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_PAUSE_S", 0.05)
    monkeypatch.setattr(cluster, "_PATIENCE_S", 20)
    jobs = [replace(job(tmp_path), folder=tmp_path / "out" / str(k), digest=str(k)) for k in range(6)]
    done: list[str] = []
    nets: list[LocalCluster] = []

    def start(port: int) -> str:
        nets.append(
            LocalCluster(
                n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None,
                scheduler_port=port, silence_logs=50,
            )
        )  # fmt: skip
        return str(nets[-1].scheduler_address)

    def on_done(one: Job) -> None:
        done.append(one.digest)
        if len(done) == 2:
            nets[0].close()
            start(port)

    address = start(0)
    port = int(address.rpartition(":")[2])
    try:
        with connect(address, None, "studying") as engine:
            engine.run(jobs, StudyProgress(), on_done)
    finally:
        nets[-1].close()
    assert sorted(done) == [one.digest for one in jobs], "each once"
    states = [read_state(one.state_file) for one in jobs]
    assert [(state.digest, state.status) for state in states if state] == [(one.digest, "failed") for one in jobs]
    assert not list(tmp_path.rglob("*.part"))


def test_a_run_whose_workers_all_died_is_a_row_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("distributed.as_completed", iter)
    engine = Cluster(Gone("running", MemoryError("three workers died")), "tcp://there:1", "studying")
    run, done = job(tmp_path), []
    engine.run([run], StudyProgress(), done.append)
    state = read_state(run.state_file)
    assert state is not None
    assert (state.status, state.reason, done) == ("crashed", "its worker failed: three workers died", [run])


@pytest.mark.parametrize("is_persistent", [True, False])
def test_workers_keep_data_between_runs_when_the_study_asks_for_it(
    is_persistent: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch does not: each of its runs keeps its keyframes, here as on one machine."""
    monkeypatch.setattr("distributed.as_completed", iter)
    client = Gone("running", MemoryError("three workers died"))

    @contextmanager
    def there(*words: object, is_persistent: bool) -> Iterator[Cluster]:
        yield Cluster(client, "tcp://there:1", "", is_persistent=is_persistent)

    monkeypatch.setattr(cluster, "connect", there)
    run = job(tmp_path)
    with engine_of({"jobs": None, "scheduler": "tcp://there:1", "cluster": None}, "", is_persistent) as engine:
        engine.run([run], StudyProgress(), lambda job: None)
    assert client.given == [(run, WorkerContext(1, is_alone=False, is_persistent=is_persistent))]


def test_a_run_that_comes_home_replaces_what_was_there(tmp_path: Path) -> None:
    there, here = tmp_path / "there", job(tmp_path)
    (there / "run" / "keyframes").mkdir(parents=True)
    (there / "run" / "manifest.json").write_text("new")
    (there / "run" / "keyframes" / "0.npz").write_text("cloud")
    write_state(there / "run.json", State("digest", "done"))
    here.folder.mkdir(parents=True)
    (here.folder / "old").write_text("old")
    unpack(pack(there), here)
    assert sorted(p.name for p in here.folder.iterdir()) == ["keyframes", "manifest.json"]
    assert read_state(here.state_file) == State("digest", "done")
    assert sorted(p.name for p in here.folder.parent.iterdir()) == [here.folder.name, here.state_file.name]


def test_workers_of_this_machine_read_what_is_simulated_here(tmp_path: Path) -> None:
    sweep = Sweep(parse_study(TREE, "tiny", "tiny"), OutputOptions(tmp_path / "out"))
    scenes: list[str] = []
    with connect(None, "local:1", "studying") as engine:
        assert engine.at_once == 1
        jobs = expand_study(sweep).jobs
        engine.prepare(jobs, StudyProgress(on_step=scenes.append))
    assert scenes == ["block 0"]
    assert jobs[0].path.is_dir()
