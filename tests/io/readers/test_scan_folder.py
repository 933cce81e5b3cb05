"""Plain folders of scans, of every file type, with and without stamps and truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sequence_builders import cloud, lidar_poses, scans

from lslam.core.errors import InputError
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.sequence_toml import SequenceInfo, write_sequence_toml
from lslam.io.formats.trajectory_lines import write_tum
from lslam.io.readers import open_sequence


def said(sentences: list[str], part: str) -> bool:
    return any(part in s for s in sentences)


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply", ".npy"])
@pytest.mark.parametrize("inner", ["", "data", "scans"])
def test_every_type_and_place(suffix: str, inner: str, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    scans(folder / inner, 4, suffix)
    s = open_sequence(folder)
    assert (s.name, s.kind, len(s), s.rate_hz, s.motion_compensated) == ("mine", "scan-folder", 4, 10.0, None)
    np.testing.assert_array_equal(s.scan(2).points, cloud(2)[:, :3])
    np.testing.assert_array_equal(s.scan(2).intensity, cloud(2)[:, 3])
    assert said(s.notes, "stamped at 10 Hz")
    assert s.notes[0].startswith("format scan-folder: ")


def test_natural_order_and_a_map_beside_the_scans(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    scans(folder, 12, ".pcd", digits=1)
    (folder / "map.ply").write_bytes(b"")
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.scan(10).points, cloud(10)[:, :3])
    assert said(s.notes, "1 *.ply files")


def test_stamps_file_and_file_names(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 3)
    (folder / "stamps.txt").write_text("5.0\n5.05\n5.1\n")
    s = open_sequence(folder)
    assert (s.rate_hz, s.stamps_ns[1]) == (20.0, 5_050_000_000)
    folder = scans(tmp_path / "b", 3)
    for k, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"16704039{k:02d}.235281229.bin")
    s = open_sequence(folder)
    assert s.stamps_ns.tolist() == [1670403900235281229, 1670403901235281229, 1670403902235281229]
    assert said(s.notes, "from the file names")


def test_rate_from_toml_and_argument(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 3)
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(rate_hz=20.0))
    assert open_sequence(folder).stamps_ns[1] == 50_000_000
    assert open_sequence(folder, rate_hz=5.0).stamps_ns[1] == 200_000_000


def test_organised_clouds_have_rings(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 2)
    rings = open_sequence(folder, rows=3, cols=100).scan(0).rings
    assert rings is not None
    assert (rings.dtype, rings[99], rings[100], rings[299]) == (np.uint16, 0, 1, 2)
    with pytest.raises(InputError, match=r"300 points are not 4 rows of 100 columns"):
        open_sequence(folder, rows=4, cols=100).scan(0)


def test_truth_beside_the_scans(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 5)
    (folder / "times.txt").write_text("".join(f"{100 + k / 10}\n" for k in range(5)))
    stamps = (np.arange(5) * 100_000_000 + 100 * 10**9).astype(np.int64)
    write_tum(folder / "gt.tum", Trajectory(stamps, lidar_poses(5)))
    s = open_sequence(folder)
    assert s.ground_truth is not None
    np.testing.assert_allclose(s.ground_truth.poses, lidar_poses(5), atol=1e-8)
    assert s.ground_truth.frame == "lidar"


def test_truth_of_the_imu_is_carried_to_the_lidar(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 5)
    T_lidar_imu = np.eye(4)
    T_lidar_imu[:3, 3] = [0.5, 0, -0.2]
    stamps = (np.arange(5) * 100_000_000).astype(np.int64)
    write_tum(folder / "body.tum", Trajectory(stamps, lidar_poses(5) @ T_lidar_imu))
    info = SequenceInfo(ground_truth="body.tum", ground_truth_frame="imu", T_lidar_imu=T_lidar_imu)
    write_sequence_toml(folder / "sequence.toml", info)
    s = open_sequence(folder)
    assert s.ground_truth is not None
    np.testing.assert_allclose(s.ground_truth.poses, lidar_poses(5), atol=1e-8)
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(ground_truth="body.tum", ground_truth_frame="imu"))
    assert said(open_sequence(folder).problems, "T_lidar_imu is unknown")
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(ground_truth="nobody.tum"))
    assert said(open_sequence(folder).problems, "nobody.tum, named by sequence.toml, does not exist")


def test_stamped_truth_of_another_length_needs_stamps(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 5)
    stamps = (np.arange(9) * 100_000_000 + 10**18).astype(np.int64)
    write_tum(folder / "gt.tum", Trajectory(stamps, lidar_poses(9)))
    s = open_sequence(folder)
    assert s.ground_truth is None
    assert said(s.problems, "9 stamped poses for 5 scans")


def pcd_with_times(path: Path, dtype: str, times: np.ndarray) -> None:
    table = np.zeros(len(times), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", dtype)])
    table["x"], table["time"] = 1 + np.arange(len(times)), times
    kind, size = np.dtype(dtype).kind.upper(), np.dtype(dtype).itemsize
    head = f"FIELDS x y z time\nSIZE 4 4 4 {size}\nTYPE F F F {kind}\nCOUNT 1 1 1 1\nWIDTH {len(times)}\nHEIGHT 1\n"
    path.write_bytes(f"{head}POINTS {len(times)}\nDATA binary\n".encode() + table.tobytes())


@pytest.mark.parametrize(
    ("dtype", "scale", "shift", "stamp_moves_ns"),
    [
        ("<u4", 1e9, 0.0, 0),
        ("<f4", 1.0, 0.0, 0),
        ("<f4", 1e6, 0.0, 0),
        ("<f4", 1.0, -0.1, -100_000_000),
        ("<f8", 1.0, 1670403900.0, 0),
        ("<u8", 1e9, 1670403900.0, 0),
        ("<f8", 1e9, 1670403900.0, 0),
    ],
)
def test_per_point_times_of_any_unit(
    dtype: str, scale: float, shift: float, stamp_moves_ns: int, tmp_path: Path
) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    expected = np.linspace(0, 0.1, 50)
    if dtype == "<u8":
        stored = (expected * 1e9).round().astype(np.uint64) + np.uint64(int(shift) * 10**9)
    else:
        stored = ((expected + shift) * scale).astype(dtype)
    for k in range(2):
        pcd_with_times(folder / f"{k}.pcd", dtype, stored)
    (folder / "times.txt").write_text("1670403900.0\n1670403900.1\n")
    s = open_sequence(folder)
    assert said(s.notes, "per-point times from field 'time'")
    scan = s.scan(0)
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, expected, atol=1e-6)
    assert abs(scan.stamp_ns - (1670403900 * 10**9 + stamp_moves_ns)) < 10


def test_a_clock_that_starts_with_the_recording_is_a_clock(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    within = np.linspace(0, 0.1, 50)
    for k in range(6):
        pcd_with_times(folder / f"{k}.pcd", "<f8", 0.1 * k + within)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.1f}\n" for k in range(6)))
    for k in (0, 5):
        scan = open_sequence(folder).scan(k)
        assert scan.times is not None
        np.testing.assert_allclose(scan.times, within, atol=1e-6)
        assert abs(scan.stamp_ns - k * 10**8) < 10


def test_times_of_no_known_unit_disable_deskewing_with_a_note(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    pcd_with_times(folder / "0.pcd", "<f4", np.linspace(0, 2, 50))
    s = open_sequence(folder)
    assert s.scan(0).times is None
    assert said(s.problems, "no deskew: per-point time field 'time' (float32, 0 to 2")


def test_the_velodyne_folder_of_a_kitti_sequence_is_detected(tmp_path: Path) -> None:
    s = open_sequence(scans(tmp_path / "07" / "velodyne", 2))
    assert s.kind == "scan-folder"
    assert said(s.problems, f"give {tmp_path / '07'} for its stamps")


def test_empty_folders_and_folders_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty is empty"):
        open_sequence(tmp_path / "empty")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "beach.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"holds no scans.*beach\.jpg"):
        open_sequence(tmp_path / "photos")


def test_real_ouster_folder(recordings: Callable[[str], Path]) -> None:
    s = open_sequence(recordings("mcd_kth_day_06") / "mcd_kth_day_06", rows=64, cols=1024)
    assert (s.kind, len(s)) == ("scan-folder", 50)
    assert s.stamps_ns[0] == 1670403902235281229
    assert s.ground_truth is not None
    assert len(s.ground_truth) == 50
    assert abs(s.ground_truth.path_lengths[-1] - 5.17) < 0.01
    scan = s.scan(0)
    assert scan.rings is not None
    assert len(scan) == 65536
    # Rows are rings: elevation falls from row to row.
    good = np.linalg.norm(scan.points, axis=1) > 1
    elevation = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
    means = [elevation[good & (scan.rings == r)].mean() for r in range(64)]
    assert (np.diff(means) < 0).all()


@pytest.mark.parametrize(
    ("missing", "before", "between"),
    [((0, 1), "", ","), ((5,), "", ";"), ((0, 3, 7), "# ", ","), ((6, 7), "", ",")],
)
def test_scans_without_a_pose_keep_the_others_truth_and_stamps(
    tmp_path: Path, missing: tuple[int, ...], before: str, between: str
) -> None:
    folder = scans(tmp_path / "kth", 8, ".pcd")
    poses = lidar_poses(8)[:, :3, 3]
    rows = [
        f"{k},{1670403902.2 + k / 10:.1f},{x},{y},{z},0,0,0,1" for k, (x, y, z) in enumerate(poses) if k not in missing
    ]
    table = "\n".join([f"{before}num,t,x,y,z,qx,qy,qz,qw", *rows]) + "\n"
    (folder / "pose_inW.csv").write_text(table.replace(",", between))
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.stamps_ns, 1670403902200000000 + np.arange(8) * 100_000_000)
    assert s.ground_truth is not None
    kept = np.setdiff1d(np.arange(8), missing)
    np.testing.assert_array_equal(s.ground_truth.stamps_ns, s.stamps_ns[kept])
    np.testing.assert_allclose(s.ground_truth.positions, poses[kept])
    assert said(s.problems, f"has no pose for {len(missing)} of 8 scans, {missing[0]:06d}.pcd the first")
