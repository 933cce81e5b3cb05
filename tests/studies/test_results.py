"""results.csv while a study goes on: as soon as a run ends, but for long tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from lslam.core.config import Config
from lslam.studies import results
from lslam.studies.grid import Job
from lslam.studies.results import Results
from lslam.studies.results_csv import read_study_csv
from lslam.studies.variants import Variant


def results_of(out: Path, runs: int) -> tuple[Results, list[Job]]:
    jobs = [Job(f"drive{k}", "icp", 0, out, Config(), out / "runs" / f"{k}", str(k), "") for k in range(runs)]
    return Results("night", out, jobs, {"icp": Variant("icp", Config(), "icp")}), jobs


def rows_in(out: Path) -> list[str]:
    return [row.sequence for row in read_study_csv(out / "results.csv")]


def test_a_row_is_there_as_soon_as_its_run_has_ended(tmp_path: Path) -> None:
    made, jobs = results_of(tmp_path, 3)
    for k, job in enumerate(jobs):
        made.add([job])
        assert len(rows_in(tmp_path)) == k + 1


def test_a_long_table_is_not_written_for_every_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "_MANY", 1)
    monkeypatch.setattr(results, "_PARTS", 10**6)
    made, jobs = results_of(tmp_path, 4)
    for job in jobs:
        made.add([job])
    assert rows_in(tmp_path) == ["drive0"]
    made.flush()
    assert rows_in(tmp_path) == [job.sequence for job in jobs]
