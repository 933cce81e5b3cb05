"""Derivatives against difference quotients and closed forms; the path met; the standing start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.simulation.kinematics import Kinematics, Motion, smooth_motion, standing_start
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]

T_ARM = se3.make(so3.from_euler_rpy(np.array([0.3, -0.5, 1.1])), np.array([0.7, -1.3, 0.4]))


@dataclass(frozen=True)
class Screw:
    """A drone that tumbles at constant rate about a fixed axis while it circles: everything has a closed form."""

    duration: float = 20.0
    radius: float = 8.0
    pace: float = 0.6
    spin: tuple[float, float, float] = (0.4, -1.1, 2.0)

    def poses(self, times: NDArray[Any]) -> Floats:
        a = self.pace * np.asarray(times)
        p = np.column_stack([self.radius * np.cos(a), self.radius * np.sin(a), 0.5 * np.asarray(times)])
        return se3.make(so3.exp(np.asarray(times)[:, None] * np.array(self.spin)), p)


@pytest.fixture(scope="module")
def street() -> Motion:
    """A drive on uneven ground, shaking on its suspension."""
    return simulate("street", seed=3, count=1).vehicle


def numeric(motion: Motion, t: Floats, T_body_sensor: Floats, h: float = 1e-4) -> Kinematics:
    """Velocities, accelerations and rates of a sensor from differences of poses alone."""
    before, now, after = (motion.poses(t + k * h) @ T_body_sensor for k in (-1, 0, 1))
    turn = [so3.log(se3.relative(a, b)[:, :3, :3]) / h for a, b in ((before, now), (now, after))]
    p0, p1, p2 = (T[:, :3, 3] for T in (before, now, after))
    return Kinematics(
        now, (p2 - p0) / (2 * h), (p0 - 2 * p1 + p2) / h**2, (turn[0] + turn[1]) / 2, np.diff(turn, axis=0)[0] / h
    )


def test_closed_form_of_a_tumbling_flight() -> None:
    path = Screw()
    motion = smooth_motion(path)
    t = np.linspace(0.5, 19.5, 300)
    a, w = path.pace * t, np.array(path.spin)
    k = motion.at(t)
    np.testing.assert_allclose(k.poses, path.poses(t), atol=1e-8)
    outward = np.column_stack([np.cos(a), np.sin(a), 0 * a])
    np.testing.assert_allclose(k.acceleration, -path.radius * path.pace**2 * outward, atol=1e-5)
    np.testing.assert_allclose(k.rate, np.tile(w, (300, 1)), atol=1e-7)
    np.testing.assert_allclose(k.rate_change, 0, atol=1e-4)
    # A lever arm on a body that spins evenly is pulled towards the axis.
    arm = T_ARM[:3, 3]
    pull = np.einsum("nij,j->ni", k.poses[:, :3, :3], np.cross(w, np.cross(w, arm)))
    np.testing.assert_allclose(k.at_sensor(T_ARM).acceleration - k.acceleration, pull, atol=1e-3)
    np.testing.assert_allclose(k.at_sensor(T_ARM).rate, np.tile(w @ T_ARM[:3, :3], (300, 1)), atol=1e-7)


@pytest.mark.parametrize("T_body_sensor", [np.eye(4), T_ARM], ids=["lidar", "with a lever arm"])
def test_kinematics_are_the_derivatives_of_the_poses(street: Motion, T_body_sensor: Floats) -> None:
    t = np.linspace(0.1, street.duration - 0.1, 500)
    exact, differences = street.at(t).at_sensor(T_body_sensor), numeric(street, t, T_body_sensor)
    np.testing.assert_allclose(exact.poses, differences.poses, atol=1e-12)
    np.testing.assert_allclose(exact.velocity, differences.velocity, atol=1e-6)
    np.testing.assert_allclose(exact.acceleration, differences.acceleration, atol=1e-4)
    np.testing.assert_allclose(exact.rate, differences.rate, atol=1e-6)
    np.testing.assert_allclose(exact.rate_change, differences.rate_change, atol=1e-4)
    assert np.abs(exact.acceleration).max() > 0.5
    assert np.abs(exact.rate).max() > 0.02


def test_motion_is_four_times_continuously_differentiable(street: Motion) -> None:
    """Across a knot no derivative up to the fourth jumps; the fifth does."""
    at, eps = 5.0, 1e-10
    for spline in (street.position, street.quaternion):
        for order in range(6):
            jump = np.abs(spline(at + eps, nu=order) - spline(at - eps, nu=order)).max()
            size = np.abs(spline(np.linspace(4.5, 5.5, 200), nu=order)).max()
            assert (jump < 1e-4 * size) == (order < 5), (order, jump, size)


def test_motion_meets_the_path_at_scans_and_nearly_between() -> None:
    path = Screw()
    motion = smooth_motion(path)
    scans = np.arange(0, 20, 0.1)
    np.testing.assert_allclose(motion.poses(scans), path.poses(scans), atol=1e-12)
    for at in (0.0, path.duration):
        np.testing.assert_allclose(motion.poses(np.array([at])), path.poses(np.array([at])), atol=1e-12)


@pytest.mark.parametrize("duration", [0.31, 1.0, 2.003, 2.019, 9.9999999])
def test_any_duration_works_to_its_end(duration: float) -> None:
    path = Screw(duration)
    motion = smooth_motion(path)
    t = np.linspace(0, duration, 400)
    np.testing.assert_allclose(motion.poses(t), path.poses(t), atol=1e-6)


def test_outside_its_time_there_is_no_motion(street: Motion) -> None:
    for time in (-0.01, street.duration + 0.01, float("nan")):
        with pytest.raises(ValueError, match="leave the motion"):
            street.poses(np.array([time]))


def test_standing_start_stands_then_moves_off_gently() -> None:
    moving = Screw()
    path = standing_start(moving, 4.0)
    motion = smooth_motion(path)
    still = motion.at(np.arange(0, 3.9, 0.01))
    np.testing.assert_allclose(still.poses, np.broadcast_to(moving.poses(np.zeros(1)), still.poses.shape), atol=1e-9)
    for standing in (still.velocity, still.acceleration, still.rate, still.rate_change):
        assert np.abs(standing).max() < 1e-4
    t = np.arange(0, path.duration, 0.01)
    speed = np.linalg.norm(motion.at(t).velocity, axis=1)
    cruise = np.hypot(moving.radius * moving.pace, 0.5)
    assert np.diff(speed).max() / 0.01 < 2.01
    np.testing.assert_allclose(speed[t > 4.0 + path.ramp], cruise, rtol=1e-6)
    # It ends where the path ends, as long after as the standing and half of the ramp took.
    np.testing.assert_allclose(
        motion.poses(np.array([path.duration])), moving.poses(np.array([moving.duration])), atol=1e-9
    )
    assert path.duration == pytest.approx(24.0 + path.ramp / 2)
