"""A shaking LiDAR: as strong as asked, in its band, in its rays and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.errors import ConfigError
from lslam.core.geometry import se3
from lslam.simulation.kinematics import Vibration, shaking
from lslam.simulation.lidar import trace
from lslam.simulation.lidar_models import LidarModel
from lslam.simulation.scenario_files import find_scenario
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, Surface

SHARES_TOWNS = True

SHAKEN = ["vibration.angle_deg=0.2", "vibration.height_mm=5"]


def test_it_has_the_given_strength_in_the_given_band() -> None:
    found = shaking(Vibration(angle_deg=0.1, height_mm=3.0, band_hz=(5.0, 9.0)), np.random.default_rng(1))
    assert found is not None
    at = found.at(np.arange(0, 200, 0.01))
    rms = np.sqrt(np.mean(at**2, axis=0))
    np.testing.assert_allclose(rms[:3], np.radians(0.1), rtol=0.05)
    assert rms[3] == pytest.approx(0.003, rel=0.05)
    power = np.abs(np.fft.rfft(at * np.hanning(len(at))[:, None], axis=0)) ** 2
    hertz = np.fft.rfftfreq(len(at), 0.01)
    outside = (hertz < 4.9) | (hertz > 9.1)
    assert power[outside].sum() < 1e-4 * power.sum()
    assert shaking(Vibration(), np.random.default_rng(1)) is None


def test_rays_feel_it() -> None:
    """Carried by the shaken poses, points of a room lie on its walls; by the poses at rest they do not."""
    builder = MeshBuilder()
    builder.add_box([-8.0] * 3, [8.0] * 3, Surface.WALL)
    model = LidarModel("perfect", (10.0, -5.0, -30.0), 360, 0.1, 500.0, 0.0, 1e-6, 0.0, 1e6, 0.0)
    found = shaking(Vibration(angle_deg=1.0, height_mm=40.0), np.random.default_rng(2))
    assert found is not None
    poses = found.shake(np.eye(4), np.arange(360) * 0.1 / 360)
    scan = trace(RayScene(builder.build()), model, poses, np.random.default_rng(0), has_one_instant=True)
    assert scan.times is None
    column = np.tile(np.arange(360), 3)
    carried = np.stack([se3.apply(T, p) for T, p in zip(poses[column], scan.points.astype(float), strict=True)])
    np.testing.assert_allclose(np.abs(carried).max(axis=1), 8.0, atol=1e-3)
    assert np.abs(np.abs(scan.points).max(axis=1) - 8.0).max() > 0.05


@pytest.mark.parametrize("compensated", [True, False])
def test_the_truth_and_the_imu_do_not(compensated: bool) -> None:
    still, shaken = (
        simulate("block", count=4, imu="ideal", motion_compensated=compensated, settings=settings)
        for settings in ([], SHAKEN)
    )
    assert still.ground_truth is not None
    assert shaken.ground_truth is not None
    np.testing.assert_array_equal(still.ground_truth.poses, shaken.ground_truth.poses)
    assert still.imu is not None
    assert shaken.imu is not None
    np.testing.assert_array_equal(still.imu.gyro, shaken.imu.gyro)
    a, b = still.scan(3), shaken.scan(3)
    assert (b.times is None) == compensated
    assert a.points.tobytes() != b.points.tobytes()
    assert b.points.tobytes() == shaken.scan(3).points.tobytes()


def test_a_band_out_of_order_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"vibration\.band_hz"):
        find_scenario("urban", ["vibration.band_hz=[20, 5]"])
