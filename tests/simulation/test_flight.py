"""What flies and what is carried: heights, banks and swings against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.geometry import se3, so3
from lslam.simulation.curve import RouteCurve, rolling, smooth_curve, stretch
from lslam.simulation.path import GRAVITY, FreePath, SpeedProfile, buffeting, climb_spline, fly, gait

STEADY = SpeedProfile(8.0, 8.0, lateral=1e6)
CALM = buffeting(np.random.default_rng(0), 0.0)


def circle(radius: float) -> RouteCurve:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    return smooth_curve(radius * np.stack([np.cos(angle), np.sin(angle)], 1), closed=True)


def flight(curve: RouteCurve, heights: tuple[float, float] = (10.0, 10.0), bank: float = 1.0) -> FreePath:
    climb = climb_spline(curve, np.array([0.0, curve.length]), np.array(heights), 4.0)
    return fly(curve, STEADY, curve.length, climb, bank, CALM)


def test_a_turn_is_banked_so_that_nothing_pulls_sideways() -> None:
    """tan(roll) = v^2 / (r g), into the turn; without banking the LiDAR stays level."""
    curve = circle(30.0)
    radius = 1 / float(np.median(curve.curvature(curve.sample(1.0))))
    T = flight(curve).poses(np.linspace(1, 20, 50))
    roll = so3.euler_rpy(T[:, :3, :3])[:, 0]
    np.testing.assert_allclose(np.tan(roll), -(8.0**2) / (radius * GRAVITY), rtol=0.03)
    # The force the drone feels has no part along its left.
    a = np.diff(flight(curve).poses(np.arange(1, 10, 0.01))[:, :3, 3], n=2, axis=0) / 1e-4 + [0, 0, GRAVITY]
    sideways = np.einsum("ni,ni->n", a, flight(curve).poses(np.arange(1, 10, 0.01))[1:-1, :3, 1])
    assert np.abs(sideways).max() < 0.1
    level = flight(curve, bank=0.0).poses(np.linspace(1, 20, 50))
    np.testing.assert_allclose(level[:, 2, 2], 1.0, atol=1e-12)


def test_a_climb_is_even_and_its_speed_counts_along_the_slope() -> None:
    line = smooth_curve(np.array([[0.0, 0.0], [120.0, 0.0]]), closed=False)
    path = flight(line, (10.0, 40.0))
    p = path.poses(np.linspace(0, path.duration, 200))[:, :3, 3]
    np.testing.assert_allclose(p[:, 2], 10.0 + 0.25 * p[:, 0], atol=1e-6)
    assert np.linalg.norm(p[-1] - p[0]) / path.duration == pytest.approx(8.0, rel=1e-3)


def test_heights_of_way_points_are_passed_and_a_closed_profile_repeats() -> None:
    line = smooth_curve(np.array([[0.0, 0.0], [200.0, 0.0]]), closed=False)
    climb = climb_spline(line, np.array([0.0, 60.0, 140.0, 200.0]), np.array([10.0, 30.0, 30.0, 12.0]), 4.0)
    np.testing.assert_allclose([climb(0.0), climb(100.0), climb(200.0)], [10, 30, 12], atol=0.05)
    loop = circle(30.0)
    wave = climb_spline(loop, np.array([0, 0.5, 1.0]) * loop.length, np.array([10.0, 20.0, 10.0]), 4.0)
    assert wave(0.0) == pytest.approx(float(wave(loop.length)), abs=1e-9)
    assert float(wave(0.5 * loop.length)) > 19


def test_poses_are_rigid_and_smooth() -> None:
    path = fly(circle(25.0), STEADY, 150.0, climb_spline(circle(25.0), np.array([0.0, 150.0]), np.array([9.0, 9.0]), 3.0),
               1.0, buffeting(np.random.default_rng(3)))  # fmt: skip
    poses = path.poses(np.arange(0, 15, 0.001))
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    step = se3.relative(poses[:-1], poses[1:])
    twist = np.concatenate([step[:, :3, 3], so3.log(step[:, :3, :3])], axis=1) / 0.001
    assert np.abs(np.diff(twist, axis=0) / 0.001).max() < 8.0  # m/s2 and rad/s2


def test_a_walker_looks_about_fast_and_stays_above_the_ground() -> None:
    ground, line = rolling(np.random.default_rng(1)), circle(30.0)
    climb = climb_spline(line, np.array([0.0, line.length]), np.array([1.6, 1.6]), 1.5)
    path = fly(line, SpeedProfile(1.4, 1.4), 60.0, climb, 0.0, gait(np.random.default_rng(2)), ground)
    t = np.arange(0, 30, 0.01)
    poses = path.poses(t)
    rate = np.degrees(so3.angle(se3.relative(poses[:-1], poses[1:])[:, :3, :3])) / 0.01
    assert 90 < rate.max() < 220
    height = poses[:, 2, 3] - ground.height(poses[:, :2, 3])
    assert 1.4 < height.min() < height.max() < 1.8


def test_stretching_an_open_curve_goes_straight_on() -> None:
    line = smooth_curve(np.array([[0.0, 0.0], [50.0, 0.0], [80.0, 40.0]]), closed=False)
    longer = stretch(line, 40.0)
    assert longer.length == pytest.approx(line.length + 80, abs=0.2)
    np.testing.assert_allclose(longer.position(np.array([0.0]))[0], [-40.0, 0.0], atol=0.1)
    ends = longer.position(np.array([40.0, longer.length - 40.0]))
    np.testing.assert_allclose(ends, line.position(np.array([0.0, line.length])), atol=0.1)
    assert stretch(circle(30.0), 40.0).length == circle(30.0).length
