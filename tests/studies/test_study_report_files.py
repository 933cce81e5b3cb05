"""A study's report from its rows alone, as `lslam sweep --report` writes it."""

from __future__ import annotations

from pathlib import Path

import pytest

from lslam.core.config.study import ExpectedFinding
from lslam.core.types.study import StudyRow
from lslam.studies.results_csv import read_study_csv, write_study_csv
from lslam.studies.study_runs import report_folder, write_study_report


def test_report_of_rows_read_back_is_that_of_the_rows(tmp_path: Path) -> None:
    rows = [
        StudyRow(
            f"r{v}-{seed}", "skip", "open", seed, "icp", False, {"input.skip_frames": v}, status="diverged" if v > 3 else "done",
            thesis_rmse=0.1 * v, metric="thesis_rmse", angular_rmse_deg=1.0, stages_ms={"register": 10.0}, total_time_s=10.0 / v,
        )
        for v in range(1, 6)
        for seed in (0, 1)
    ]  # fmt: skip
    write_study_csv(tmp_path / "results.csv", rows)
    finding = ExpectedFinding(text="up to 3", kind="diverges_beyond", values=(3,))
    first = write_study_report(tmp_path / "a", rows, [finding], "skipped scans")
    write_study_report(tmp_path / "b", read_study_csv(tmp_path / "results.csv"), [finding], "skipped scans")
    assert first[0].verdicts[0].outcome == "confirmed"
    names = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert len(names) > 8
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_log_says_when_times_cannot_be_compared(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for is_comparable, expected in ((True, 0), (False, 1)):
        caplog.clear()
        row = StudyRow(
            "r", "skip", "open", 0, "icp", parameters={"input.skip_frames": 1}, status="done", ate_se3=0.1,
            angular_rmse_deg=1.0, scans=9, stages_ms={"register": 10.0}, total_time_s=1.0, is_timing_comparable=is_comparable,
        )  # fmt: skip
        write_study_csv(tmp_path / "results.csv", [row])
        report_folder(tmp_path)
        said = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
        assert len(said) == expected
        assert all(sentence.startswith("1 of 1 run shared a core") for sentence in said)
