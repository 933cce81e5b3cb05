"""`lslam simulate` as a user calls it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


def lslam(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "lslam", "simulate", *arguments], capture_output=True, text=True, timeout=120
    )


def test_a_drive_is_written_and_summed_up_in_one_line(tmp_path: Path) -> None:
    out = tmp_path / "town"
    done = lslam("block", "--out", str(out), "--count", "3", "--seed", "5", "--lidar", "vlp16", "--distorted")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert f"{out / 'sequences' / '00'}: 3 scans" in done.stdout
    assert len(list((out / "sequences" / "00" / "velodyne").glob("*.bin"))) == 3
    assert "motion_compensated = false" in (out / "sequences" / "00" / "sequence.toml").read_text()
    again = lslam("block", "--out", str(out), "--count", "3")
    assert again.returncode == 2
    assert again.stdout == ""
    assert "--overwrite" in again.stderr


def test_list_names_scenarios_and_sensors() -> None:
    listed = lslam("--list")
    assert listed.returncode == 0
    assert [line.split()[1] for line in listed.stdout.splitlines()] == [
        "block", "climbing", "closed", "corridor", "identical", "large-eight", "motorway", "open", "residential",
        "small-eight", "street", "urban", "walk", "sample", "vlp16", "hdl64", "hdl64-kitti", "os1-32", "os1-64", "livox",
        "icm20948", "icm20948-calibrated", "ideal",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["blok", "--out", "OUT"], "did you mean 'block'"),
        (["block"], "--out DIR is missing"),
        ([], "SCENARIO is missing"),
        (["street", "--out", "OUT", "--count", "5000"], "--speed"),
        (["block", "--out", "OUT", "--speed", "90"], "at most 40 m/s"),
        (["block", "--out", "OUT", "--lidar", "lidex"], "no LiDAR 'lidex'"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_code_2(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = lslam(*[str(out) if a == "OUT" else a for a in arguments])
    assert done.returncode == 2
    assert done.stdout == ""
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()


def test_an_output_that_cannot_be_written_is_exit_code_3(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = lslam("block", "--out", str(tmp_path / "file" / "below"), "--count", "1")
    assert done.returncode == 3
    assert "cannot be" in done.stderr
    assert "Traceback" not in done.stderr
