"""The motion within sweeps by which the map is deskewed, against motions that are known."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.inertial.constant_velocity import Course
from lslam.pipeline.map_pass import motion_within, scan_poser

POINT = np.array([[20.0, 5.0, 1.0]])


def swinging(seconds: Floats) -> Floats:
    """A hand that swings by 5 deg in a second, and bobs by 2 cm in half of one, at 1.3 m/s."""
    phase = 2 * np.pi * seconds
    turns = np.deg2rad(5.0) * np.column_stack([0 * phase, 0.4 * np.sin(phase), np.cos(phase)])
    return se3.make(so3.exp(turns), np.column_stack([1.3 * seconds, 0 * seconds, 0.02 * np.sin(2 * phase)]))


def sweep(k: int) -> Scan:
    """A sweep of 0.1 s, one point at one place of the world, seen anew every millisecond."""
    times = np.arange(0.0, 0.1, 0.001)
    seen = np.concatenate([se3.apply(se3.inverse(T), POINT) for T in swinging(0.1 * k + times)])
    return Scan(seen.astype(np.float32), k * 10**8, k, times=times.astype(np.float32))


def course(instants_ns: Longs) -> Course:
    return Course(instants_ns, swinging(1e-9 * instants_ns))


def off_m(scan: Scan, known: Course) -> float:
    """How far, m, the place is from where points measured at the knots would put it, at most."""
    motion = motion_within(scan, known)
    found = se3.relative(motion.pose, motion.poses)
    true = se3.relative(swinging(np.array([1e-9 * scan.stamp_ns]))[0], swinging(1e-9 * scan.stamp_ns + motion.times))
    return max(float(np.linalg.norm(se3.apply(T, POINT) - POINT)) for T in found @ se3.inverse(true))


@pytest.mark.parametrize("k", range(4, 12))
def test_poses_round_a_sweep_tell_how_it_swings(k: int) -> None:
    around = course(np.arange(20) * 10**8)
    line = Course(around.instants_ns[[k, k + 1]], around.poses[[k, k + 1]])  # too few for a spline
    assert off_m(sweep(k), around) < 0.005
    assert off_m(sweep(k), around) < 0.15 * off_m(sweep(k), line)


def test_many_poses_within_a_sweep_all_count() -> None:
    """An inertial system's poses at 100 Hz: the three beside the middle of the sweep do not reach its ends."""
    assert off_m(sweep(5), course(np.arange(200) * 10**7)) < 1e-3


def test_a_pose_in_a_frame_of_its_own_bends_no_sweep() -> None:
    poses = np.stack([swinging(np.array([0.1 * k]))[0] for k in range(12)])
    apart = poses.copy()
    apart[6:8, :3, 3] += 50.0
    points = []
    for given, frame in ((poses, 0), (apart, 1)):
        results = [ScanResult(k, 10**8 * k, given[k], frame=frame if k in (6, 7) else 0) for k in range(12)]
        posed = scan_poser(results, Config())(sweep(4))
        assert posed is not None
        points.append(posed.points)
        assert (scan_poser(results, Config())(sweep(6)) is None) == bool(frame)
    assert np.abs(points[0] - points[1]).max() < 0.02
