"""results.csv: every row comes back as it was, whatever the runs have in common."""

from __future__ import annotations

import csv
from dataclasses import replace
from math import isnan
from pathlib import Path

import pytest

from lslam.core.errors import InputError
from lslam.core.types.study import StudyRow, Value
from lslam.studies.results_csv import read_study_csv, write_study_csv

DONE = StudyRow(
    "open-0/thesis-icp/1", "skip frames", "open", 0, "thesis-icp", True, {"input.skip_frames": 3, "map.voxel": 0.1 + 0.2},
    status="done", thesis_rmse=1 / 3, ate_se3=0.2, ate_origin=0.7, angular_rmse_deg=1.5, scans=9,
    stages_ms={"read": 1.25, "register": 7.0}, total_time_s=0.5, run_s=2.0, bridged_share=0.0, fallback_share=0.125, digest="ab",
    machine="here", folder="runs/1",
)  # fmt: skip
FAILED = replace(
    StudyRow("open-0/loam/2", "skip frames", "open", 0, "loam"), status="crashed", parameters={"registration.target": "scan"},
    reason='killed, "by" \u00fcs\nall', is_timing_comparable=False,
)  # fmt: skip
ROWS = [DONE, FAILED, replace(DONE, run="3", is_beside=True, parameters={}, stages_ms={"map": 3.0})]


def same(a: StudyRow, b: StudyRow) -> bool:
    """nan is no number, but it is the same nothing."""
    return repr(a) == repr(b)


def test_rows_come_back_exactly(tmp_path: Path) -> None:
    write_study_csv(tmp_path / "results.csv", ROWS)
    again = read_study_csv(tmp_path / "results.csv")
    assert [same(a, b) for a, b in zip(again, ROWS, strict=True)] == [True] * 3
    assert isinstance(again[0].parameters["input.skip_frames"], int)
    assert isnan(again[1].ate_se3)


@pytest.mark.parametrize(
    "value",
    [
        "nan",
        "inf",
        "-inf",
        "1_000",
        "007",
        "1.",
        "+3",
        " 3",
        "\u0663",
        "scan",
        0,
        -3,
        10**20,
        0.5,
        -1e-9,
        1e300,
        1e22,
        True,
        False,
    ],
)
def test_a_parameter_comes_back_as_it_was(tmp_path: Path, value: Value) -> None:
    write_study_csv(tmp_path / "results.csv", [replace(DONE, parameters={"registration.target": value})])
    (row,) = read_study_csv(tmp_path / "results.csv")
    again = row.parameters["registration.target"]
    assert (type(again), again) == (type(value), value)


def test_others_find_columns_by_the_names_of_the_keys(tmp_path: Path) -> None:
    write_study_csv(tmp_path / "results.csv", ROWS)
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as stream:
        first, second, third = csv.DictReader(stream)
    assert (first["input.skip_frames"], first["uses_imu"], first["time_per_scan_ms"]) == ("3", "true", "8.25")
    assert (second["registration.target"], second["ate_se3"], second["is_diverged"]) == ("scan", "", "false")
    assert (third["stage_ms.map"], third["stage_ms.read"], third["is_beside"]) == ("3.0", "", "true")


def test_no_rows_are_a_file_too(tmp_path: Path) -> None:
    write_study_csv(tmp_path / "results.csv", [])
    assert read_study_csv(tmp_path / "results.csv") == []


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("\n3,", "\n7,", "another version of lslam.*study version 7.*--overwrite makes its runs anew"),
        ("study_version,", "version,", "no column study_version"),
        ("ate_se3", "ate", "column ate_se3 is missing"),
        (",0.2,", ",much,", "line 2: could not convert string to float: 'much'"),
        (",true,", ",perhaps,", "line 2: 'perhaps' is neither true nor false"),
        (",here,", ",", "line 2: 31 columns where the header has 32"),
    ],
)
def test_results_of_another_version_are_an_error(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    path = tmp_path / "results.csv"
    write_study_csv(path, [DONE])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=sentence):
        read_study_csv(path)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_study_csv(tmp_path / "results.csv")


def test_an_unknown_metric_is_an_error(tmp_path: Path) -> None:
    write_study_csv(tmp_path / "results.csv", [replace(DONE, metric="folder")])
    with pytest.raises(InputError, match="line 2: metric 'folder' is none of ate_se3, ate_origin, thesis_rmse"):
        read_study_csv(tmp_path / "results.csv")
