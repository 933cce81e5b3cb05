"""KITTI raw drives: OXTS as truth, IMU and GNSS, and what shared excerpts leave out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sequence_builders import cloud, raw_drive

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.se3 import poses_at
from lslam.io.formats.sequence_toml import SequenceInfo, write_sequence_toml
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence


def said(sentences: list[str], part: str) -> bool:
    return any(part in s for s in sentences)


def test_an_excerpt_without_velodyne_stamps(tmp_path: Path) -> None:
    s = open_sequence(raw_drive(tmp_path))
    assert (s.name, s.kind, len(s), s.motion_compensated) == ("2011_09_26_drive_0005_sync", "kitti-raw", 6, False)
    assert s.stamps_ns[0] == 1317042272_000000000
    assert s.scan(0).times is not None
    assert said(s.notes, "scan i goes with OXTS sample i")
    assert said(s.notes, "motion compensated: no (KITTI's raw drives are distorted; motion_compensated = true")
    assert s.problems == []
    assert s.calibration.T_lidar_imu is not None
    assert s.calibration.T_cam0_lidar is not None
    # kitti2bag's: the IMU sits .93 m above it.
    T_base_imu = se3.inverse(s.calibration.T_lidar("base_link")) @ s.calibration.T_lidar_imu
    np.testing.assert_allclose(T_base_imu[:3, 3], [-1.405, 0.32, 0.93])
    assert s.imu is not None
    assert s.gnss is not None
    np.testing.assert_allclose(s.imu.accel[0], [0, 0, 9.81])
    assert s.gnss.sigma[0] == 0.05


def test_truth_is_the_lidar_going_forward(tmp_path: Path) -> None:
    """Yaw 0 is east: 1.3670e-5 deg of longitude at 49 N are 1.0003 m, along the LiDAR's x."""
    s = open_sequence(raw_drive(tmp_path))
    assert s.ground_truth is not None
    np.testing.assert_allclose(s.ground_truth.poses[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(s.ground_truth.positions[5], [5.0015, 0, 0], atol=2e-3)


def test_velodyne_stamps_are_used_when_they_are_there(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    lines = "".join(f"2011-09-26 13:04:32.{k * 100 + 3:03d}000001\n" for k in range(6))
    (folder / "velodyne_points" / "timestamps.txt").write_text(lines)
    s = open_sequence(folder)
    assert s.stamps_ns[1] == 1317042272_103000001
    assert s.ground_truth is not None
    assert s.ground_truth.stamps_ns.tolist() == s.stamps_ns.tolist()
    np.testing.assert_allclose(s.ground_truth.positions[5], [5.0015, 0, 0], atol=2e-3)
    assert said(s.notes, "interpolated")


def test_untwisted_scans_keep_the_stamp_of_the_scanner_looking_ahead(tmp_path: Path) -> None:
    """OXTS, cameras and whoever pairs pose i with sample i mean that instant: times lie about it."""
    folder = raw_drive(tmp_path)
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.stamps_ns, open_sequence(folder, motion_compensated=True).stamps_ns)
    scan = s.scan(0)
    assert scan.times is not None
    np.testing.assert_allclose(scan.span, (-0.05, 0.05), atol=1e-3)
    # Clockwise from behind: zero ahead, the left side before it.
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    np.testing.assert_allclose(scan.times, -0.05 * azimuth / np.pi, atol=1e-7)
    lines = "".join(f"2011-09-26 13:04:32.{k * 100 + 3:03d}000001\n" for k in range(6))
    (folder / "velodyne_points" / "timestamps.txt").write_text(lines)
    assert open_sequence(folder).stamps_ns[1] == 1317042272_103000001


@pytest.mark.parametrize(("kind", "begin"), [("sync", -0.05), ("extract", 0.0)])
def test_stamps_that_the_user_names_are_taken_as_they_are(tmp_path: Path, kind: str, begin: float) -> None:
    folder = raw_drive(tmp_path, name=f"2011_09_26_drive_0005_{kind}")
    lines = "".join(f"2011-09-26 13:04:32.{k * 100 + 3:03d}000000\n" for k in range(6))
    (folder / "timestamps.txt").write_text(lines)
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(stamps="timestamps.txt"))
    s = open_sequence(folder)
    assert s.stamps_ns[1] == 1317042272_103000000
    np.testing.assert_allclose(s.scan(1).span, (begin, begin + 0.1), atol=1e-3)


# Kind of drive, files that are there, stamp of the second scan in ms, begin of its sweep in s, what is said.
SWEEPS = [
    ("sync", ("", "_start", "_end"), 148, -0.048, ""),
    ("sync", ("_start", "_end"), 148, -0.048, "the scanner looks ahead half a sweep later"),
    ("extract", ("", "_start", "_end"), 100, 0.0, ""),
    ("extract", ("", "_end"), 98, 0.0, "each scan begins half a sweep earlier"),
]


@pytest.mark.parametrize(("kind", "files", "stamp", "begin", "words"), SWEEPS)
def test_stamps_and_sweeps_by_the_files_that_are_there(
    tmp_path: Path, kind: str, files: tuple[str, ...], stamp: int, begin: float, words: str
) -> None:
    folder = raw_drive(tmp_path, name=f"2011_09_26_drive_0005_{kind}")
    for name, shift in (("", 48), ("_start", 0), ("_end", 96)):
        lines = "".join(f"2011-09-26 13:04:32.{k * 100 + shift:03d}000000\n" for k in range(6))
        if name in files:
            (folder / "velodyne_points" / f"timestamps{name}.txt").write_text(lines)
    s = open_sequence(folder)
    assert s.stamps_ns[1] == 1317042272_000000000 + stamp * 10**6
    assert said(s.notes, "half a sweep") == bool(words)
    assert said(s.notes, words)
    seconds = 0.096 if "_start" in files else 0.1
    np.testing.assert_allclose(s.scan(1).span, (begin, begin + seconds), atol=1e-3)


def test_compensated_scans_keep_the_instant_of_their_stamps(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    s = open_sequence(folder, motion_compensated=True)
    assert s.motion_compensated is True
    assert s.stamps_ns[0] == 1317042272_000000000
    assert s.scan(0).times is None
    # Both files: the instant at which the scanner looks ahead is that of a compensated scan.
    for name, shift in (("timestamps", 50), ("timestamps_start", 0)):
        lines = "".join(f"2011-09-26 13:04:32.{k * 100 + shift:03d}000000\n" for k in range(6))
        (folder / "velodyne_points" / f"{name}.txt").write_text(lines)
    assert open_sequence(folder, motion_compensated=True).stamps_ns[1] == 1317042272_150000000


@pytest.mark.parametrize(("late", "evened"), [(0.0, True), (0.02, False)])
def test_stamps_of_the_nearest_oxts_samples_are_evened_out(tmp_path: Path, late: float, evened: bool) -> None:
    """A scan each 103.3 ms, OXTS each 10 ms; a scan that came 20 ms late did come late."""
    folder = raw_drive(tmp_path, count=30)
    true = 32 + np.arange(30) * 0.1033
    true[20] += late
    nearest = np.round(true, 2)
    assert 4e-3 < np.abs(nearest - true).max() < 5.1e-3
    (folder / "oxts" / "timestamps.txt").write_text("".join(f"2011-09-26 13:04:{t:012.9f}\n" for t in nearest))
    s = open_sequence(folder)
    assert said(s.notes, "evened out") == evened
    taken = s.stamps_ns - 1317042240_000000000
    if evened:
        assert s.rate_hz == pytest.approx(1 / 0.1033, rel=2e-3)
        assert np.abs(taken * 1e-9 - true).max() < 1.5e-3
    else:
        np.testing.assert_allclose(np.diff(s.stamps_ns) * 1e-9, np.diff(nearest), atol=1e-8)


def test_missing_scans_keep_their_stamps(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    (folder / "velodyne_points" / "data" / "0000000002.bin").unlink()
    s = open_sequence(folder)
    assert (s.stamps_ns - s.stamps_ns[0]).tolist() == [0, 10**8, 3 * 10**8, 4 * 10**8, 5 * 10**8]
    assert said(s.problems, "6 stamps for 5 scans")


def test_inaccurate_positions_are_noted(tmp_path: Path) -> None:
    assert said(
        open_sequence(raw_drive(tmp_path, pos_acc=0.4)).notes, "OXTS positions are poor (pos_acc median 0.40 m)"
    )


def test_without_oxts_or_calibration(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    (folder.parent / "calib_imu_to_velo.txt").unlink()
    s = open_sequence(folder)
    assert s.ground_truth is None
    assert said(s.problems, "calib_imu_to_velo.txt is missing")
    for path in (folder / "oxts" / "data").iterdir():
        path.unlink()
    s = open_sequence(folder)
    assert (s.imu, s.gnss, s.ground_truth) == (None, None, None)
    assert said(s.problems, "no samples")
    assert said(s.problems, "stamped at 10 Hz")


def test_oxts_that_is_broken_or_goes_back(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    stamps = folder / "oxts" / "timestamps.txt"
    lines = stamps.read_text().splitlines()
    lines[3] = lines[1]
    stamps.write_text("\n".join(lines))
    s = open_sequence(folder)
    assert (np.diff(s.stamps_ns) > 0).all()
    assert said(s.problems, "at line 4")
    (folder / "oxts" / "data" / "0000000004.txt").write_text("1 2 3")
    s = open_sequence(folder)
    assert said(s.problems, "0000000004.txt is no OXTS sample")
    assert len(s) == 6


def test_extract_drives_are_distorted_text(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path, name="2011_09_26_drive_0005_extract")
    data = folder / "velodyne_points" / "data"
    for k, path in enumerate(sorted(data.iterdir())):
        path.unlink()
        np.savetxt(path.with_suffix(".txt"), cloud(k), fmt="%.9g")
    for name, shift in (("start", 0), ("end", 90)):
        lines = "".join(f"2011-09-26 13:04:32.{k * 100 + shift:03d}000000\n" for k in range(6))
        (folder / "velodyne_points" / f"timestamps_{name}.txt").write_text(lines)
    s = open_sequence(folder)
    assert s.motion_compensated is False
    scan = s.scan(2)
    assert scan.times is not None
    behind = np.argmin(np.abs(np.arctan2(scan.points[:, 1], -scan.points[:, 0])))
    front = np.argmin(np.abs(np.arctan2(scan.points[:, 1], scan.points[:, 0])))
    left = np.argmin(np.abs(np.arctan2(-scan.points[:, 0], scan.points[:, 1])))
    assert min(scan.times[behind], 0.09 - scan.times[behind]) < 2e-3
    assert abs(scan.times[front] - 0.045) < 2e-3
    # Clockwise from behind: the left side comes before the front.
    assert abs(scan.times[left] - 0.0225) < 2e-3
    assert s.stamps_ns[2] == 1317042272_200000000


def test_sequence_toml_names_other_truth(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    stamps = [f"{1317042272 + k / 10:.9f}" for k in range(6)]
    (folder / "reference.tum").write_text("".join(f"{t} {k} 0 0 0 0 0 1\n" for k, t in enumerate(stamps)))
    info = SequenceInfo(ground_truth="reference.tum", ground_truth_frame="lidar")
    write_sequence_toml(folder / "sequence.toml", info)
    s = open_sequence(folder)
    assert s.ground_truth is not None
    assert s.ground_truth.positions[5, 0] == 5


def test_days_and_drives_without_scans(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path)
    assert open_sequence(folder.parent).name == folder.name
    raw_drive(tmp_path, name="2011_09_26_drive_0048_sync")
    with pytest.raises(InputError, match="2 drives"):
        open_sequence(folder.parent)
    for path in (folder / "velodyne_points" / "data").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="holds no scans"):
        open_sequence(folder)
    (folder / "velodyne_points" / "data").rmdir()
    (folder / "velodyne_points").rmdir()
    with pytest.raises(InputError, match="without velodyne_points"):
        open_sequence(folder)


def test_real_drive_against_its_reference(recordings: Callable[[str], Path]) -> None:
    """The OXTS truth agrees with the independent reference: attitude to 0.1 deg, positions to the accuracy they claim."""
    folder = recordings("kitti_raw_0048") / "2011_09_26" / "2011_09_26_drive_0048_sync"
    s = open_sequence(folder)
    given = read_trajectory(folder / "reference_lidar.tum")
    assert s.ground_truth is not None
    assert (len(s), len(s.ground_truth)) == (22, 22)
    # Its clock begins at midnight.
    reference = poses_at(given.stamps_ns, given.poses, s.stamps_ns % (86400 * 10**9))
    reference = se3.relative(reference[0], reference)
    apart = se3.relative(reference, s.ground_truth.poses)
    assert np.degrees(so3.angle(apart[:, :3, :3])).max() < 0.1
    assert np.linalg.norm(s.ground_truth.positions - reference[:, :3, 3], axis=1).max() < 0.35
    # Two scans a metre apart overlap under the truth: the transform is not inverted.
    from scipy.spatial import cKDTree

    a, b = s.scan(0).points[::3], s.scan(4).points[::40]
    moved = se3.apply(se3.relative(s.ground_truth.poses[0], s.ground_truth.poses[4]), b)
    tree = cKDTree(a)
    assert np.median(tree.query(moved)[0]) < 0.5 * np.median(tree.query(b)[0])
