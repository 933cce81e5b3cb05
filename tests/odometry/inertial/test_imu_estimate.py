"""The filter's model of how errors travel, against finite differences of the integration itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lslam.core.geometry import so3
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate, _propagate

GRAVITY = 9.80665
# m/s2 per sqrt(Hz) that shaking adds, and m that a registration is right to at the best.
FORCE_NOISE, PLACE_SIGMA = 0.05, 0.007


@pytest.mark.parametrize("direction", range(9))
def test_covariance_propagation_equals_finite_differences_of_the_integration(direction: int) -> None:
    """Velocity, gravity, accelerometer bias: displacement and velocity after a turn of 0.3 s change by the same column."""
    stamps = np.arange(0, 300_000_001, 10_000_000)
    rng = np.random.default_rng(5)
    imu = ImuStream(stamps, rng.normal(0, 4, (31, 3)), rng.normal(1.0, 0.3, (31, 3)))
    R = so3.exp(np.array([0.3, -0.5, 1.1]))
    nothing = np.zeros((9, 9))
    state = ImuEstimate(
        np.array([3.0, -1, 0.2]), np.array([0.1, 0.2, -9.8]), np.zeros(3), Gyroscope(np.zeros(3)), nothing
    )
    error = np.zeros(9)
    error[direction] = 0.1
    wrong = dataclasses.replace(
        state, velocity=state.velocity + error[:3], gravity=state.gravity + error[3:6], accel_bias=error[6:]
    )
    doubtful = dataclasses.replace(state, covariance=np.outer(error, error))
    ends = stamps[[0, -1]]
    x, P = _propagate(state, state.over(imu, ends), R)
    x_wrong, _ = _propagate(wrong, wrong.over(imu, ends), R)
    _, P_doubtful = _propagate(doubtful, doubtful.over(imu, ends), R)
    moved = x_wrong - x
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(P_doubtful - P, np.outer(moved, moved), atol=1e-9)


@pytest.mark.parametrize("sigmas", [None, (0.1, 0.2, 0.3)])
def test_a_displacement_updates_the_velocity_as_a_scalar_kalman_filter(
    sigmas: tuple[float, float, float] | None,
) -> None:
    """A step of `t` seconds at an unknown velocity: the scalar Kalman filter of displacement and velocity, axis by axis."""
    t = 0.3
    stamps = np.arange(0, 300_000_001, 10_000_000)
    imu = ImuStream(stamps, np.tile([0.0, 0.0, GRAVITY], (31, 1)), np.zeros((31, 3)))
    covariance = np.diag([1e4] * 3 + [0.0] * 6)
    before = ImuEstimate(np.zeros(3), np.array([0, 0, -GRAVITY]), np.zeros(3), Gyroscope(np.zeros(3)), covariance)
    moved = np.array([3.0, -0.6, 0.3])
    noise = None if sigmas is None else np.diag(np.square(sigmas))
    step = before.over(imu, stamps[[0, -1]])
    after = before.correct(imu, step, np.eye(3), np.eye(3), moved, before.gyroscope, noise)
    places = 2 * (PLACE_SIGMA**2 + np.square(np.zeros(3) if sigmas is None else sigmas))
    shared = 1e4 * t + FORCE_NOISE**2 * t**2 / 2
    gain = shared / (1e4 * t**2 + FORCE_NOISE**2 * t**3 / 3 + places)
    np.testing.assert_allclose(np.diag(after.covariance)[:3], 1e4 + FORCE_NOISE**2 * t - gain * shared, rtol=1e-6)
    np.testing.assert_allclose(after.velocity, gain * moved, rtol=1e-6)


def test_instants_within_a_step_do_not_change_the_update() -> None:
    """Where the turn ends is its last instant, however many lie between."""
    stamps = np.arange(0, 300_000_001, 10_000_000)
    rng = np.random.default_rng(2)
    imu = ImuStream(stamps, rng.normal(0, 4, (31, 3)), rng.normal(1.0, 0.3, (31, 3)))
    before = ImuEstimate(
        np.array([3.0, -1, 0.2]),
        np.array([0, 0, -GRAVITY]),
        np.zeros(3),
        Gyroscope.of_bias(np.zeros(3), 0.1),
        np.eye(9),
    )
    R = so3.exp(np.array([0.3, -0.5, 1.1]))
    found, taught = [], []
    for instants in (stamps[[0, -1]], stamps[[0, 10, 15, -1]]):
        step = before.over(imu, instants)
        R_end = R @ step.rotations[-1] @ so3.exp(np.array([0.02, -0.01, 0.03]))
        taught.append(before.calibrate(step, R, R_end))
        found.append(before.correct(imu, step, R, R_end, np.array([1.0, 0.2, -0.1]), before.gyroscope))
    whole, parted = found
    for name in ("velocity", "gravity", "accel_bias", "covariance"):
        np.testing.assert_allclose(getattr(parted, name), getattr(whole, name), atol=1e-9)
    assert np.linalg.norm(whole.velocity - before.velocity) > 0.1
    for name in ("bias", "axes", "covariance", "rate_variance"):
        np.testing.assert_allclose(getattr(taught[1], name), getattr(taught[0], name), atol=1e-12)
