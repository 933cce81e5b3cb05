"""The stationary detector: on simulated starts from rest, while creeping, and amid traffic."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.stationary import StationaryDetector
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]


@cache
def drive(scenario: str, lidar: str | None, count: int, **more: float) -> tuple[tuple[Scan, ...], Floats]:
    simulated = simulate(scenario, seed=0, lidar=lidar, count=count, motion_compensated=True, **more)  # type: ignore[arg-type]
    assert simulated.ground_truth is not None
    return tuple(simulated), simulated.ground_truth.poses


def judge(scans: tuple[Scan, ...], truth: Floats, **options: Any) -> list[ScanResult]:
    """Every scan goes to `StationaryDetector`, and to a registration that knows the truth when it moves."""
    config = Config.model_validate({"preprocess": {"skip_standing": True, **options}})
    stationary = StationaryDetector(config.preprocess, config.registration)
    results = []
    for scan, pose in zip(scans, truth, strict=True):
        result = stationary.result_of(scan)
        if result is None:
            result = ScanResult(scan.index, scan.stamp_ns, pose)
            stationary.observe(scan, result)
        results.append(result)
    return results


def errors(results: list[ScanResult], truth: Floats) -> tuple[Floats, Floats]:
    """m and deg of every pose against the truth."""
    off = se3.relative(truth, np.stack([r.T_world_lidar for r in results]))
    return np.asarray(np.linalg.norm(off[:, :3, 3], axis=1)), np.rad2deg(so3.angle(off[:, :3, :3]))


@pytest.mark.parametrize(("scenario", "lidar"), [("block", None), ("street", "vlp16")])
def test_a_start_from_rest_is_skipped_until_the_sensor_moves(scenario: str, lidar: str | None) -> None:
    scans, truth = drive(scenario, lidar, 42, static_start=1.0)
    results = judge(scans, truth)
    stood = np.array([r.is_stationary for r in results])
    rests = int((np.linalg.norm(truth[:, :3, 3], axis=1) < 1e-9).sum())
    assert rests > 10
    assert stood[1:rests].mean() > 0.9
    is_fast = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1) > 0.03
    assert is_fast.sum() > 2
    assert not stood[1:][is_fast].any()
    metres, degrees = errors(results, truth)
    assert metres.max() < 0.04
    assert degrees.max() < 0.2


@pytest.mark.parametrize(("scenario", "lidar"), [("block", None), ("street", "vlp16")])
def test_creeping_is_not_skipped_and_slower_creeping_adds_up(scenario: str, lidar: str | None) -> None:
    scans, truth = drive(scenario, lidar, 12, speed=0.5, start_speed=0.5)
    assert np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).max() < 0.06
    assert not any(r.is_stationary for r in judge(scans, truth))
    scans, truth = drive(scenario, lidar, 30, speed=0.1, start_speed=0.1)
    results = judge(scans, truth)
    metres, _ = errors(results, truth)
    assert metres.max() < 0.04
    assert 0.2 < np.mean([r.is_stationary for r in results]) < 0.9


def test_a_stationary_scan_has_the_pose_and_covariance_of_its_reference() -> None:
    scans, _ = drive("block", None, 34, static_start=1.0)
    config = Config.model_validate({"preprocess": {"skip_standing": True}})
    stationary = StationaryDetector(config.preprocess, config.registration)
    assert stationary.result_of(scans[0]) is None
    pose, uncertainty = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3])), np.diag(np.arange(1.0, 7))
    stationary.observe(
        scans[0], ScanResult(0, 0, pose, covariance=uncertainty, registration_covariance=2 * uncertainty)
    )
    result = stationary.result_of(scans[1])
    assert result is not None
    assert (result.index, result.stamp_ns, result.status, result.is_stationary) == (1, scans[1].stamp_ns, "ok", True)
    assert result.reason == "standing since scan 0"
    np.testing.assert_array_equal(result.T_world_lidar, pose)
    np.testing.assert_array_equal(result.covariance, uncertainty)


def test_the_detector_is_off_while_driving_and_after_a_failure() -> None:
    scans, truth = drive("block", None, 34, static_start=1.0)
    config = Config()
    stationary = StationaryDetector(config.preprocess, config.registration)
    stationary.observe(scans[0], ScanResult(0, 0, np.eye(4)))
    assert stationary.result_of(scans[1]) is not None
    far = se3.make(np.eye(3), np.array([0.5, 0, 0]))
    stationary.observe(scans[1], ScanResult(1, 1, far))
    assert stationary.result_of(scans[2]) is None
    stationary.observe(scans[2], ScanResult(2, 2, far))
    assert stationary.result_of(scans[3]) is not None
    stationary.observe(scans[3], ScanResult(3, 3, truth[3], "bridged"))
    assert stationary.result_of(scans[4]) is None


@pytest.mark.parametrize("kind", ["empty", "noise", "a plane without end"])
def test_a_scan_without_observability_is_not_stationary(kind: str) -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-30, 30, (9000, 2)), np.full(9000, -1.7)])
    first = {"empty": plane, "noise": rng.uniform(-20, 20, (9000, 3)), "a plane without end": plane}[kind]
    second = np.zeros((0, 3)) if kind == "empty" else first
    config = Config()
    stationary = StationaryDetector(config.preprocess, config.registration)
    stationary.observe(Scan(first.astype(np.float32), 0, 0), ScanResult(0, 0, np.eye(4)))
    assert stationary.result_of(Scan(second.astype(np.float32), 1, 1)) is None
