"""The loop between motion prior and odometry: numbers of registrations, with an odometry that has the true poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import se3
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan, Span
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.base import Traits
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.initialise import InertialStart
from lslam.odometry.scan_outcome import to_scan_result
from lslam.registration.result import RegistrationResult

SPAN_S, NO_SPAN = 0.1, Span()


class Oracle(Traits):
    """Gives true poses at a price of three steps and 10 ms a call."""

    is_searching = False

    def __init__(self, poses: NDArray[np.float64]) -> None:
        self.poses = poses
        self.calls: list[int] = []

    def prepare(self, scan: Scan) -> Scan:
        return scan

    def register(self, scan: Scan, prepared: Scan, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        self.calls.append(scan.index)
        stages = {"register": 0.01, "deskew": 0.001}
        return RegistrationResult(self.poses[scan.index], iterations=3, stages=stages)

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        return to_scan_result(scan, result, result.covariance, result.covariance)

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
        results.append(tracker.track(ScanInput(k, scan.stamp_ns, scan, scan)))
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

    def register(self, scan: Scan, prepared: Scan, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        self.calls.append(scan.index)
        off = float(np.linalg.norm(prior.pose[:3, 3] - self.poses[scan.index][:3, 3]))
        steps = 1 + int(off / 0.05)
        is_found = off < self.lost_m and (scan.index, self.calls.count(scan.index)) not in self.missed
        pose = self.poses[scan.index] if is_found else prior.pose
        stages = {"register": 0.01 * steps}
        return RegistrationResult(pose, ok=is_found, converged=is_found, iterations=steps, stages=stages)

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        return replace(super().update(scan, prior, result), stages={**result.stages, "update": 7.0})


class Misled(Priced):
    """Sure of a place three metres off at one scan, or lost; near the prior it finds the truth, nothing, or a false place.

    Near it takes a step and 10 ms more.
    """

    is_searching = True
    FALSE_AT, FALSE_M = 20, 3.0
    near = "true"
    is_lost = False
    off_m = 0.0

    def register(self, scan: Scan, prepared: Scan, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        found = replace(super().register(scan, prepared, prior), covariance=1e-6 * np.eye(6))
        true, is_there = self.poses[scan.index].copy(), scan.index == self.FALSE_AT
        if is_near:
            found = replace(
                found, iterations=found.iterations + 1, stages={"register": found.stages["register"] + 0.01}
            )
            self.off_m = max(self.off_m, float(np.linalg.norm(prior.pose[:3, 3] - true[:3, 3])))
        if self.near == "nothing" if is_near else self.is_lost and is_there:
            reason = "nothing near" if is_near else "lost"
            return replace(found, T_world_lidar=prior.pose, ok=False, converged=False, reason=reason)
        off = {"true": 0.0, "elsewhere": 1.0, "same": self.FALSE_M}[self.near] if is_near else self.FALSE_M
        true[0, 3] += off * is_there
        return replace(found, T_world_lidar=true)


def braked(
    lost_m: float = np.inf, gap: tuple[float, float] = (0.0, 0.0), missed: Misses = frozenset(),
    kind: type[Priced] = Priced, span: Span = NO_SPAN,
) -> tuple[Priced, list[ScanResult]]:  # fmt: skip
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
    oracle = kind(np.asarray(poses))
    oracle.lost_m, oracle.missed = lost_m, missed
    tracker = Tracker(
        oracle, motion=InertialMotion(InertialStart(imu, np.eye(4), known), Config(imu=ImuConfig(use=True)))
    )
    times = np.linspace(*span, 3, dtype=np.float32)
    scans = [Scan(np.ones((3, 3), np.float32), int(1e9 * k * 0.1), k, times=times) for k in range(count)]
    return oracle, [tracker.track(ScanInput(k, scan.stamp_ns, scan, scan)) for k, scan in enumerate(scans)]


WHY = "registration is 3.00 m and 0.0 deg from what the IMU felt"


@pytest.mark.parametrize(
    ("near", "is_lost", "off_m", "reason"),
    [
        ("true", False, 0.0, ""),
        ("nothing", False, 0.0, WHY),
        ("elsewhere", False, 0.0, WHY),
        ("same", False, Misled.FALSE_M, ""),
        ("true", True, 0.0, ""),
        ("nothing", True, 0.0, "lost"),
        ("elsewhere", True, 0.0, "lost"),
    ],
)
def test_a_lost_or_rejected_scan_is_registered_again_from_the_imus_prediction(
    near: str, is_lost: bool, off_m: float, reason: str
) -> None:
    """Found there, it is there; found where it was denied from there too, it is right and the IMU wrong."""
    oracle, results = braked(kind=type("Told", (Misled,), {"near": near, "is_lost": is_lost}))
    denied = results[Misled.FALSE_AT]
    assert oracle.calls.count(denied.index) == 2
    off = denied.T_world_lidar[:3, 3] - oracle.poses[denied.index, :3, 3]
    np.testing.assert_allclose(off, [off_m, 0, 0], atol=1e-2)
    assert (denied.status, denied.reason) == ("bridged" if reason else "ok", reason)
    assert (denied.iterations, denied.stages["register"]) == (3, pytest.approx(0.03)), "of both registrations"
    assert denied.converged == (not reason)


def test_the_second_registration_starts_at_the_imus_prediction_not_at_the_rejected_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However little the sweep changes: deskewed anew, it begins at the false place."""
    monkeypatch.setattr(Tracker, "REFINE_M", -1.0)
    oracle, results = braked(kind=Misled, span=Span(0.0, SPAN_S))
    denied = results[Misled.FALSE_AT]
    assert isinstance(oracle, Misled)
    assert oracle.calls.count(denied.index) == 3
    assert 0.0 < oracle.off_m < 0.05
    assert denied.status == "ok"
    np.testing.assert_allclose(denied.T_world_lidar, oracle.poses[denied.index], atol=0.02)


