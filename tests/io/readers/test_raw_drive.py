"""The IMU of KITTI odometry sequences, found in the raw drive they were cut from."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sequence_builders import kitti_root

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import ImuStream
from lslam.io.formats.stamped_csv import write_imu_csv
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.io.readers.kitti_raw import with_gnss, with_imu

DRIVE = "2011_09_30_drive_0027"


def oxts(folder: Path, count: int, rate_hz: float, begin: float = 0.0) -> None:
    """OXTS samples of a car that turns left at (number of the sample) / 1000 rad/s."""
    (folder / "data").mkdir(parents=True)
    epoch = datetime(2011, 9, 30, 12, 0, 0, tzinfo=UTC)
    lines = []
    for k in range(count):
        values = np.zeros(30)
        values[:3], values[23] = (49.0 + 1e-6 * k, 8.4, 115.0), 0.5
        values[13], values[19] = 9.81, k / 1000
        (folder / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, values)))
        at = epoch + timedelta(seconds=begin + k / rate_hz)
        lines.append(at.strftime("%Y-%m-%d %H:%M:%S.%f") + "000\n")
    (folder / "timestamps.txt").write_text("".join(lines))


def calibration(day: Path) -> None:
    (day / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n")


def test_the_sync_drive_is_found_and_begins_with_the_first_scan(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path / "kitti", 20)
    oxts(tmp_path / "raw" / "2011_09_30" / f"{DRIVE}_sync" / "oxts", 20, 10.0)
    calibration(tmp_path / "raw" / "2011_09_30")
    sequence = with_imu(open_sequence(folder))
    assert sequence.imu is not None
    np.testing.assert_array_equal(sequence.imu.stamps_ns, sequence.stamps_ns)
    np.testing.assert_allclose(sequence.imu.gyro[:, 2], np.arange(20) / 1000)
    np.testing.assert_allclose(sequence.imu.accel[0], [0, 0, 9.81])
    assert sequence.calibration.T_lidar_imu is not None
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu[:3, 3], [-0.81, 0.32, -0.8])
    assert sequence.calibration.T_cam0_lidar is not None
    assert "10 Hz" in sequence.notes[-1]


def test_satellite_fixes_come_from_the_same_drive(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path / "kitti", 20)
    with pytest.raises(
        InputError, match=r"has no satellite fixes.*gnss\.csv.*2011_09_30_drive_0027_sync or _extract.*--gnss"
    ):
        with_gnss(open_sequence(folder))
    oxts(tmp_path / "raw" / "2011_09_30" / f"{DRIVE}_sync" / "oxts", 20, 10.0)
    calibration(tmp_path / "raw" / "2011_09_30")
    sequence = with_gnss(open_sequence(folder))
    assert sequence.gnss is not None
    assert sequence.imu is None
    np.testing.assert_array_equal(sequence.gnss.stamps_ns, sequence.stamps_ns)
    np.testing.assert_allclose(sequence.gnss.lat_lon_alt[7], [49.000007, 8.4, 115.0])
    np.testing.assert_allclose(sequence.gnss.sigma, 0.5)
    assert sequence.calibration.T_lidar_gnss is not None
    np.testing.assert_allclose(sequence.calibration.T_lidar_gnss[:3, 3], [-0.81, 0.32, -0.8])
    both = with_imu(sequence)
    assert both.imu is not None
    assert both.gnss is sequence.gnss
    other = open_sequence(kitti_root(tmp_path / "more", 5, "21"))
    assert with_gnss(other) is other


def test_the_faster_extract_drive_is_preferred_and_timed_by_the_camera(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path / "kitti", 5)
    day = tmp_path / "elsewhere" / "raw" / "2011_09_30"
    oxts(day / f"{DRIVE}_sync" / "oxts", 20, 10.0)
    oxts(day / f"{DRIVE}_extract" / "oxts", 200, 100.0, begin=-0.5)
    camera = day / f"{DRIVE}_sync" / "image_00"
    camera.mkdir()
    (camera / "timestamps.txt").write_text("2011-09-30 12:00:00.250000000\n")
    calibration(day)
    sequence = with_imu(open_sequence(folder), tmp_path / "elsewhere")
    assert sequence.imu is not None
    assert len(sequence.imu) == 200
    assert sequence.imu.stamps_ns[75] == sequence.stamps_ns[0], "0.75 s after the first of 100 Hz"


PLACES = {
    "inside": "seq07",
    "beside": "",
    "by its day": "2011_09_30",
    "under raw": "raw",
    "under raw by its day": "raw/2011_09_30",
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("root", ["current folder", "data root"])
def test_a_folder_called_seq07_finds_its_drive(
    place: str, root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LSLAM_DATA", raising=False)
    kitti_root(tmp_path / "kitti", 20).rename(tmp_path / "seq07")
    poses = tmp_path / "kitti" / "poses"
    poses.rename(tmp_path / "poses")
    above = tmp_path / PLACES[place]
    oxts(above / f"{DRIVE}_sync" / "oxts", 20, 10.0)
    calibration(above)
    monkeypatch.chdir(tmp_path if root == "current folder" else tmp_path / "kitti")
    sequence = open_sequence("seq07", data_root=tmp_path if root == "data root" else None, imu=True, gnss=True)
    assert sequence.imu is not None
    np.testing.assert_allclose(sequence.imu.gyro[:, 2], np.arange(20) / 1000)
    assert sequence.gnss is not None
    assert sequence.ground_truth is not None
    assert sequence.name == "seq07"


def test_the_calibration_of_the_day_lies_beside_a_drive_too(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path, 20)
    oxts(tmp_path / f"{DRIVE}_sync" / "oxts", 20, 10.0)
    (tmp_path / "2011_09_30").mkdir()
    calibration(tmp_path / "2011_09_30")
    assert with_imu(open_sequence(folder)).imu is not None


def test_without_the_drive_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kitti_root(tmp_path / "kitti", 5).rename(tmp_path / "seq07")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"2011_09_30_drive_0027_sync or _extract.*fetch the drive"):
        open_sequence("seq07", imu=True)


def test_nothing_found_names_every_place(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path / "kitti", 5)
    with pytest.raises(InputError) as error:
        with_imu(open_sequence(folder), tmp_path / "data")
    for part in (
        folder / "imu.csv",
        tmp_path / "data",
        Path.cwd(),
        f"raw/2011_09_30/{DRIVE}_sync or _extract",
        "4 above it",
    ):
        assert str(part) in str(error.value)
    assert len(str(error.value).replace(str(tmp_path), "").replace(str(Path.cwd()), "")) < 400
    assert error.value.exit_code == 3


def test_a_drive_without_calibration_or_samples_is_named(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path, 5)
    drive = tmp_path / "raw" / "2011_09_30" / f"{DRIVE}_sync"
    oxts(drive / "oxts", 5, 10.0)
    with pytest.raises(InputError, match="calib_imu_to_velo"):
        with_imu(open_sequence(folder))
    calibration(drive.parent)
    (drive / "oxts" / "timestamps.txt").unlink()
    with pytest.raises(InputError, match=f"{DRIVE}_sync"):
        with_imu(open_sequence(folder))


def test_an_imu_of_its_own_is_kept_and_other_numbers_have_none(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path, 5)
    write_imu_csv(folder / "imu.csv", ImuStream(np.array([0, 10]), np.ones((2, 3)), np.zeros((2, 3))))
    own = open_sequence(folder)
    assert with_imu(own) is own
    with pytest.raises(InputError, match=r"imu\.csv"):
        with_imu(open_sequence(kitti_root(tmp_path / "more", 5, "21")))


def test_the_real_drive_turns_as_the_ground_truth_of_sequence_07(
    recordings: Callable[[str], Path], tmp_path: Path
) -> None:
    """OXTS of 2011_09_30_drive_0027 at 10 Hz against the camera's poses: the same car, axes, unit and clock."""
    source = recordings("kitti_raw_oxts_0027") / "kitti_raw_oxts" / f"{DRIVE}_oxts"
    poses = recordings("kitti_poses") / "kitti_poses"
    folder = kitti_root(tmp_path, 1101)
    shutil.copytree(source, tmp_path / "raw" / "2011_09_30" / f"{DRIVE}_sync" / "oxts")
    (tmp_path / "raw" / "2011_09_30" / "calib_imu_to_velo.txt").write_text(
        "R: 9.999976e-01 7.553071e-04 -2.035826e-03 -7.854027e-04 9.998898e-01 -1.482298e-02 2.024406e-03 1.482454e-02 "
        "9.998881e-01\nT: -8.086759e-01 3.195559e-01 -7.997231e-01\n"
    )
    shutil.copy(poses / "ground_truth" / "07.txt", tmp_path / "poses" / "07.txt")
    sequence = with_imu(open_sequence(folder))
    assert sequence.imu is not None
    T = sequence.calibration
    assert T.T_lidar_imu is not None
    truth = read_trajectory(tmp_path / "poses" / "07.txt").poses
    # KITTI's camera: z ahead, x right, y down.
    axes = np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
    body = truth @ se3.make(axes, np.zeros(3))
    seen = so3.log(np.swapaxes(body[:-1, :3, :3], -1, -2) @ body[1:, :3, :3]) / 0.1
    felt = 0.5 * (sequence.imu.gyro[:1100] + sequence.imu.gyro[1:1101])
    assert np.corrcoef(seen[:, 2], felt[:, 2])[0, 1] > 0.99
    assert np.std(felt[:, 2]) == pytest.approx(np.std(seen[:, 2]), rel=0.05)
    assert np.linalg.norm(sequence.imu.accel.mean(axis=0)) == pytest.approx(9.81, abs=0.2)
