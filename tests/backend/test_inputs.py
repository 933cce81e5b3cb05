"""Floors and up directions out of keyframes."""

from __future__ import annotations

import numpy as np

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.levelling import floor_planes, up_directions, world_up
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import GravityDirection, ImuDiagnostics
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe


def ground(height: float, tilt: float = 0.0) -> np.ndarray:
    """A floor `height` m below the sensor, seen by one that is rolled by `tilt` rad, and a wall."""
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.uniform(-15, 15, (4000, 2)), np.full(4000, -height) + 0.01 * rng.normal(size=4000)])
    wall = np.column_stack([np.full(500, 8.0), rng.uniform(-10, 10, 500), rng.uniform(-height, 4, 500)])
    return (np.concatenate([flat, wall]) @ so3.exp(np.array([tilt, 0.0, 0.0]))).astype(np.float32)


def test_floors_are_planes_in_the_axes_of_their_keyframes() -> None:
    """The third stands on a roof: its floor is not the others'."""
    store = KeyframeStore()
    for n, (height, tilt) in enumerate([(1.7, 0.0), (1.7, 0.05), (5.0, 0.0)]):
        pose = se3.make(so3.exp(np.array([tilt, 0.0, 0.0])), np.array([3.0 * n, 0, 0]))
        store.add(Keyframe(n, n, n, pose), ground(height, tilt))
    planes = floor_planes(store, GraphConfig(floor_m=0.2, floor_deg=2.0))
    assert [p.keyframe for p in planes] == [0, 1]
    for plane, tilt in zip(planes, (0.0, 0.05), strict=True):
        np.testing.assert_allclose(plane.normal, [0.0, np.sin(tilt), np.cos(tilt)], atol=5e-3)
        assert abs(plane.offset - 1.7) < 0.03
        assert (plane.sigma_m, plane.sigma_rad) == (0.2, np.deg2rad(2.0))


def test_floors_of_a_sensor_upside_down_lie_above_it_in_its_world() -> None:
    store = KeyframeStore()
    R = np.diag([1.0, -1.0, -1.0])
    store.add(Keyframe(0, 0, 0, np.eye(4)), (ground(1.7) @ R).astype(np.float32))
    (plane,) = floor_planes(store, GraphConfig(), R[2], R[2])
    np.testing.assert_allclose(plane.normal, R[2], atol=5e-3)
    assert abs(plane.offset - 1.7) < 0.03
    assert floor_planes(store, GraphConfig())[0].offset < 0, "without up the sensor lies under it"


def test_nothing_below_is_no_floor() -> None:
    store = KeyframeStore()
    store.add(Keyframe(0, 0, 0, np.eye(4)), np.zeros((1, 3), np.float32))
    assert floor_planes(store, GraphConfig()) == []


def test_ups_of_one_stretch_count_as_one_measurement() -> None:
    """A minute at 1 Hz: twenty seconds of one error weigh as one sigma."""
    tilt = so3.exp(np.array([0.0, 0.1, 0.0]))
    pose = se3.make(tilt, np.zeros(3))
    down = GravityDirection(tilt.T @ np.array([0.0, 0, -1.0]), 0.01)
    results = [ScanResult(i, i * 10**9, pose, imu=ImuDiagnostics(gravity=down if i != 30 else None)) for i in range(60)]
    keyframes = [Keyframe(i, i, i * 10**9, pose) for i in range(60)]
    ups = up_directions(keyframes, results, GraphConfig())
    assert [u.keyframe for u in ups] == [i for i in range(60) if i != 30]
    middle = ups[15]
    np.testing.assert_allclose(middle.sigma / np.sqrt(middle.share), 0.01 * np.sqrt(21))
    np.testing.assert_allclose(world_up(ups, keyframes), [0, 0, 1], atol=1e-12)
    assert world_up([], keyframes) is None
