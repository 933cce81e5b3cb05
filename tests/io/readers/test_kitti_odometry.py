"""KITTI odometry: frames, stamps, the vertical correction, and every way a folder can be incomplete."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sequence_builders import cloud, kitti_root, lidar_poses, scans

from lslam.core.errors import InputError, UsageError
from lslam.io.formats.sequence_toml import SequenceInfo, write_sequence_toml
from lslam.io.readers import open_sequence


def said(sentences: list[str], part: str) -> bool:
    return any(part in s for s in sentences)


def test_a_whole_sequence(tmp_path: Path) -> None:
    s = open_sequence(kitti_root(tmp_path))
    assert (s.name, s.kind, len(s), s.rate_hz, s.motion_compensated) == ("seq07", "kitti-odometry", 6, 10.0, True)
    assert s.notes[0].startswith("format kitti-odometry: ")
    assert s.stamps_ns.tolist() == [k * 100_000_000 for k in range(6)]
    assert s.problems == []
    assert s.ground_truth is not None
    assert s.ground_truth.frame == "lidar"
    np.testing.assert_allclose(s.ground_truth.poses, lidar_poses(6), atol=1e-9)
    scan = s.scan(3)
    assert (scan.index, scan.stamp_ns, len(scan), scan.times, scan.rings) == (3, 300_000_000, 300, None, None)
    np.testing.assert_array_equal(scan.intensity, cloud(3)[:, 3])
    with pytest.raises(IndexError):
        s.scan(6)


def test_real_kitti_is_lifted_by_a_fifth_of_a_degree(tmp_path: Path) -> None:
    s = open_sequence(kitti_root(tmp_path))
    raw = cloud(0)[:, :3].astype(np.float64)
    new = s.scan(0).points.astype(np.float64)

    def elevation(p: np.ndarray) -> np.ndarray:
        return np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))

    np.testing.assert_allclose(elevation(new) - elevation(raw), 0.205, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(new, axis=1), np.linalg.norm(raw, axis=1), rtol=1e-6)
    assert said(s.notes, "0.205 deg")


NOT_TO_LIFT = [
    SequenceInfo(sensor="simulated OS1"),
    SequenceInfo(sensor="HDL-64E", vertical_correction_deg=0.0),
    SequenceInfo(sensor="VLP-16"),
]


@pytest.mark.parametrize("info", NOT_TO_LIFT)
def test_sequence_toml_switches_the_correction_off(info: SequenceInfo, tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    write_sequence_toml(folder / "sequence.toml", info)
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.scan(0).points, cloud(0)[:, :3])
    assert said(s.notes, "no vertical correction")


def test_the_argument_has_precedence(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(vertical_correction_deg=0.205))
    s = open_sequence(folder, vertical_correction_deg=0.0)
    np.testing.assert_array_equal(s.scan(0).points, cloud(0)[:, :3])


def test_another_sensor_in_kitti_layout_is_detected(tmp_path: Path) -> None:
    """Users convert their own recordings into this layout: an Ouster looks far higher than an HDL-64E."""
    folder = kitti_root(tmp_path)
    table = cloud(0)
    table[:, 2] += 15
    table.tofile(folder / "velodyne" / "000000.bin")
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.scan(0).points, table[:, :3])
    assert said(s.notes, "no HDL-64E")


def test_a_root_with_one_sequence_and_with_two(tmp_path: Path) -> None:
    kitti_root(tmp_path)
    assert open_sequence(tmp_path).name == "seq07"
    scans(tmp_path / "sequences" / "08" / "velodyne", 2)
    with pytest.raises(InputError, match="2 sequences \\(07, 08\\)"):
        open_sequence(tmp_path)


def test_per_point_rings_and_times(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (folder / "per_point").mkdir()
    t, ring = np.linspace(0, 0.1, 300, dtype=np.float32), np.arange(300, dtype=np.uint16) % 64
    np.savez(folder / "per_point" / "000000.npz", t=t, ring=ring)
    np.savez(folder / "per_point" / "000001.npz", t=t[:7], ring=ring[:7])
    info = SequenceInfo(sensor="simulated", per_point="per_point", motion_compensated=False)
    write_sequence_toml(folder / "sequence.toml", info)
    s = open_sequence(folder)
    assert s.motion_compensated is False
    np.testing.assert_array_equal(s.scan(0).times, t)
    np.testing.assert_array_equal(s.scan(0).rings, ring)
    with pytest.raises(InputError, match=r"000001\.npz: t has shape"):
        s.scan(1)
    with pytest.raises(InputError, match=r"000002\.npz"):
        s.scan(2)
    (folder / "per_point" / "000003.npz").write_bytes(b"PK\x03\x04 this is no archive")
    with pytest.raises(InputError, match=r"000003\.npz"):
        s.scan(3)
    # A scan without points is empty, whatever is held of its points.
    (folder / "velodyne" / "000001.bin").write_bytes(b"")
    assert len(s.scan(1).points) == 0
    compensated = open_sequence(folder, motion_compensated=True).scan(0)
    assert compensated.times is None
    assert compensated.rings is not None
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(per_point="points"))
    with pytest.raises(InputError, match="per_point"):
        open_sequence(folder)


def test_truncated_and_empty_scans(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (folder / "velodyne" / "000002.bin").write_bytes(bytes(1001))
    (folder / "velodyne" / "000003.bin").write_bytes(b"")
    s = open_sequence(folder)
    with pytest.raises(InputError, match=r"000002\.bin: 1001 bytes"):
        s.scan(2)
    assert len(s.scan(3)) == 0
    assert len(s.scan(4)) == 300


def test_nan_inf_and_zero_points_stay(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    table = cloud(1)
    table[0, :3], table[1, 0], table[2, 2] = 0, np.nan, np.inf
    table.tofile(folder / "velodyne" / "000001.bin")
    points = open_sequence(folder).scan(1).points
    assert len(points) == 300
    assert (points[0] == 0).all()
    assert np.isnan(points[1, 0])
    assert np.isinf(points[2, 2])


def test_files_of_different_length_use_the_common_part_with_a_note(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    lines = (folder / "times.txt").read_text().splitlines()
    (folder / "times.txt").write_text("\n".join(lines[:5]))
    poses = tmp_path / "poses" / "07.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:4]))
    s = open_sequence(folder)
    assert (len(s), len(s.stamps_ns)) == (5, 5)
    assert s.ground_truth is not None
    assert s.ground_truth.stamps_ns.tolist() == s.stamps_ns[:4].tolist()
    assert said(s.problems, "5 times for 6 scans")
    assert said(s.problems, "4 poses for 5 scans")


def test_an_excerpt_keeps_the_rows_of_its_file_numbers(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    for k in (0, 1, 4):
        (folder / "velodyne" / f"{k:06d}.bin").unlink()
    s = open_sequence(folder)
    assert s.stamps_ns.tolist() == [200_000_000, 300_000_000, 500_000_000]
    assert s.ground_truth is not None
    np.testing.assert_allclose(s.ground_truth.poses, lidar_poses(6)[[2, 3, 5]], atol=1e-9)
    assert said(s.problems, "by the number in the file name")


@pytest.mark.parametrize(("value", "word"), [("0.1", "goes back"), ("2.000000e-01", "repeats")])
def test_times_that_do_not_increase_name_the_line(value: str, word: str, tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    lines = (folder / "times.txt").read_text().splitlines()
    lines[3] = value
    (folder / "times.txt").write_text("\n".join(lines))
    s = open_sequence(folder)
    assert (np.diff(s.stamps_ns) == 100_000_000).all()
    assert said(s.problems, f"time {word} at line 4")
    assert s.ground_truth is not None


@pytest.mark.parametrize("text", ["", "0.0\nnoon\n", "\x00\xff"])
def test_unreadable_times_fall_back_to_the_rate(text: str, tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (folder / "times.txt").write_bytes(text.encode("latin-1"))
    s = open_sequence(folder, rate_hz=20.0)
    assert s.stamps_ns[1] == 50_000_000
    assert said(s.problems, "times.txt")


def test_a_calib_without_tr_leaves_the_truth_out(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    s = open_sequence(folder)
    assert s.ground_truth is None
    assert said(s.problems, "has no Tr")
    assert said(s.problems, "cannot be compared")


@pytest.mark.parametrize("poses", ["1 2 3\n", "", "1 0 0 0 0 1 0 0 0 0 nan 0\n", "2 0 0 0 0 1 0 0 0 0 1 0\n"])
def test_broken_poses_do_not_stop_a_run(poses: str, tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (tmp_path / "poses" / "07.txt").write_text(poses)
    s = open_sequence(folder)
    assert s.ground_truth is None
    assert said(s.problems, "07.txt")


def test_semantic_kitti_poses_are_no_truth(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (tmp_path / "poses" / "07.txt").rename(folder / "poses.txt")
    s = open_sequence(folder)
    assert s.ground_truth is None
    assert said(s.notes, "SLAM estimates")


def test_no_velodyne_and_unknown_keys(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    (folder / "sequence.toml").write_text("motion_compensate = true\n")
    with pytest.raises(InputError, match="did you mean 'motion_compensated'"):
        open_sequence(folder)
    (folder / "sequence.toml").unlink()
    for path in (folder / "velodyne").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="velodyne holds no scans"):
        open_sequence(folder)


def test_arguments_that_make_no_sense(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path)
    with pytest.raises(UsageError, match="rows"):
        open_sequence(folder, rows=64)
    with pytest.raises(UsageError, match="Hz"):
        open_sequence(folder, rate_hz=0.0)


def test_the_sample_that_ships(tmp_path: Path) -> None:
    sample = Path(__file__).resolve().parents[3] / "sample_data"
    s = open_sequence(sample)
    assert s.ground_truth is not None
    assert (s.kind, len(s.ground_truth)) == ("kitti-odometry", len(s))
    assert s.ground_truth.path_lengths[-1] > 100
    np.testing.assert_allclose(s.ground_truth.poses[0], np.eye(4), atol=1e-6)
    assert s.problems == []
    assert s.scan(0).rings is not None
