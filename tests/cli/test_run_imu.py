"""`lslam run --imu` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from calling import SAMPLE, assert_one_sentence, lslam, manifest, sample_copy


def test_the_sample_runs_with_its_imu(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--imu", "--count", 40, "--out", tmp_path / "run", "--set", "map.write=false")
    assert done.returncode == 0, done.stderr
    facts = manifest(tmp_path / "run")
    assert (facts["status"], facts["imu"]["used"]) == ("done", True)
    assert "  imu          used; predicts scans to " in done.stdout
    assert abs(np.linalg.norm(facts["imu"]["gravity_in_world_m_s2"]) - 9.81) < 0.1


def test_an_invalid_imu_stream_is_rejected_and_reported(tmp_path: Path) -> None:
    copy = sample_copy(tmp_path, 20)
    path = next(copy.rglob("imu.csv"))
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header, *(line.split(",")[0] + ",0" * 6 for line in lines)]) + "\n")
    words = ("run", copy, "--imu", "--set", "map.write=false")
    done = lslam(*words, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "the IMU is refused, the run goes on without it" in done.stderr
    assert manifest(tmp_path / "run")["status"] == "degraded"
    assert lslam(*words, "--out", tmp_path / "strict", "--strict").returncode == 4


def test_no_imu_is_missing_input(tmp_path: Path) -> None:
    copy = sample_copy(tmp_path, 5)
    next(copy.rglob("imu.csv")).unlink()
    done = lslam("run", copy, "--imu", "--out", tmp_path / "run")
    assert done.returncode == 3
    assert_one_sentence(done.stderr)
    assert "imu.csv" in done.stderr
    assert not (tmp_path / "run").exists()
