"""What the loop between motion prior and odometry counts, with an odometry that knows the truth and says what it cost."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.geometry import se3
from lslam.pipeline.tracker import Loaded, Tracker
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult

SPAN_S = 0.1


class Oracle:
    """Gives true poses at a price of three steps and 10 ms a call."""

    def __init__(self, poses: NDArray[np.float64]) -> None:
        self.poses = poses
        self.calls: list[int] = []

    def prepare(self, scan: Scan) -> Scan:
        return scan

    def register(self, scan: Scan, prepared: Scan, prior: MotionPrior) -> ScanResult:
        self.calls.append(scan.index)
        return ScanResult(
            scan.index, scan.stamp_ns, self.poses[scan.index], iterations=3, stages={"register": 0.01, "deskew": 0.001}
        )

    def update(self, scan: Scan, prepared: Scan, prior: MotionPrior, result: ScanResult) -> ScanResult:
        return result

    def restart(self) -> None:
        pass

    def warm_up(self) -> None:
        pass


def drive(speeds: list[float]) -> tuple[Oracle, list[ScanResult]]:
    """Along x at these speeds, m per scan."""
    x = np.concatenate([[0.0], np.cumsum(speeds)])
    poses = se3.make(np.eye(3), np.column_stack([x, 0 * x, 0 * x]))
    oracle = Oracle(np.asarray(poses))
    tracker = Tracker(oracle)
    points = np.ones((3, 3), np.float32)
    times = np.linspace(0, SPAN_S, 3, dtype=np.float32)
    results = []
    for k in range(len(poses)):
        scan = Scan(points, k * 100_000_000, k, times=times)
        results.append(tracker.track(Loaded(k, scan.stamp_ns, scan, scan)))
    return oracle, results


def test_a_second_registration_costs_what_both_cost() -> None:
    oracle, results = drive([1.0] * 6 + [1.5] + [1.5] * 5)
    for result in results[2:]:
        calls = oracle.calls.count(result.index)
        assert result.iterations == 3 * calls
        assert result.stages["register"] == pytest.approx(0.01 * calls)
        assert result.stages["deskew"] == pytest.approx(0.001 * calls)
    assert oracle.calls.count(7) == 2, "the speed changed, so the sweep was deskewed wrongly at first"
    assert oracle.calls.count(5) == 1, "a steady drive needs none"
