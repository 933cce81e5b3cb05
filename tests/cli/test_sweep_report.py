"""`lslam sweep --report`: a page and verdicts from results.csv, without a run."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from calling import assert_one_sentence, lslam

from lslam.core.types.study import StudyRow
from lslam.studies.results_csv import write_study_csv

STUDY = """
summary = "every n-th scan"
name = "skips"
methods = ["icp"]
sequences = [{ scenario = "open" }]
[parameters]
input.skip_frames = [1, 2, 3, 4]
[[finding]]
text = "ICP works up to 3"
kind = "diverges_beyond"
values = [3]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A study of eight runs as `lslam sweep` leaves it."""
    rows = [
        StudyRow(
            f"r{v}-{seed}", "skips", "open", seed, "icp", parameters={"input.skip_frames": v},
            status="diverged" if v > 3 else "done", reason="lost" if v > 3 else "", thesis_rmse=0.1, metric="thesis_rmse",
            angular_rmse_deg=0.5, scans=60, stages_ms={"register": 10.0}, total_time_s=6.0 / v,
        )
        for v in (1, 2, 3, 4)
        for seed in (0, 1)
    ]  # fmt: skip
    write_study_csv(tmp_path / "results.csv", rows)
    return tmp_path


def test_report_is_written_anew_with_the_findings_of_the_study(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)
    done = lslam("sweep", "--report", folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "confirmed: ICP works up to 3; here 3 is the last value that works\n"
    assert "every n-th scan" in (folder / "report.html").read_text()
    assert {path.name for path in folder.glob("report.*")} == {"report.html", "report.md", "report.tex", "report.csv"}


def test_results_alone_make_a_report_without_verdicts(folder: Path) -> None:
    done = lslam("sweep", "--report", folder, "-q")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert "<h1>skips</h1>" in (folder / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (("--report", "none"), 3, "none/results.csv does not exist"),
        (("--report", "empty"), 3, "study empty has no finished run yet"),
        (("--report", "taken"), 3, "folder taken/figures cannot be made"),
        (("skip-frames", "--report", "."), 2, "leave out skip-frames"),
    ],
)
def test_folders_without_a_study_are_answered_in_one_sentence(
    words: tuple[str, ...], code: int, sentence: str, folder: Path
) -> None:
    for name in ("empty", "taken"):
        (folder / name).mkdir()
    write_study_csv(folder / "empty" / "results.csv", [])
    shutil.copy(folder / "results.csv", folder / "taken")
    (folder / "taken" / "figures").write_text("a file")
    done = lslam("sweep", *words, cwd=folder)
    assert done.returncode == code, done.stderr
    assert_one_sentence(done.stderr)
    assert sentence in done.stderr
