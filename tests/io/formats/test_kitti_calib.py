"""KITTI calibration: both flavours, and what is wrong with a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3
from lslam.io.formats.kitti_layout import (
    read_cam0_lidar,
    read_odometry_calib,
    read_raw_cam0_lidar,
    read_rectification,
    read_rigid,
    read_transform,
)

TR = (
    "Tr: -1.857739385241e-03 -9.999659513510e-01 -8.039975204516e-03 -4.784029760483e-03 -6.481465826011e-03 "
    "8.051860151134e-03 -9.999466081774e-01 -7.337429464231e-02 9.999773098287e-01 -1.805528627661e-03 "
    "-6.496203536139e-03 -3.339968064433e-01"
)
VELO = (
    "calib_time: 15-Mar-2012 11:37:16\n"
    "R: 7.533745e-03 -9.999714e-01 -6.166020e-04 1.480249e-02 7.280733e-04 -9.998902e-01 9.998621e-01 7.523790e-03 "
    "1.480755e-02\nT: -4.069766e-03 -7.631618e-02 -2.717806e-01\ndelta_f: 0.0 0.0\n"
)
RECT = "R_rect_00: 9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 4.351614e-03 "


def test_tr_of_an_odometry_calibration(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n" + TR + "\n")
    T = read_odometry_calib(tmp_path / "calib.txt")
    assert T is not None
    assert T[0, 1] == pytest.approx(-0.99996595, abs=1e-7)
    assert T[2, 3] == pytest.approx(-0.3339968)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-14)
    # A point ahead of the LiDAR (+x) lies in front of the camera (+z).
    assert se3.apply(T, np.array([[10.0, 0, 0]]))[0, 2] > 9


def test_no_tr_is_none_and_not_identity(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    assert read_odometry_calib(tmp_path / "calib.txt") is None
    with pytest.raises(InputError, match="has no Tr"):
        read_cam0_lidar(tmp_path / "calib.txt")


def test_raw_day(tmp_path: Path) -> None:
    (tmp_path / "calib_velo_to_cam.txt").write_text(VELO)
    plain = read_rigid(tmp_path / "calib_velo_to_cam.txt")
    np.testing.assert_allclose(plain[:3, :3] @ plain[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(read_raw_cam0_lidar(tmp_path), plain)
    (tmp_path / "calib_cam_to_cam.txt").write_text(RECT + "9.999631e-01\n")
    rectified = read_rectification(tmp_path / "calib_cam_to_cam.txt")
    assert rectified is not None
    np.testing.assert_allclose(read_raw_cam0_lidar(tmp_path), rectified @ plain)
    np.testing.assert_allclose(read_cam0_lidar(tmp_path / "calib_velo_to_cam.txt"), rectified @ plain)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("Tr: 1 2 3\n", "3 numbers, 12"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 x 0\n", "no number"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 nan 0\n", "finite"),
        ("Tr: 2 0 0 0 0 1 0 0 0 0 1 0\n", "no rotation"),
        ("\n", "empty"),
    ],
)
def test_invalid_calibrations_are_errors_with_a_reason(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        read_odometry_calib(tmp_path / "calib.txt")
    assert "calib.txt" in str(caught.value)


def test_missing_file_and_entry(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_odometry_calib(tmp_path / "calib.txt")
    (tmp_path / "calib_velo_to_cam.txt").write_text("R: 1 0 0 0 1 0 0 0 1\n")
    with pytest.raises(InputError, match="no entry T"):
        read_rigid(tmp_path / "calib_velo_to_cam.txt")


@pytest.mark.parametrize(
    "text",
    ["1 0 0 5 0 1 0 6 0 0 1 7", "1,0,0,5,0,1,0,6,0,0,1,7,0,0,0,1", "5,6,7,0,0,0,1", "[5, 6, 7, 0, 0, 0, 2e0]"],
)
def test_transform_from_numbers(text: str, tmp_path: Path) -> None:
    expected = se3.make(np.eye(3), np.array([5.0, 6.0, 7.0]))
    if "2e0" in text:
        with pytest.raises(UsageError, match="length 1"):
            read_transform(text)
        return
    np.testing.assert_allclose(read_transform(text), expected)
    (tmp_path / "T.txt").write_text(f"# T_est_gt\n{text}\n")
    np.testing.assert_allclose(read_transform(str(tmp_path / "T.txt")), expected)


def test_transform_from_kitti_files(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(VELO)
    np.testing.assert_allclose(read_transform(str(tmp_path / "a.txt")), read_rigid(tmp_path / "a.txt"))
    (tmp_path / "b.txt").write_text(TR)
    np.testing.assert_allclose(read_transform(str(tmp_path / "b.txt")), read_odometry_calib(tmp_path / "b.txt"))


@pytest.mark.parametrize("text", ["1,2,3", "no_such_file.txt", "1 0 0 0 0 1 0 0 0 0 -1 0", "nan,0,0,0,0,0,1"])
def test_transform_that_is_none(text: str) -> None:
    with pytest.raises(UsageError):
        read_transform(text)


def test_real_calibrations(recordings: Callable[[str], Path]) -> None:
    raw = read_raw_cam0_lidar(recordings("kitti_raw_0005") / "2011_09_26")
    assert raw[2, 0] > 0.999
    odometry = read_odometry_calib(recordings("kitti_poses") / "kitti_poses/calib/00.txt")
    assert odometry is not None
    assert odometry[2, 0] > 0.999
