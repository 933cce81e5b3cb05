"""Batches of recordings of one name and of some that cannot be read: a row for each, by its path; and --json."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from unittest import mock

import pytest
from calling import Done, lslam, sample_copy

from lslam.core.errors import InputError
from lslam.studies.results_csv import read_study_csv
from lslam.studies.subjects import unique_labels

pytestmark = pytest.mark.usefixtures("forked_runs")

FAST = "[config]\nmap.write = false\nreport.html = false\ninput.count = 3\n"


def fed(text: str, *words: object) -> Done:
    """`lslam batch -` with these lines on stdin, in this process."""
    with mock.patch.object(sys, "stdin", io.StringIO(text)):
        return lslam("batch", "-", *words)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three of one name in folders of their own; the second one has no scans left."""
    root = tmp_path_factory.mktemp("days")
    copies = [sample_copy(root / day / "drive", 4) for day in ("monday", "tuesday", "friday")]
    for scan in (copies[1]).rglob("*.bin"):
        scan.unlink()
    return copies


def test_one_that_cannot_be_read_is_a_failed_row_and_rows_go_by_path(recordings: list[Path], tmp_path: Path) -> None:
    file, out = tmp_path / "jobs.toml", tmp_path / "out"
    file.write_text(FAST + f"[[jobs]]\nsequences = {[str(path) for path in recordings]}\nmethods = ['icp']\n")
    done = lslam("batch", file, "--out", out, "--jobs", "1", "--json")
    assert done.returncode == 1, done.stderr
    assert "1 of 3 runs failed" in done.stderr
    rows = read_study_csv(out / "results.csv")
    assert [row.status for row in rows] == ["done", "failed", "done"]
    assert [row.path for row in rows] == [str(path) for path in recordings]
    assert (
        len({row.sequence for row in rows}) == len({row.folder for row in rows}) == len({row.run for row in rows}) == 3
    )
    assert "holds no scans" in rows[1].reason
    assert (out / rows[2].folder / "trajectory.tum").is_file()
    document = json.loads(done.stdout)
    assert [run["path"] for run in document["runs"]] == [str(path) for path in recordings]
    assert document["runs"][1]["ate_se3"] is None
    assert document["results"] == str(out / "results.csv")
    again = lslam("batch", file, "--out", out, "--resume", "--jobs", "1")
    assert again.returncode == 1
    assert [row.status for row in read_study_csv(out / "results.csv")] == ["done", "failed", "done"]


def test_a_line_that_cannot_be_read_is_a_failed_row_too(recordings: list[Path], tmp_path: Path) -> None:
    options = "--count 3 --set map.write=false --set report.html=false"
    lines = "\n".join(f"lslam run {path} {options}" for path in (recordings[0], "nowhere", recordings[2]))
    plan = json.loads(fed(lines, "--out", tmp_path / "out", "--dry-run", "--json").stdout)
    assert [bool(run["refusal"]) for run in plan["runs"]] == [False, True, False]
    done = fed(lines, "--out", tmp_path / "out", "--jobs", "1")
    assert done.returncode == 1, done.stderr
    rows = read_study_csv(tmp_path / "out" / "results.csv")
    assert [row.status for row in rows] == ["done", "failed", "done"]
    assert rows[1].reason.startswith("line 2: no sequence 'nowhere'")
    assert rows[0].sequence != rows[2].sequence
    assert rows[0].path == str(recordings[0])


def test_a_batch_of_nothing_readable_ends_at_once(recordings: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "jobs.toml"
    file.write_text(f"[[jobs]]\nsequences = ['nowhere', '{recordings[1]}']\nmethods = ['icp']\n")
    done = lslam("batch", file, "--out", tmp_path / "out")
    assert done.returncode == InputError.exit_code == 3
    assert not (tmp_path / "out").exists()


def test_one_path_has_one_label_and_two_have_two() -> None:
    paths = [Path("/d/mon/drive.bag"), Path("/d/tue/drive.bag"), Path("/d/mon/drive.bag"), Path("/d/x"), None]
    labels = unique_labels(["drive", "drive", "drive", "x", "town"], paths)
    assert labels == ["drive-mon", "drive-tue", "drive-mon", "x", "town"]
    alike = [Path("/a/b/s"), Path("/a/c/s"), Path("/e/c/s")]
    assert unique_labels(["s", "s", "s"], alike) == ["s-1", "s-2", "s-3"]
    assert unique_labels(["s", "s", "s-b"], [alike[0], alike[1], Path("/z")]) == ["s-b-2", "s-c", "s-b"]


def test_convert_and_simulate_print_one_object(recordings: list[Path], tmp_path: Path) -> None:
    done = lslam("convert", recordings[0], "--to", "kitti", "--out", tmp_path / "copy", "--json")
    assert json.loads(done.stdout) == {"path": str(tmp_path / "copy"), "format": "kitti", "scans": 4, "skipped": 0}
    poses, out = recordings[0].parents[1] / "poses" / "00.txt", tmp_path / "a.tum"
    words = ("convert", poses, "--to", "tum", "--from-frame", "lidar", "--frame", "lidar", "--out", out, "--json")
    done = lslam(*words)
    assert json.loads(done.stdout)["poses"] > 0, done.stderr
    town = ("simulate", "block", "--count", "2", "--lidar", "vlp16", "--out", tmp_path / "town", "--json")
    document = json.loads(lslam(*town).stdout)
    assert (document["scans"], Path(document["sequence"]).is_dir()) == (2, True)
    assert "block" in json.loads(lslam("simulate", "--list", "--json").stdout)["scenarios"]


def test_sweep_prints_one_object(recordings: list[Path], tmp_path: Path) -> None:
    assert "skip-frames" in json.loads(lslam("sweep", "--list", "--json").stdout)["studies"]
    study = tmp_path / "study.toml"
    study.write_text(
        "summary = 'steps'\nmethods = ['icp']\n"
        f"sequences = [{{ path = '{recordings[0]}' }}]\n[parameters]\ninput.skip_frames = [1, 2]\n"
        "[config]\nmap.write = false\nreport.html = false\n"
    )
    plan = json.loads(lslam("sweep", study, "--dry-run", "--json", "--out", tmp_path / "out").stdout)
    assert len(plan["runs"]) == len(plan["left_to_do"]) == 2
