"""Integration against the exact motion of a simulated walk and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from imu_drives import walk

from lslam.core.geometry import so3
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.integrate import integrate

DOWN = np.array([0.0, 0.0, -9.80665])
NONE = np.zeros(3)


@pytest.mark.parametrize("anchor", [0, 5, 10])
def test_integration_of_an_ideal_imu_is_the_true_path(anchor: int) -> None:
    """From any of the instants, forwards and backwards: half a second of a walker's swing, to a millimetre."""
    drive = walk("ideal")
    assert drive.imu is not None
    assert drive.readings.imu is not None
    truth = drive.readings.imu.truth
    for first in range(0, 400, 50):
        rows = np.arange(first, first + 51, 5)
        step = integrate(drive.imu, drive.imu.stamps_ns[rows], NONE, NONE)
        k = rows[anchor]
        R, v, p = step.motion(anchor, truth.poses[k, :3, :3], truth.velocity[k], DOWN)
        assert so3.angle(np.swapaxes(R, -1, -2) @ truth.poses[rows, :3, :3]).max() < 2e-4
        assert np.abs(v - truth.velocity[rows]).max() < 5e-3
        moved = truth.poses[rows, :3, 3] - truth.poses[k, :3, 3]
        assert np.abs(p - moved).max() < 2e-3
        assert np.linalg.norm(p - moved, axis=1).max() < 0.01 * np.linalg.norm(moved, axis=1).max()


def test_instants_between_samples_change_nothing() -> None:
    """More instants, none of them on a sample, and the same end."""
    drive = walk("ideal")
    assert drive.imu is not None
    lo, hi = 1_003_333_333, 1_203_123_457
    few = integrate(drive.imu, np.array([lo, hi]), NONE, NONE)
    many = integrate(drive.imu, np.linspace(lo, hi, 77).astype(np.int64), NONE, NONE)
    assert so3.angle(few.rotations[-1].T @ many.rotations[-1]) < 1e-5
    np.testing.assert_allclose(few.positions[-1], many.positions[-1], atol=5e-5)


def test_biases_and_arms_are_what_a_constant_error_adds() -> None:
    stamps = np.arange(0, 500_000_001, 10_000_000)
    rng = np.random.default_rng(1)
    imu = ImuStream(stamps, rng.normal(0, 3, (51, 3)), rng.normal(0, 1, (51, 3)))
    bias = np.array([0.3, -0.2, 0.1])
    without, with_bias = (integrate(imu, stamps[[0, -1]], NONE, b) for b in (NONE, bias))
    np.testing.assert_allclose(
        with_bias.positions[-1], without.positions[-1] - without.position_arms[-1] @ bias, atol=1e-9
    )
    np.testing.assert_allclose(
        with_bias.velocities[-1], without.velocities[-1] - without.velocity_arms[-1] @ bias, atol=1e-9
    )
    steady = ImuStream(stamps, np.zeros((51, 3)), np.tile([0.2, -0.4, 0.9], (51, 1)))
    turned = integrate(steady, stamps[[0, -1]], np.array([0.0, 0.0, 0.4]), NONE).rotations[-1]
    np.testing.assert_allclose(turned, so3.exp(np.array([0.1, -0.2, 0.25])), atol=1e-12)


def test_one_instant_is_no_motion() -> None:
    imu = ImuStream(np.array([0, 10]), np.ones((2, 3)), np.ones((2, 3)))
    step = integrate(imu, np.array([5]), NONE, NONE)
    R, v, p = step.motion(0, np.eye(3), np.ones(3), DOWN)
    assert (np.eye(3) == R).all()
    assert (v == 1).all()
    assert (p == 0).all()
