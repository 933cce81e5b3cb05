"""`lslam convert` at the terminal: what it prints, what it refuses, and that the result runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from calling import SAMPLE, assert_one_sentence, lslam, manifest, strict_json

from lslam.core.geometry import se3
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence

CALIB = SAMPLE / "sequences" / "00" / "calib.txt"
POSES = SAMPLE / "poses" / "00.txt"


def test_a_bag_of_the_sample_runs_as_the_sample_does(tmp_path: Path) -> None:
    done = lslam("convert", SAMPLE, "--to", "mcap", "--zstd", "--count", 8, "--out", tmp_path / "s.mcap")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 's.mcap'}: 8 scans\n"), done.stderr
    for name, source in (("bag", tmp_path / "s.mcap"), ("folder", SAMPLE)):
        ran = lslam("run", source, "--count", 8, "--out", tmp_path / name)
        assert ran.returncode == 0, ran.stderr
        assert manifest(tmp_path / name)["status"] == "done"
    a, b = (read_trajectory(tmp_path / name) for name in ("bag", "folder"))
    np.testing.assert_array_equal(a.poses, b.poses)
    facts = strict_json(lslam("info", tmp_path / "s.mcap", "--json").stdout)
    assert (facts["format"], facts["scans"], facts["problems"]) == ("bag", 8, [])
    again = lslam("convert", SAMPLE, "--to", "mcap", "--out", tmp_path / "s.mcap")
    assert again.returncode == 2
    assert "--overwrite" in again.stderr
    assert_one_sentence(again.stderr)


def test_topics_are_listed_where_there_is_a_choice(tmp_path: Path) -> None:
    from lslam.pipeline.convert.bag_writer import BagWriter

    scan = open_sequence(SAMPLE).scan(0)
    with BagWriter(tmp_path / "two.bag", "bag") as writer:
        for topic in ("/front", "/rear"):
            writer.write(topic, scan.stamp_ns, writer.messages.cloud(scan, "lidar"))
    for command in (("info",), ("run", "--dry-run"), ("convert", "--to", "kitti", "--out", tmp_path / "k")):
        done = lslam(command[0], tmp_path / "two.bag", *command[1:])
        assert done.returncode == 2
        assert done.stderr.splitlines()[1:] == [
            f"  --lidar-topic {topic:<6}  (1 messages, sensor_msgs/msg/PointCloud2)" for topic in ("/front", "/rear")
        ]
    assert not (tmp_path / "k").exists()
    chosen = lslam("info", tmp_path / "two.bag", "--lidar-topic", "/rear")
    assert chosen.returncode == 0
    assert "scans from /rear" in chosen.stdout


def test_trajectories_change_format_and_body_and_back(tmp_path: Path) -> None:
    tum, kitti = tmp_path / "a.tum", tmp_path / "a.txt"
    done = lslam("convert", POSES, "--to", "tum", "--frame", "lidar", "--calib", CALIB, "--out", tum)
    assert (done.returncode, done.stdout) == (0, f"{tum}: 95 poses of lidar\n"), done.stderr
    truth = open_sequence(SAMPLE).ground_truth
    assert truth is not None
    np.testing.assert_allclose(read_trajectory(tum).poses, truth.poses, atol=2e-9)
    back = lslam("convert", tum, "--to", "kitti", "--calib", CALIB, "--out", kitti)
    assert back.returncode == 0, back.stderr
    np.testing.assert_allclose(read_trajectory(kitti).poses, read_trajectory(POSES).poses, atol=1e-8)


def test_euroc_holds_the_imu_and_that_needs_extrinsics(tmp_path: Path) -> None:
    out = tmp_path / "a.csv"
    refused = lslam("convert", SAMPLE.parent / "nothing.tum", "--to", "euroc", "--out", out)
    assert refused.returncode == 3
    tum = tmp_path / "a.tum"
    assert lslam("convert", SAMPLE, "--to", "tum", "--out", tum).returncode == 0
    refused = lslam("convert", tum, "--to", "euroc", "--out", out)
    assert refused.returncode == 3
    assert "needs T_lidar_imu: give --extrinsics" in refused.stderr
    assert_one_sentence(refused.stderr)
    assert (
        lslam("convert", tum, "--to", "euroc", "--extrinsics", "1 0 0 0 0 0 1 2 0 -1 0 3", "--out", out).returncode == 0
    )
    T_lidar_imu = se3.make(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.0, 2, 3]))
    lidar, imu = read_trajectory(tum), read_trajectory(out)
    assert imu.frame == "imu"
    np.testing.assert_array_equal(imu.stamps_ns, lidar.stamps_ns)
    np.testing.assert_allclose(imu.poses, lidar.poses @ T_lidar_imu, atol=5e-9)


def test_words_that_do_not_fit_are_usage_errors(tmp_path: Path) -> None:
    for words, sentence in (
        ((SAMPLE, "--to", "bag", "--out", tmp_path / "a"), "ends in .bag"),
        ((SAMPLE, "--to", "bag", "--zstd", "--out", tmp_path / "a.bag"), "--zstd is for mcap and sqlite"),
        ((POSES, "--to", "bag", "--out", tmp_path / "a.bag"), "no trajectory format 'bag'"),
        ((POSES, "--to", "tum", "--frame", "moon", "--out", tmp_path / "a"), "no frame 'moon'"),
        ((SAMPLE, "--to", "mcap", "--imu-topic", "/imu", "--out", tmp_path / "a"), "is for bags"),
    ):
        done = lslam("convert", *words)
        assert done.returncode == 2, done.stderr
        assert sentence in done.stderr
        assert_one_sentence(done.stderr)
    assert not list(tmp_path.iterdir())
