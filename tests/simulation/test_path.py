"""Curves, speed profiles and vehicle poses against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.geometry import se3, so3
from lslam.simulation.curve import RouteCurve, flat, rolling, rounded_rectangle, smooth_curve, winding_line
from lslam.simulation.path import SpeedProfile, Swing, VehiclePath, drive, suspension

STILL = Swing(np.zeros((1, 3)), np.ones((1, 1)), np.zeros((1, 3)))


def straight(length: float = 200.0) -> RouteCurve:
    return smooth_curve(np.array([[0.0, 0.0], [length, 0.0]]), closed=False)


def circle(radius: float) -> RouteCurve:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    return smooth_curve(radius * np.stack([np.cos(angle), np.sin(angle)], 1), closed=True)


def test_straight_line_stays_straight_to_its_ends() -> None:
    line = straight()
    s = np.linspace(0, line.length, 500)
    assert line.length == pytest.approx(200.0, abs=1e-6)
    np.testing.assert_allclose(line.position(s), np.column_stack([s, 0 * s]), atol=1e-6)
    np.testing.assert_allclose(line.curvature(s), 0, atol=1e-6)
    np.testing.assert_allclose(line.beside(s, 2.0)[:, 1], 2.0, atol=1e-6)


def test_circle_has_its_curvature_and_wraps() -> None:
    line = circle(20.0)
    s = np.linspace(0, line.length, 100)
    np.testing.assert_allclose(line.curvature(s), 1 / 20, rtol=0.015)
    np.testing.assert_allclose(line.position(s + line.length), line.position(s), atol=1e-9)
    # Smoothing by 1.5 m draws a circle of 20 m in by 1.5^2 / (2 * 20^2).
    assert line.length == pytest.approx(2 * np.pi * 20 * (1 - 1.5**2 / 800), rel=3e-4)


def test_length_is_the_arc_length() -> None:
    line = smooth_curve(rounded_rectangle(36, 28, 11), closed=True)
    fine = line.position(np.linspace(0, line.length, 200_001))
    assert np.linalg.norm(np.diff(fine, axis=0), axis=1).sum() == pytest.approx(line.length, rel=1e-4)


def test_winding_street_bends_gently() -> None:
    for seed in range(5):
        line = smooth_curve(winding_line(np.random.default_rng(seed), 440), closed=False)
        assert 1 / np.abs(line.curvature(line.sample(1.0))).max() > 50


def test_start_from_rest_grows_into_half_a_t_squared() -> None:
    """The acceleration a grows evenly over the easing T: s = a t^3 / 6T, and then a (t - T/2)^2 / 2 + a T^2 / 24."""
    limits = SpeedProfile(10.0, 0.0, acceleration=2.0, braking=2.0, jerk=2.0)
    path = drive(straight(), flat(), limits, 150.0, 1.73, STILL)
    t = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    grown = np.where(t < 2, t**3 / 6, (t - 1) ** 2 + 1 / 3)
    np.testing.assert_allclose(path.poses(t)[:, 0, 3], grown, atol=0.02)
    np.testing.assert_allclose(path.poses(t)[:, 2, 3], 1.73, atol=1e-9)
    late = path.poses(np.array([8.0, 9.0]))
    assert late[1, 0, 3] - late[0, 0, 3] == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize("start", [0.0, 6.0])
def test_no_acceleration_steps_and_the_jerk_is_limited(start: float) -> None:
    """Along winding way-points with sharp bends: what the seat feels along the road."""
    line = smooth_curve(np.array([[0.0, 0], [60, 0], [60, 60], [140, 60], [150, 0]]), closed=False, smoothing=4.0)
    limits = SpeedProfile(12.0, start)
    path = drive(line, flat(), limits, line.length, 1.73, STILL)
    t = np.arange(0.0, path.duration, 0.02)
    v, a, jerk = (np.asarray(path.distance(t, nu=k)) for k in (1, 2, 3))
    assert np.abs(jerk).max() < 1.2 * limits.jerk
    assert a.max() < limits.acceleration + 0.01
    assert a.min() > -limits.braking - 0.01
    assert a.min() < -1.0, "it does brake"
    assert v[0] == pytest.approx(start, abs=0.02)
    # Nor is any bend taken faster than it was to be.
    across = v**2 * np.abs(line.curvature(np.asarray(path.distance(t))))
    assert across.max() < 1.1 * limits.lateral
    assert float(path.distance(path.duration)) == pytest.approx(line.length, abs=0.05)


def test_constant_speed_is_exact() -> None:
    path = drive(straight(), flat(), SpeedProfile(25.0, 25.0), 200.0, 1.73, STILL)
    poses = path.poses(np.arange(0, 7, 0.1))
    np.testing.assert_allclose(np.diff(poses[:, 0, 3]), 2.5, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3], np.eye(3)[None].repeat(70, 0), atol=1e-9)


def test_bends_limit_the_speed_and_braking_comes_before_them() -> None:
    line = smooth_curve(np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0]]), closed=False, smoothing=4.0)
    limits = SpeedProfile(15.0, 15.0, acceleration=3.0, braking=4.0, lateral=4.0)
    path = drive(line, flat(), limits, line.length, 1.73, STILL)
    t = np.linspace(0, path.duration, 4000)
    p = path.poses(t)[:, :2, 3]
    v = np.gradient(p, t, axis=0)
    a = np.gradient(v, t, axis=0)[5:-5]
    assert np.linalg.norm(a, axis=1).max() < 1.3 * np.hypot(4.0, 4.0)
    assert np.linalg.norm(v, axis=1).min() < 9.0
    assert np.linalg.norm(v, axis=1).max() == pytest.approx(15.0, rel=0.01)


def hilly_path(shaking: Swing) -> VehiclePath:
    rng = np.random.default_rng(1)
    return drive(circle(30.0), rolling(rng), SpeedProfile(8.0, 8.0), 150.0, 1.73, shaking)


def test_vehicle_stands_square_on_uneven_ground() -> None:
    """Height over the ground along its normal, and the ground's slope along and across the vehicle."""
    path = hilly_path(STILL)
    poses = path.poses(np.linspace(0, 15, 200))
    z = poses[:, :3, 2]
    foot = poses[:, :3, 3] - 1.73 * z
    np.testing.assert_allclose(foot[:, 2], path.terrain.height(foot[:, :2]), atol=1e-9)
    for axis in (0, 1):
        there = foot + 1e-4 * poses[:, :3, axis]
        np.testing.assert_allclose(there[:, 2], path.terrain.height(there[:, :2]), atol=1e-7)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3)[None].repeat(200, 0), atol=1e-12)
    assert np.degrees(np.arccos(z[:, 2])).max() > 0.3


def test_poses_are_smooth_over_laps() -> None:
    path = hilly_path(suspension(np.random.default_rng(5)))
    t = np.arange(0, 18, 0.001)
    poses = path.poses(t)
    step = se3.relative(poses[:-1], poses[1:])
    twist = np.concatenate([step[:, :3, 3], so3.log(step[:, :3, :3])], axis=1) / 0.001
    change = np.diff(twist, axis=0) / 0.001
    assert np.abs(change).max() < 5.0  # m/s2 and rad/s2


def test_slope_is_the_derivative_of_height() -> None:
    ground = rolling(np.random.default_rng(2))
    xy = np.random.default_rng(3).uniform(-100, 100, (50, 2))
    h = 1e-5
    for k in (0, 1):
        step = h * np.eye(2)[k]
        numeric = (ground.height(xy + step) - ground.height(xy - step)) / (2 * h)
        np.testing.assert_allclose(ground.slope(xy)[:, k], numeric, atol=1e-8)
