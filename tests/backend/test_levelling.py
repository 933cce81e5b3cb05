"""Levelling: up is z, by an IMU or the ground, and only the world is rotated."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Stub

from lslam.backend.levelling import find_level, level_results
from lslam.core.config import Config, load_config
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import GravityDirection, ImuDiagnostics
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.odometry.frontend.register_scans import to_trajectory

Floats = NDArray[np.float64]
TILT = so3.from_euler_rpy(np.deg2rad([7.0, -11.0, 0.0]))


def config(*settings: str) -> Config:
    return load_config(None, list(settings), {})


@cache
def bend() -> Floats:
    """(60, 4, 4) poses in a level world of a sensor that is mounted askew and drives uphill round a bend."""
    k = np.arange(60)
    yaw = 0.03 * k
    R = so3.from_euler_rpy(np.column_stack([0.05 * np.sin(0.4 * k), -0.1 * np.ones(60), yaw])) @ TILT
    t = np.column_stack([20 * np.sin(yaw), 20 * (1 - np.cos(yaw)), 0.06 * k])
    return np.asarray(se3.make(R, t))


def results_of(level_poses: Floats, spread_deg: float = 0.0) -> list[ScanResult]:
    """As odometry gives them, in the world of the first scan; gravity as an IMU measured it with this sigma."""
    rng = np.random.default_rng(2)
    first = se3.inverse(level_poses[0])
    out = []
    for k, T in enumerate(level_poses):
        off = so3.exp(np.deg2rad(spread_deg) * rng.normal(size=3))
        covariance = (A := rng.normal(size=(6, 6))) @ A.T
        gravity = GravityDirection(-off @ T[2, :3], np.deg2rad(max(spread_deg, 0.1)))
        found = ScanResult(k, k * 100_000_000, first @ T, covariance=covariance, imu=ImuDiagnostics(gravity=gravity))
        out.append(replace(found, registration_covariance=2 * covariance, degenerate=np.eye(6)[1:2]))
    return out


def empty() -> Stub:
    return Stub([])


@pytest.mark.parametrize(("spread", "bound"), [(0.0, 1e-9), (1.0, 0.5)])
def test_gravity_makes_the_world_level(spread: float, bound: float) -> None:
    results = results_of(bend(), spread)
    level = find_level(empty(), results, config("imu.use=true"))
    found = np.stack([r.T_world_lidar for r in level_results(results, level)])
    off = [np.rad2deg(np.arccos(np.clip(a[2, :3] @ b[2, :3], -1, 1))) for a, b in zip(found, bend(), strict=True)]
    assert max(off) < max(bound, 1e-5)
    assert "levelled by gravity" in level.world
    np.testing.assert_allclose(found[0][:3, 3], 0, atol=1e-12)


def test_up_directions_are_weighted_by_their_sigmas() -> None:
    """The start mistakes a bias for a tilt of 5 deg, and says so."""
    results = results_of(bend())
    wrong = so3.exp(np.array([np.deg2rad(5), 0, 0]))
    for k in range(30):
        g = results[k].imu.gravity
        assert g is not None
        results[k] = replace(
            results[k], imu=ImuDiagnostics(gravity=GravityDirection(wrong @ g.direction, np.deg2rad(3)))
        )
    level = find_level(empty(), results, config("imu.use=true"))
    up = level.R @ results[0].T_world_lidar[:3, :3] @ bend()[0][2, :3]
    assert np.rad2deg(np.arccos(up[2])) < 0.1


def test_a_tilt_that_may_be_a_bias_is_left_alone() -> None:
    """A level sensor whose accelerometer says 2.5 deg, known to 2 deg: turning would tilt the map."""
    poses = bend() @ se3.make(TILT.T, np.zeros(3))
    poses = se3.inverse(poses[0]) @ poses
    wrong = so3.exp(np.array([np.deg2rad(2.5), 0, 0]))
    sigma = {True: 2.0, False: 0.5}
    for is_doubtful in (True, False):
        gravity = GravityDirection(wrong @ np.array([0, 0, -1.0]), np.deg2rad(sigma[is_doubtful]))
        level = find_level(
            empty(), [ScanResult(0, 0, poses[0], imu=ImuDiagnostics(gravity=gravity))], config("imu.use=true")
        )
        assert level.is_turned != is_doubtful
        assert ("not levelled: its tilt of 2.50 deg" in level.world) == is_doubtful


def test_only_the_world_turns() -> None:
    results = results_of(bend())
    level = find_level(empty(), results, config("imu.use=true"))
    turned = level_results(results, level)
    truth = Trajectory(np.array([r.stamp_ns for r in results]), np.stack([r.T_world_lidar for r in results]))
    rough = replace(truth, poses=truth.poses @ se3.exp(np.random.default_rng(0).normal(0, 0.02, (60, 6))))
    moved = [replace(r, T_world_lidar=T) for r, T in zip(results, rough.poses, strict=True)]
    before = evaluate(rough, truth)
    after = evaluate(to_trajectory(level_results(moved, level), "x"), truth)
    for name in ("se3", "origin"):
        a, b = before.ate[name].translation, after.ate[name].translation
        assert a is not None
        assert b is not None
        assert b.rmse == pytest.approx(a.rmse, rel=1e-6)
    assert before.scores["thesis1"].thesis_rmse == pytest.approx(after.scores["thesis1"].thesis_rmse, rel=1e-6)
    assert turned[5].imu.gravity is results[5].imu.gravity, "in LiDAR axes, so the same"
    # A twist of the pose has the same likelihood in either world.
    T, d = level.R, np.arange(6) / 10
    e = np.concatenate([T @ d[:3], T @ d[3:]])
    for which in ("covariance", "registration_covariance"):
        C, D = getattr(results[3], which), getattr(turned[3], which)
        assert e @ np.linalg.solve(D, e) == pytest.approx(d @ np.linalg.solve(C, d))
    np.testing.assert_allclose(turned[0].degenerate, np.append(T[:, 1], np.zeros(3))[None])


def ground_scan(has_ground: bool) -> Scan:
    """Level ground 2 m below a sensor that leans by `TILT`, or nothing but a ceiling of leaves."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(-15, 15, (8000, 2))
    z = np.full(8000, -2.0) + rng.normal(0, 0.02, 8000) if has_ground else rng.uniform(-9, 9, 8000)
    return Scan((np.column_stack([xy, z]) @ TILT).astype(np.float32), 0, 0)


