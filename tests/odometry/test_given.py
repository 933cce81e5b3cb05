"""Poses of somebody else: read off between the stamps, and missing where there is a gap."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.geometry import se3
from lslam.core.types.scan import Scan, Span
from lslam.core.types.trajectory import Trajectory
from lslam.odometry.given import GivenMotion, GivenPoses

STEP = 100_000_000
TWIST = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.1])
# Ten poses, two seconds without, ten more.
STAMPS = np.concatenate([np.arange(10), np.arange(30, 40)]) * STEP
TRAJECTORY = Trajectory(STAMPS, se3.exp(STAMPS[:, None] / STEP * TWIST))


def scan(stamp_ns: int) -> Scan:
    return Scan(np.ones((5, 3), np.float32), stamp_ns, 0)


@pytest.mark.parametrize(
    ("at", "status"),
    [(0.0, "ok"), (4.5, "ok"), (9.0, "ok"), (20.0, "bridged"), (35.2, "ok"), (39.0, "ok"), (45.0, "bridged")],
)
def test_a_scan_has_a_pose_where_the_trajectory_has(at: float, status: str) -> None:
    given = GivenPoses(TRAJECTORY)
    stamp = round(at * STEP)
    result = given.register(scan(stamp), None, given.motion.sweep(stamp, Span()))
    assert result.status == status
    assert bool(result.reason) == (status != "ok")
    if status == "ok":
        # Between poses the way is the chord, 12.5 mm from the arc of 1 m and 0.1 rad.
        np.testing.assert_allclose(result.T_world_lidar, se3.exp(at * TWIST), atol=0.013)


def test_the_sweep_follows_the_trajectory() -> None:
    motion = GivenMotion(TRAJECTORY)
    prior = motion.sweep(3 * STEP, Span(0.0, 0.1))
    np.testing.assert_allclose(prior.poses[0], se3.exp(3 * TWIST), atol=1e-9)
    np.testing.assert_allclose(prior.poses[-1], se3.exp(4 * TWIST), atol=1e-9)
    assert motion.refine(prior, 3 * STEP, prior.pose) is prior
    assert motion.is_known
