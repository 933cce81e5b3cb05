"""How the sensor is mounted, found from the first scans and the IMU; the run says so and keeps it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import SAMPLE, Stub
from turned_sensor import TURNS, turn, turned_points

from lslam.core.config import Config, load_config, to_toml
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration
from lslam.io.readers import open_sequence
from lslam.odometry.frontend.scene_scale import with_up

G = 9.81


def drive(R: NDArray[np.float64], imu_force: NDArray[np.float64] | None = None) -> Stub:
    """The sample's first scans as a turned sensor sees them, after a sliver; an IMU in axes of its own."""
    recording = open_sequence(SAMPLE / "sequences" / "00")
    scans = [Scan(turned_points(recording.scan(k).points, R), k, k) for k in range(3)]
    scans[0] = Scan(scans[0].points[:40], 0, 0)
    out = Stub(["gone", *scans])
    if imu_force is not None:
        stamps = np.arange(0, 400_000_000, 10_000_000, dtype=np.int64)
        out.imu = ImuStream(stamps, np.tile(imu_force, (40, 1)), np.zeros((40, 3)))
        T = np.eye(4)
        T[:3, :3] = np.roll(np.eye(3), 1, axis=0)
        out.calibration = Calibration(T_lidar_imu=T)
    return out


def config(*settings: str) -> Config:
    return load_config(None, list(settings), {})


@pytest.mark.parametrize("name", TURNS)
def test_a_turned_sensor_is_noted_and_kept_in_the_configuration(name: str) -> None:
    R = turn(name)
    sequence = drive(R)
    found = with_up(sequence, config())
    assert found.preprocess.up is not None
    assert np.array(found.preprocess.up) @ R[2] > np.cos(np.deg2rad(2.0))
    assert "by ground" in sequence.notes[-1]
    assert with_up(sequence, found) is found
    assert "up = [" in to_toml(found)


def test_gravity_is_measured_in_the_axes_of_the_imu() -> None:
    """T_lidar_imu makes y of the LiDAR of the IMU's x."""
    R = turn("upside down")
    of_imu = np.roll(np.eye(3), 1, axis=0).T @ (G * R[2])
    sequence = drive(R, of_imu)
    up = with_up(sequence, config("imu.use=true")).preprocess.up
    assert up is not None
    assert up[2] < -0.999
    assert "by gravity" in sequence.notes[-1]


def test_a_level_sensor_has_the_configuration_that_was_given() -> None:
    upright = np.roll(np.eye(3), 1, axis=0).T @ np.array([0.0, 0.0, G])
    for force in (None, upright, -upright, np.zeros(3)):
        sequence, given = drive(np.eye(3), force), config("imu.use=true")
        assert with_up(sequence, given) is given
        assert len(sequence.notes) == 1


def test_what_the_user_says_is_believed() -> None:
    given = config("preprocess.up=[0, 0, -2]")
    assert with_up(drive(np.eye(3)), given) is given
    assert with_up(Stub(["gone"]), config()).preprocess.up is None


@pytest.mark.parametrize("up", ["[0, 0, 0]", "[0, nan, 1]", "[inf, 0, 1]", "[1, 0]"])
def test_up_that_is_no_direction_is_refused(up: str) -> None:
    with pytest.raises(Exception, match="up"):
        config(f"preprocess.up={up}")