def test_the_ground_makes_the_world_level() -> None:
    results = [ScanResult(0, 0, np.eye(4), "skipped"), ScanResult(1, 1, np.eye(4))]
    level = find_level(Stub(["gone", ground_scan(True)]), results, config("input.level=ground"))
    assert np.rad2deg(np.arccos((level.R @ TILT.T @ [0, 0, 1])[2])) < 0.2
    assert "levelled by the ground" in level.world


@pytest.mark.parametrize("roll_deg", [172.0, 180.0, 188.0])
def test_the_ground_under_a_sensor_upside_down_makes_the_world_level_and_ahead_stays(roll_deg: float) -> None:
    R = so3.from_euler_rpy(np.deg2rad([roll_deg, 5.0, 0.0]))
    scan = ground_scan(True)
    hanging = Scan((scan.points @ TILT.T @ R).astype(np.float32), 0, 0)
    settings = config("input.level=ground", f"preprocess.up={R[2].tolist()}")
    level = find_level(Stub([hanging]), [ScanResult(0, 0, np.eye(4))], settings)
    np.testing.assert_allclose(level.R @ R[2], [0, 0, 1], atol=4e-3)
    assert level.R[0, 0] > np.cos(np.deg2rad(6.0))


@pytest.mark.parametrize("wanted", ["ground", "gravity"])
def test_an_unavailable_levelling_is_reported(wanted: str) -> None:
    results = [ScanResult(0, 0, np.eye(4))]
    level = find_level(Stub([ground_scan(False)]), results, config(f"input.level={wanted}"))
    assert not level.is_turned
    assert level.world.endswith("not levelled")
    assert level.problem.startswith(f"input.level = {wanted}")
    assert level_results(results, level) is results


def test_auto_without_an_imu_and_none_leave_the_world_alone() -> None:
    results = results_of(bend())
    for settings in ((), ("imu.use=true", "input.level=none")):
        level = find_level(empty(), results, config(*settings))
        assert (level.is_turned, level.world) == (False, "LiDAR at the first scan, not levelled")
    blind = [replace(r, imu=ImuDiagnostics(gravity=None)) for r in results]
    refused = find_level(empty(), blind, config("imu.use=true"))
    assert (refused.is_turned, refused.problem) == (False, ""), "the refused IMU is a problem of its own"
