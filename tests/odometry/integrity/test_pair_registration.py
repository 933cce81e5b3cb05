"""Pairs of scans, laid on one another at motions that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.odometry.integrity.pair_registration import PairRegistration
from lslam.registration.preprocessing.prepare import PreparedPoints

Floats = NDArray[np.float64]

HALF = np.array([10.0, 8.0, 3.0])
WALLS_PER_AXIS = 4000


def room() -> Floats:
    """Points on the six walls of a room, with a centimetre of noise."""
    rng = np.random.default_rng(0)
    walls = []
    for axis in range(3):
        points = rng.uniform(-HALF, HALF, (WALLS_PER_AXIS, 3))
        points[:, axis] = rng.choice([-1.0, 1.0], len(points)) * HALF[axis]
        walls.append(points)
    return np.concatenate(walls) + rng.normal(0, 0.01, (3 * WALLS_PER_AXIS, 3))


def seen(T_world_lidar: Floats, view_deg: float) -> Floats:
    """The room's points, LiDAR frame, within half the view of straight ahead."""
    points = se3.apply(se3.inverse(T_world_lidar), room())
    return points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.deg2rad(view_deg) / 2]


def prepared(points: Floats) -> PreparedPoints:
    return PreparedPoints(points.astype(np.float32), points, np.zeros((len(points), 6)), len(points))


def turned(degrees: float) -> Floats:
    return se3.make(so3.exp(np.array([0.0, 0.0, np.deg2rad(degrees)])), np.array([0.3, 0.1, 0.0]))


@pytest.mark.parametrize("view_deg", [70.0, 360.0])
def test_points_out_of_the_earlier_view_do_not_lessen_the_agreement(view_deg: float) -> None:
    pair = PairRegistration()
    pair.begin(seen(np.eye(4), view_deg), prepared(seen(turned(20.0), view_deg)))
    right = pair.at(turned(20.0))
    assert right.agreement > 0.9
    if view_deg < 360:
        assert right.result.agreement < 0.8, "a quarter of them is new"
        assert right.in_view < 0.85 * len(right.on_planes)


def test_a_motion_that_turns_the_scan_out_of_view_does_not_agree() -> None:
    pair = PairRegistration()
    pair.begin(seen(np.eye(4), 70.0), prepared(seen(turned(20.0), 70.0)))
    wrong = pair.at(turned(85.0))
    assert wrong.in_view < 0.2 * len(wrong.on_planes)
    assert wrong.agreement < 0.3
