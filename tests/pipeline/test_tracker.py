"""What the loop between motion prior and odometry counts, with an odometry that knows the truth and says what it cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.config.imu import ImuConfig
from lslam.geometry import se3
from lslam.inertial.estimate import GRAVITY, ImuEstimate
from lslam.inertial.fusion import InertialMotion
from lslam.inertial.gyroscope import Gyroscope
from lslam.pipeline.tracker import Loaded, Tracker
from lslam.types.imu import ImuStream
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


Misses = frozenset[tuple[int, int]]


class Priced(Oracle):
    """True poses at a price of one step and 10 ms for each 5 cm that the prior is wrong; some scans are too far to find.

    missed : scans that are not found, each with the time it is asked for, from 1
    """

    lost_m = np.inf
    missed: Misses = frozenset()

    def register(self, scan: Scan, prepared: Scan, prior: MotionPrior) -> ScanResult:
        self.calls.append(scan.index)
        off = float(np.linalg.norm(prior.start[:3, 3] - self.poses[scan.index][:3, 3]))
        steps = 1 + int(off / 0.05)
        is_found = off < self.lost_m and (scan.index, self.calls.count(scan.index)) not in self.missed
        pose, status = (self.poses[scan.index], "ok") if is_found else (prior.start, "bridged")
        return ScanResult(scan.index, scan.stamp_ns, pose, status, iterations=steps, stages={"register": 0.01 * steps})  # type: ignore[arg-type]

    def update(self, scan: Scan, prepared: Scan, prior: MotionPrior, result: ScanResult) -> ScanResult:
        return replace(result, stages={**result.stages, "update": 7.0})


def braked(
    lost_m: float = np.inf, gap: tuple[float, float] = (0.0, 0.0), missed: Misses = frozenset()
) -> tuple[Priced, list[ScanResult]]:
    """From 40 m/s by 8 m/s2 with an IMU that knows all but in a `gap` (s): constant velocity is 8 cm wrong at each scan."""
    count, brake = 45, -8.0
    t = 0.1 * np.arange(count)
    poses = se3.make(np.eye(3), np.column_stack([40 * t + 0.5 * brake * t**2, 0 * t, 0 * t]))
    stamps = 10_000_000 * np.arange(10 * count, dtype=np.int64)
    rng = np.random.default_rng(0)
    accel = np.array([brake, 0.0, GRAVITY]) + rng.normal(0, 1e-9, (len(stamps), 3))
    gyro = rng.normal(0, 1e-12, (len(stamps), 3))
    kept = (stamps <= 1e9 * gap[0]) | (stamps >= 1e9 * gap[1])
    imu = ImuStream(stamps[kept], accel[kept], gyro[kept])
    known = ImuEstimate(
        np.array([40.0, 0, 0]),
        np.array([0, 0, -GRAVITY]),
        np.zeros(3),
        Gyroscope.of_bias(np.zeros(3), 1e-6),
        1e-8 * np.eye(9),
    )
    oracle = Priced(np.asarray(poses))
    oracle.lost_m, oracle.missed = lost_m, missed
    tracker = Tracker(oracle, motion=InertialMotion(imu, np.eye(4), known, ImuConfig(use=True)))
    scans = [Scan(np.ones((3, 3), np.float32), int(1e9 * k * 0.1), k) for k in range(count)]
    return oracle, [tracker.track(Loaded(k, scan.stamp_ns, scan, scan)) for k, scan in enumerate(scans)]


def test_some_scans_tell_what_the_imu_saves() -> None:
    oracle, results = braked()
    sample = [r for r in results if r.steady_iterations is not None]
    assert [r.index for r in sample] == [19, 39], "one in twenty"
    assert all(oracle.calls.count(r.index) == (2 if r in sample else 1) for r in results[2:])
    for r in sample:
        assert (r.iterations, r.steady_iterations) == (1, 2), "8 cm take a step more"
        assert r.saved_s == pytest.approx(0.01 - r.stages["imu"])
        np.testing.assert_array_equal(r.T_world_lidar, oracle.poses[r.index])
    assert all(r.stages["imu"] > 0 and r.saved_s is None for r in results[2:] if r not in sample)


def test_a_scan_that_constant_velocity_loses_compares_with_nothing() -> None:
    _, results = braked(lost_m=0.06)
    assert [r.index for r in results[2:] if r.status != "ok" or r.steady_iterations is not None] == []


def test_over_a_gap_of_the_imu_nothing_is_compared() -> None:
    """The 20th scan lies in the gap: constant velocity predicts it anyway."""
    oracle, results = braked(gap=(1.65, 2.55))
    assert [r.index for r in results if r.steady_iterations is not None] == [39]
    assert all(oracle.calls.count(r.index) == 1 for r in results[2:] if r.index != 39)


def test_scans_that_are_not_found_are_not_all_tried_twice() -> None:
    oracle, results = braked(missed=frozenset((k, n) for k in range(17, 27) for n in (1, 2)))
    assert [r.index for r in results if r.steady_iterations is not None] == [39]
    assert [k for k in range(2, 45) if oracle.calls.count(k) > 1] == [19, 39]


def test_a_scan_that_the_imu_loses_compares_with_nothing() -> None:
    _, results = braked(missed=frozenset({(19, 2)}))
    assert results[19].status == "bridged"
    assert [r.index for r in results if r.saved_s is not None] == [39]