def test_over_a_gap_of_the_imu_a_lost_scan_is_not_registered_again() -> None:
    oracle, results = braked(gap=(1.5, 2.6), kind=type("Told", (Misled,), {"is_lost": True}))
    lost = results[Misled.FALSE_AT]
    assert (lost.status, lost.reason, oracle.calls.count(lost.index)) == ("bridged", "lost", 1)


def test_a_first_sweep_before_the_imu_is_deskewed_after_the_second() -> None:
    """Stamped in the middle: of the second sweep, and of all since the first stamp, the IMU tells."""
    for begins_s, asked in ((0.08, 2), (0.0, 1)):
        oracle, results = braked(gap=(-1.0, begins_s), span=Span(-0.5 * SPAN_S, 0.5 * SPAN_S))
        assert all(r.status == "ok" for r in results)
        assert oracle.calls.count(0) == asked


def test_one_scan_in_twenty_measures_what_the_imu_saves() -> None:
    oracle, results = braked()
    sample = [r for r in results if r.imu.steady_iterations is not None]
    assert [r.index for r in sample] == [19, 39], "one in twenty"
    assert all(oracle.calls.count(r.index) == (2 if r in sample else 1) for r in results[2:])
    for r in sample:
        assert (r.iterations, r.imu.steady_iterations) == (1, 2), "8 cm take a step more"
        assert r.imu.saved_s == pytest.approx(0.01 - r.stages["imu"])
        np.testing.assert_array_equal(r.T_world_lidar, oracle.poses[r.index])
    assert all(r.stages["imu"] > 0 and r.imu.saved_s is None for r in results[2:] if r not in sample)


def test_a_scan_lost_by_constant_velocity_gives_no_comparison() -> None:
    _, results = braked(lost_m=0.06)
    assert [r.index for r in results[2:] if r.status != "ok" or r.imu.steady_iterations is not None] == []


def test_over_a_gap_of_the_imu_no_scan_is_compared() -> None:
    """The 20th scan lies in the gap: constant velocity predicts it anyway."""
    oracle, results = braked(gap=(1.65, 2.55))
    assert [r.index for r in results if r.imu.steady_iterations is not None] == [39]
    assert all(oracle.calls.count(r.index) == 1 for r in results[2:] if r.index != 39)


def test_scans_that_are_not_found_are_not_all_tried_twice() -> None:
    oracle, results = braked(missed=frozenset((k, n) for k in range(17, 27) for n in (1, 2)))
    assert [r.index for r in results if r.imu.steady_iterations is not None] == [39]
    assert [k for k in range(2, 45) if oracle.calls.count(k) > 1] == [19, 39]


def test_a_scan_lost_by_the_imu_gives_no_comparison() -> None:
    _, results = braked(missed=frozenset({(19, 2)}))
    assert results[19].status == "bridged"
    assert [r.index for r in results if r.imu.saved_s is not None] == [39]


class Weighing(Oracle):
    """Remembers how many points each registration was of, by scan."""

    def __init__(self, poses: NDArray[np.float64]) -> None:
        super().__init__(poses)
        self.points: list[tuple[int, int]] = []

    def register(self, scan: Scan, prepared: Scan, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        assert len(scan) == len(prepared)
        self.points.append((scan.index, len(scan)))
        return super().register(scan, prepared, prior)


def test_the_first_motion_is_told_by_one_of_several_lidars() -> None:
    """Before it is known their clouds do not fit each other; then the first scan is taken in anew, with all points."""
    x = np.arange(5.0)
    oracle = Weighing(np.asarray(se3.make(np.eye(3), np.column_stack([x, 0 * x, 0 * x]))))
    tracker = Tracker(oracle)
    times, lidars = np.linspace(0, SPAN_S, 7, dtype=np.float32), np.array([0, 0, 0, 0, 1, 1, 1], np.uint8)
    for k in range(5):
        scan = Scan(np.ones((7, 3), np.float32), k * 100_000_000, k, times=times, lidars=lidars)
        tracker.track(ScanInput(k, scan.stamp_ns, scan, scan))
    alone, whole = [points for points in oracle.points if points[1] == 4], oracle.points
    assert [index for index, _ in alone] == [0, 1]
    assert whole[2:4] == [(0, 7), (1, 7)], "both again, with all points"
    assert {count for index, count in whole if index > 1} == {7}
