"""`lslam info` as a user calls it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, lslam
from sequence_builders import cloud, kitti_root, raw_drive

from lslam.core.types.imu import ImuStream
from lslam.io.formats.stamped_csv import read_imu_csv, write_imu_csv
from lslam.io.readers import open_sequence
from lslam.pipeline.doctor.inspect import inspect


def test_page_and_json(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (folder / "velodyne" / "000002.bin").write_bytes(bytes(1001))
    (folder / "velodyne" / "000003.bin").write_bytes(b"")
    page = lslam("info", "seq07", "--data-root", tmp_path, "-q")
    assert (page.returncode, page.stderr) == (0, "")
    for line in ("kitti-odometry", "6 in 0.50 s, 10 Hz", "6 (1 unreadable, 1 empty)", "path 5.00 m", "000002.bin"):
        assert line in page.stdout
    facts = json.loads(lslam("info", folder, "--json").stdout)
    assert (facts["schema"], facts["scans"], facts["format"]) == (2, 6, "kitti-odometry")
    assert facts["points"]["scans_unreadable"] == 1
    assert abs(facts["ground_truth"]["path_length_m"] - 5) < 1e-3


def test_what_is_missing_is_one_sentence_and_exit_3(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for words, part in (
        ((tmp_path / "empty",), "is empty"),
        ((tmp_path / "none",), "does not exist"),
        (("seq07", "--data-root", tmp_path), "no sequence 'seq07'"),
    ):
        result = lslam("info", *words)
        assert (result.returncode, result.stdout) == (3, "")
        assert part in result.stderr
        assert result.stderr.startswith("error: ")
        assert result.stderr.count("\n") == 1


def test_numbers_are_counted_right(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path, 4)
    table = cloud(1)
    table[:30, :3], table[30:45, 1] = 0, np.nan
    table.tofile(folder / "velodyne" / "000001.bin")
    points = inspect(open_sequence(folder))["points"]
    assert points["share_zero"] == 30 / 1200
    assert points["share_nan"] == 15 / 1200
    assert points["count"] == {"min": 300, "median": 300.0, "max": 300}
    assert 5 <= points["range_m"]["min"] < points["range_m"]["max"] <= 50.001
    assert -24 < points["elevation_deg"][0] < points["elevation_deg"][1] < 2.3


def test_gaps_and_imu_units(tmp_path: Path) -> None:
    drive = raw_drive(tmp_path, 8)
    for k in (3, 4):
        (drive / "velodyne_points" / "data" / f"{k:010d}.bin").unlink()
    facts = inspect(open_sequence(drive), is_quick=True)
    assert [(g["after_scan"], round(g["seconds"], 9)) for g in facts["time"]["gaps"]] == [(2, 0.3)]
    assert any("1 gap in the scans, the longest 0.300 s after scan 2" in p for p in facts["problems"])
    assert (facts["imu"]["gravity_unit"], round(facts["imu"]["gravity_norm"], 2)) == ("m/s2", 9.81)
    imu = drive / "imu.csv"
    imu.write_text("t,ax,ay,az,gx,gy,gz\n" + "".join(f"{1317042272 + k / 100},0,0,1.0,0,0,0\n" for k in range(50)))
    facts = inspect(open_sequence(drive), is_quick=True)
    assert facts["imu"]["gravity_unit"] == "g"
    assert any("multiply by 9.80665" in p for p in facts["problems"])


@pytest.mark.parametrize(("up", "bend", "unit"), [(9.81, 12.0, "m/s2"), (0.0, 3.0, None), (1.0, 1.2, "g")])
def test_long_bends_do_not_hide_gravity_but_its_absence_shows(
    up: float, bend: float, unit: str | None, tmp_path: Path
) -> None:
    """Nine tenths of the time in one bend: the calm rest tells the unit."""
    drive = raw_drive(tmp_path, 8)
    rows = (f"{1317042272 + k / 100},0,{bend if k % 1000 >= 100 else 0},{up},0,0,0\n" for k in range(2000))
    (drive / "imu.csv").write_text("t,ax,ay,az,gx,gy,gz\n" + "".join(rows))
    facts = inspect(open_sequence(drive), is_quick=True)
    assert facts["imu"]["gravity_unit"] == unit
    assert any("mean specific force" in p for p in facts["problems"]) == (unit != "m/s2")


@pytest.mark.parametrize(("third", "said"), [("1.000000e-01", "repeats"), ("5.000000e-02", "goes back")])
def test_stamps_that_repeat_or_go_back(third: str, said: str, tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    lines = (folder / "times.txt").read_text().splitlines()
    lines[2] = third
    (folder / "times.txt").write_text("\n".join(lines) + "\n")
    facts = inspect(open_sequence(folder), is_quick=True)
    [found] = [f for f in facts["findings"] if f["code"] == "recording"]
    assert f"time {said} at line 3" in found["what"]


def test_help_is_light() -> None:
    code = (
        "import sys, lslam.cli.info; sys.exit(any(m in sys.modules for m in ('numpy', 'numba', 'scipy', 'pydantic')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_columns_that_nobody_reads_are_named(tmp_path: Path) -> None:
    shutil.copytree(SAMPLE, tmp_path / "sample")
    folder = tmp_path / "sample" / "sequences" / "00"
    for name, column in (("imu.csv", "temperature"), ("gnss.csv", "hdop")):
        first, *rows = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([f"{first},{column}", *(f"{row},1.5" for row in rows)]))
    notes = inspect(open_sequence(folder), is_quick=True)["notes"]
    assert "imu.csv: columns left out: temperature" in notes
    assert "gnss.csv: columns left out: hdop" in notes


def test_a_healthy_and_a_broken_copy_at_the_terminal(tmp_path: Path) -> None:
    """Findings are results: they stand on stdout, with their way out, and the exit code stays 0."""
    copy = tmp_path / "sample"
    shutil.copytree(SAMPLE, copy)
    page = lslam("info", copy)
    assert page.returncode == 0
    assert "nothing wrong found" in page.stdout
    assert "findings" not in page.stdout
    folder = copy / "sequences" / "00"
    imu = read_imu_csv(folder / "imu.csv")
    write_imu_csv(folder / "imu.csv", ImuStream(imu.stamps_ns + 60_000_000, imu.accel / 9.80665, imu.gyro))
    page = lslam("info", copy)
    assert page.returncode == 0
    findings = page.stdout.split("\nfindings\n")[1].splitlines()
    assert len(findings) == 2
    assert findings[0].startswith("  - IMU: the mean specific force is 1.")
    late = re.search(r"its stamps are ([\d.]+) ms late .* --set imu.time_offset_s=-0.0", findings[1])
    assert late is not None
    assert abs(float(late.group(1)) - 60) < 5


def test_an_existing_noise_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "imu.toml").write_text("[imu]\nstart_s = 3\n")
    done = lslam("info", SAMPLE, "--quick", "--imu-toml", tmp_path / "imu.toml")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "imu.toml exists already" in done.stderr
    assert (tmp_path / "imu.toml").read_text() == "[imu]\nstart_s = 3\n"
