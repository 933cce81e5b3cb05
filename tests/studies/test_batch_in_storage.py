"""A batch of recordings in storage, with its runs back there: nothing is opened here or comes home, what is done is kept."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import LocalCluster
from storages import Counted, counted, stored
from stub_sequences import SAMPLE

from lslam.core.config.study import BatchConfig, parse_batch
from lslam.core.types.study import StudyRow
from lslam.io.remote import RemotePath
from lslam.pipeline.run_folder import spool_of
from lslam.studies.batch_runs import expand_batch, expand_lines, listed_line
from lslam.studies.cluster import connect
from lslam.studies.jobs import folders_of_finished, make_runs, output_file
from lslam.studies.options import OutputOptions
from lslam.studies.results_csv import read_state, read_study_csv


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RemotePath]:
    monkeypatch.setattr("lslam.pipeline.run_folder.cache_folder", lambda name: tmp_path / name)
    with counted() as root:
        for name in ("drive7", "drive8"):
            for part in ("sequences", "poses"):
                stored(SAMPLE / part, root / "fleet" / name / part)
        yield root


def batch_of(bucket: RemotePath) -> BatchConfig:
    config = {"input": {"count": 3}, "report": {"html": False}, "map": {"write": False}, "loops": {"use": False}}
    sequences = [f"{bucket}/fleet/drive7", f"{bucket}/fleet/drive8"]
    return parse_batch({"config": config, "jobs": [{"sequences": sequences}]}, "fleet.toml")


def made(bucket: RemotePath, resume: bool = False) -> list[StudyRow]:
    output = OutputOptions(bucket / "results", resume=resume)
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None, silence_logs=50
        ) as net,
        connect(net.scheduler_address, None, "runs", is_persistent=False) as engine,
    ):
        return make_runs(expand_batch(batch_of(bucket), output), output, engine)


def test_recordings_are_listed_and_not_opened(bucket: RemotePath) -> None:
    Counted.got.clear()
    jobs = expand_batch(batch_of(bucket), OutputOptions(bucket / "results")).jobs
    assert Counted.got == []
    assert [str(job.folder) for job in jobs] == [
        f"{bucket}/results/runs/{name}/icp-s0" for name in ("drive7", "drive8")
    ]
    (bucket / "fleet" / "drive8" / "sequences" / "00" / "times.txt").write_bytes(b"0\n1\n")
    again = expand_batch(batch_of(bucket), OutputOptions(bucket / "results")).jobs
    assert [a.digest == b.digest for a, b in zip(jobs, again, strict=True)] == [True, False]


def test_runs_go_to_storage_and_those_with_a_manifest_there_are_kept(bucket: RemotePath) -> None:
    rows = made(bucket)
    assert [(row.sequence, row.status, row.scans, row.folder) for row in rows] == [
        (name, "done", 3, f"runs/{name}/icp-s0") for name in ("drive7", "drive8")
    ]
    results = bucket / "results"
    assert [repr(row) for row in read_study_csv(results / "results.csv")] == [repr(row) for row in rows]
    assert all((results / row.folder / "trajectory.tum").is_file() for row in rows)
    state = read_state(results / "runs" / "drive7" / "icp-s0.json")
    assert state is not None
    assert state.status == "done"
    # An upload that was broken off.
    (results / "runs" / "drive8" / "icp-s0" / "manifest.json").unlink()
    jobs = expand_batch(batch_of(bucket), OutputOptions(results)).jobs
    assert folders_of_finished(jobs) == {jobs[0].folder}
    Counted.put.clear()
    again = made(bucket, resume=True)
    assert [row.status for row in again] == ["done", "done"]
    assert {name.split("/")[4] for name in Counted.put} == {"drive8"}


def test_a_line_may_have_its_folder_there_and_the_table_here(bucket: RemotePath, tmp_path: Path) -> None:
    config = expand_batch(batch_of(bucket), OutputOptions(bucket / "results")).jobs[0].config
    lines = [
        listed_line(f"{name} --out", bucket / "fleet" / name, config, bucket / "results" / name)
        for name in ("drive7", "drive8")
    ]
    jobs = expand_lines(lines, OutputOptions(tmp_path / "out")).jobs
    assert [str(job.folder) for job in jobs] == [f"{bucket}/results/{name}" for name in ("drive7", "drive8")]
    assert output_file(jobs[0].folder).parent == spool_of(bucket / "x").parent, "what its process prints is a file here"
