"""The filter's states: covariance propagation by finite differences, and a pose update by conditioning a Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.filter import (
    DOWN,
    FORCE,
    GYRO,
    PLACE,
    POSE,
    SPEED,
    STATE_SIZE,
    TURN,
    NavigationState,
)
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate

Floats = NDArray[np.float64]
STAMPS = np.arange(0, 100_000_001, 10_000_000)
ENDS = STAMPS[[0, -1]]


def stream() -> ImuStream:
    rng = np.random.default_rng(5)
    return ImuStream(STAMPS, rng.normal(0, 2, (11, 3)) + np.array([0, 0, 9.8]), rng.normal(0.5, 0.1, (11, 3)))


def state(covariance: Floats) -> NavigationState:
    T = se3.make(so3.exp(np.array([0.3, -0.5, 1.1])), np.array([4.0, 5.0, 6.0]))
    gyroscope = Gyroscope(np.array([0.01, -0.02, 0.005]), np.eye(3) + 0.01)
    estimate = ImuEstimate(
        np.array([3.0, -1, 0.2]), np.array([0.1, 0.2, -9.8]), np.array([0.1, 0, 0.2]), gyroscope, np.zeros((9, 9))
    )
    return NavigationState(T, estimate, covariance)


def disturbed(known: NavigationState, x: Floats) -> NavigationState:
    e = known.estimate
    T = se3.make(so3.exp(x[TURN]) @ known.T_world_imu[:3, :3], known.T_world_imu[:3, 3] + x[PLACE])
    gyroscope = replace(
        e.gyroscope, bias=e.gyroscope.bias + x[GYRO][:3], axes=e.gyroscope.axes + x[GYRO][3:].reshape(3, 3)
    )
    estimate = replace(
        e, velocity=e.velocity + x[SPEED], gravity=e.gravity + x[DOWN], accel_bias=e.accel_bias + x[FORCE],
        gyroscope=gyroscope,
    )  # fmt: skip
    return NavigationState(T, estimate, known.covariance)


def difference(a: NavigationState, b: NavigationState) -> Floats:
    x = np.zeros(STATE_SIZE)
    x[PLACE] = b.T_world_imu[:3, 3] - a.T_world_imu[:3, 3]
    x[TURN] = so3.log(b.T_world_imu[:3, :3] @ a.T_world_imu[:3, :3].T)
    for part, name in ((SPEED, "velocity"), (DOWN, "gravity"), (FORCE, "accel_bias")):
        x[part] = getattr(b.estimate, name) - getattr(a.estimate, name)
    one, other = a.estimate.gyroscope, b.estimate.gyroscope
    x[GYRO] = np.concatenate([other.bias - one.bias, (other.axes - one.axes).ravel()])
    return x


def ahead(known: NavigationState, imu: ImuStream) -> NavigationState:
    return known.propagate(known.estimate.over(imu, ENDS))


@pytest.mark.parametrize("direction", range(STATE_SIZE))
def test_covariance_propagation_equals_finite_differences_of_the_integration(direction: int) -> None:
    imu, x = stream(), 1e-4 * np.eye(STATE_SIZE)[direction]
    nothing = np.zeros((STATE_SIZE, STATE_SIZE))
    moved = difference(ahead(state(nothing), imu), ahead(disturbed(state(nothing), x), imu))
    added = ahead(state(np.outer(x, x)), imu).covariance - ahead(state(nothing), imu).covariance
    kept = np.arange(STATE_SIZE)
    if direction >= GYRO.start:
        # What an error of the rate does to the directions of forces within a step is left out: 4e-5 m/s for 1 mrad/s.
        assert np.abs(moved[SPEED]).max() < 0.06 * 1e-4
        kept = np.r_[TURN, GYRO]
    # The rate is taken as constant for the axes.
    np.testing.assert_allclose(added[np.ix_(kept, kept)], np.outer(moved[kept], moved[kept]), atol=2e-11)


def test_process_noise_alone_increases_the_covariance() -> None:
    grown = ahead(state(np.zeros((STATE_SIZE, STATE_SIZE))), stream()).covariance
    assert (np.diag(grown)[: GYRO.start + 3] > 0).all()
    assert (np.diag(grown)[GYRO.start + 3 :] == 0).all(), "axes of a device do not wander"
    np.testing.assert_array_equal(grown, grown.T)


def test_a_pose_update_is_conditioning_of_the_joint_gaussian() -> None:
    """Against the information form: the pose's own estimate replaces its prior, the rest follows."""
    rng = np.random.default_rng(7)
    root = rng.normal(size=(STATE_SIZE, STATE_SIZE)) * 1e-3
    root[DOWN] *= 1e-3  # gravity is known, so that its length teaches nothing more
    known = state(root @ root.T + 1e-12 * np.eye(STATE_SIZE))
    P = known.covariance
    points = np.diag([1e7, 1e6, 1e7, 1e8, 1e8, 1e7])
    information = np.linalg.inv(P)
    information[POSE, POSE] += points
    seen = rng.normal(0, 1e-3, 6)
    expected_P = np.linalg.inv(information)
    expected = expected_P[:, POSE] @ points @ seen
    T = se3.make(so3.exp(expected[TURN]) @ known.T_world_imu[:3, :3], known.T_world_imu[:3, 3] + expected[PLACE])
    found = known.moved_to(T, expected_P[POSE, POSE])
    np.testing.assert_array_equal(found.T_world_imu, T)
    x = difference(known, found)
    np.testing.assert_allclose(x, expected, atol=1e-7)
    np.testing.assert_allclose(found.covariance[SPEED, SPEED], expected_P[SPEED, SPEED], rtol=1e-3, atol=1e-12)
    np.testing.assert_array_equal(found.estimate.covariance, found.covariance[6:15, 6:15])
    np.testing.assert_array_equal(found.estimate.gyroscope.covariance, found.covariance[GYRO, GYRO])
