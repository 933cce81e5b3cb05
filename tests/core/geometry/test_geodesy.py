"""Local frames: known distances on the ellipsoid, inverse, and the KITTI devkit's projection against its ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lslam.core.geometry import geodesy, se3, so3

# m; the sphere of the KITTI devkit (convertOxtsToPose.m).
DEVKIT_RADIUS = 6378137.0
KARLSRUHE = np.array([49.0112, 8.4229, 112.8])


@given(
    lat=st.floats(-80, 80),
    lon=st.floats(-179, 179),
    dn=st.floats(-0.02, 0.02),
    de=st.floats(-0.02, 0.02),
    h=st.floats(-100, 4000),
)
@settings(max_examples=50)
def test_there_and_back(lat: float, lon: float, dn: float, de: float, h: float) -> None:
    origin = np.array([lat, lon, h])
    fix = origin + np.array([dn, de, 12.5])
    back = geodesy.from_local(geodesy.to_local(fix[None], origin), origin)[0]
    np.testing.assert_allclose(back, fix, atol=1e-9)


def test_metres_are_metres_east_and_north() -> None:
    """Against the radii of curvature of the WGS84 ellipsoid: an independent formula."""
    a, e2 = 6378137.0, 6.69437999014e-3
    s = np.sin(np.radians(KARLSRUHE[0]))
    east_radius = a / np.sqrt(1 - e2 * s * s)
    north_radius = a * (1 - e2) / (1 - e2 * s * s) ** 1.5
    step = np.array([[0.001, 0, 0], [0, 0.001, 0], [0, 0, 7.0]])
    enu = geodesy.to_local(KARLSRUHE + step, KARLSRUHE)
    np.testing.assert_allclose(enu[0], [0, np.radians(0.001) * north_radius, 0], atol=1e-3)
    east = np.radians(0.001) * east_radius * np.cos(np.radians(KARLSRUHE[0]))
    np.testing.assert_allclose(enu[1, 0], east, atol=1e-3)
    np.testing.assert_allclose(enu[2], [0, 0, 7], atol=1e-9)


def to_kitti_mercator(lat_lon_alt: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(N, 3) lat, lon (deg), height (m) to (N, 3) m as KITTI's devkit does (spherical Mercator, scale cos(lat0)).

    It is off by +0.11 % northwards and -0.19 % eastwards at Karlsruhe: only for agreement with official KITTI poses.
    """
    fixes = np.asarray(lat_lon_alt, np.float64).reshape(-1, 3)

    def project(values: np.ndarray) -> np.ndarray:
        x = scale * DEVKIT_RADIUS * np.radians(values[:, 1])
        y = scale * DEVKIT_RADIUS * np.log(np.tan(np.radians(90 + values[:, 0]) / 2))
        return np.column_stack([x, y, values[:, 2]])

    first = np.asarray(origin, np.float64).reshape(1, 3)
    scale = float(np.cos(np.radians(first[0, 0])))
    return np.asarray(project(fixes) - project(first))


def test_the_devkit_projection_is_the_documented_amount_off() -> None:
    step = np.array([[0.001, 0, 0], [0, 0.001, 0]])
    true = geodesy.to_local(KARLSRUHE + step, KARLSRUHE)
    devkit = to_kitti_mercator(KARLSRUHE + step, KARLSRUHE)
    assert abs(devkit[0, 1] / true[0, 1] - 1.0011) < 2e-4
    assert abs(devkit[1, 0] / true[1, 0] - 0.9981) < 2e-4


def test_devkit_projection_gives_the_official_ground_truth(recordings: Callable[[str], Path]) -> None:
    """OXTS of sequence 07, carried to camera 0 through the extrinsics of another day, lies within 0.1 m of the truth."""
    from lslam.io.formats.kitti_layout import ROLL, YAW, read_oxts, read_raw_cam0_lidar, read_rigid

    oxts = read_oxts(recordings("kitti_raw_oxts_0027") / "kitti_raw_oxts" / "2011_09_30_drive_0027_oxts")
    day = recordings("kitti_raw_0048") / "2011_09_26"
    truth = np.loadtxt(recordings("kitti_poses") / "kitti_poses" / "ground_truth" / "07.txt").reshape(-1, 3, 4)[:, :, 3]
    assert oxts is not None
    positions = to_kitti_mercator(oxts.values[:, :3], oxts.values[0, :3])
    T_imu_cam0 = se3.inverse(read_raw_cam0_lidar(day) @ read_rigid(day / "calib_imu_to_velo.txt"))
    estimate = (se3.make(so3.from_euler_rpy(oxts.values[:, ROLL : YAW + 1]), positions) @ T_imu_cam0)[
        : len(truth), :3, 3
    ]
    T, _, determined = se3.umeyama(estimate, truth)
    assert determined
    error = np.linalg.norm(se3.apply(T, estimate) - truth, axis=1)
    assert error.mean() < 0.06
    assert error.max() < 0.15


def test_a_point_has_the_same_place_in_two_local_frames() -> None:
    old, new = np.array([49.0, 8.4, 110.0]), np.array([49.02, 8.45, 130.0])
    there = np.array([[3650.0, 2300.0, 5.0], [3000.0, 2000.0, -4.0]])
    moved = se3.apply(geodesy.frame_change(old, new), there)
    np.testing.assert_allclose(moved, geodesy.to_local(geodesy.from_local(there, old), new), atol=2e-3)
