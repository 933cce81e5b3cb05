"""What every method is held to: measurable points go in, poses of a vehicle come out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.scan import FARTHEST_M, Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.base import Traits
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.scan_outcome import measurable, plausible

Floats = NDArray[np.float64]
PERIOD_NS = 100_000_000


def at(x: float, index: int = 1, stamp_ns: int = PERIOD_NS) -> ScanResult:
    return ScanResult(index, stamp_ns, se3.make(np.eye(3), np.array([x, 0.0, 0.0])), inliers=100, overlap=0.9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e31, -1.01 * FARTHEST_M])
def test_what_no_lidar_measures_is_left_out_with_all_that_goes_with_it(bad: float) -> None:
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    points[3, 1] = bad
    rest = np.arange(10) != 3
    scan = Scan(points, 0, 0, np.arange(10, dtype=np.float32), np.linspace(0, 0.1, 10, dtype=np.float32))
    kept = measurable(scan)
    np.testing.assert_array_equal(kept.points, points[rest])
    assert kept.intensity is not None
    assert kept.times is not None
    np.testing.assert_array_equal(kept.intensity, np.arange(10)[rest])
    assert len(kept.times) == 9


def test_a_scan_of_sound_points_is_itself() -> None:
    scan = Scan(np.array([[0.0, 0, 0], [0.99 * FARTHEST_M, 0, 0]], np.float32), 0, 0)
    assert measurable(scan) is scan


def spoilt(k: int, value: float) -> Floats:
    pose = np.eye(4)
    pose.flat[k] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        (spoilt(3, np.nan), "not finite"),
        (spoilt(0, np.inf), "not finite"),
        (np.eye(3), "not finite"),
        (spoilt(0, 1.01), "no rigid transform"),
        (spoilt(0, -1.0), "no rigid transform"),
        (spoilt(15, 2.0), "no rigid transform"),
        (spoilt(3, 16.0), "impossible jump of 16 m and 0 deg since scan 0, 0.1 s before"),
        (se3.make(so3.exp(np.array([0, 0, 2.1])), np.zeros(3)), "impossible jump of 0 m and 120 deg"),
    ],
)
def test_a_pose_that_is_none_is_bridged_by_the_motion_prior(pose: Floats, reason: str) -> None:
    prior = se3.make(np.eye(3), np.array([1.4, 0.0, 0.0]))
    result = plausible(replace(at(0.0), T_world_lidar=pose), prior, at(0.0, 0, 0))
    assert (result.status, result.converged, result.inliers, result.overlap) == ("bridged", False, 0, 0.0)
    assert reason in result.reason
    np.testing.assert_array_equal(result.T_world_lidar, prior)


@pytest.mark.parametrize(("x", "stamp_ns"), [(14.0, PERIOD_NS), (14.0, 100), (140.0, 10 * PERIOD_NS)])
def test_motions_that_a_vehicle_can_make_are_accepted(x: float, stamp_ns: int) -> None:
    """Also where the stamps run too fast: a registration may err by decimetres within no time."""
    result = at(x, 1, stamp_ns)
    assert plausible(result, np.eye(4), at(0.0, 0, 0)) is result
    assert plausible(at(1e6), np.eye(4), None).status == "ok", "nobody knows where a run begins"


class Jumping(Traits):
    """A method that claims one metre a scan, and 100 m more from one scan on."""

    def __init__(self, when: int) -> None:
        self.when = when

    def prepare(self, scan: Scan) -> None:
        return None

    def register(self, scan: Scan, prepared: None, prior: object) -> ScanResult:
        return at(scan.index + (100.0 if scan.index >= self.when else 0.0), scan.index, scan.stamp_ns)

    def warm_up(self) -> None:
        return None


def test_a_method_that_jumps_is_bridged_until_it_may_have_got_there() -> None:
    tracker = Tracker(Jumping(5))
    scans = [Scan(np.ones((3, 3), np.float32), k * PERIOD_NS, k) for k in range(20)]
    results = [tracker.track(ScanInput(k, scan.stamp_ns, scan)) for k, scan in enumerate(scans)]
    # 100 m take two thirds of a second at the speed of nothing that carries a LiDAR.
    assert [r.status for r in results] == ["ok"] * 5 + ["bridged"] * 7 + ["ok"] * 8
    assert results[7].T_world_lidar[0, 3] == pytest.approx(7.0)
    assert "impossible jump of 101 m" in results[5].reason
