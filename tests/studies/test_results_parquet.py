"""results.parquet holds what results.csv holds, with types."""

from __future__ import annotations

from pathlib import Path

from pyarrow import parquet

from lslam.core.types.study import StudyRow
from lslam.studies.results_csv import write_study_parquet


def test_columns_have_types_and_what_is_not_there_is_null(tmp_path: Path) -> None:
    rows = [
        StudyRow("a", "s", "open", 0, "icp", parameters={"map.voxel": 1, "registration.target": "scan"}, scans=3),
        StudyRow("b", "s", "open", 1, "icp", parameters={"map.voxel": 0.5, "registration.target": 2}, ate_se3=0.1),
    ]
    write_study_parquet(tmp_path / "results.parquet", rows)
    table = parquet.read_table(tmp_path / "results.parquet").to_pydict()
    assert table["run"] == ["a", "b"]
    assert table["map.voxel"] == [1.0, 0.5]
    assert table["registration.target"] == ["scan", "2"]
    assert table["ate_se3"] == [None, 0.1]
    assert table["uses_imu"] == [False, False]


def test_no_rows_are_a_file_too(tmp_path: Path) -> None:
    write_study_parquet(tmp_path / "results.parquet", [])
    assert parquet.read_table(tmp_path / "results.parquet").num_rows == 0
