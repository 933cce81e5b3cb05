"""The sliding window: factors are zero at the truth, Jacobians are derivatives, marginalisation loses nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.kernels import linalg
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.scan_result import ScanEquations
from lslam.odometry.inertial.filter import BEGIN_SIGMA, STATE_SIZE, NavigationState
from lslam.odometry.inertial.gyroscope import USUAL_NOISE, Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.window import (
    EACH,
    SHARED,
    Moment,
    Window,
    add_random_walk,
    pose_error,
)

Floats = NDArray[np.float64]

RATE, DOWN = np.array([0.4, -0.3, 0.6]), np.array([0.0, 0.0, -GRAVITY])
SWING, AMPLITUDE = np.array([2.0, 1.5, 2.5]), np.array([1.0, 2.0, 0.3])
GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.005]), np.array([0.1, -0.2, 0.15])
T_IMU_SCAN = se3.make(so3.exp(np.array([0.1, 0.2, -0.3])), np.array([0.3, -0.1, 0.2]))
POINTS = np.diag([4e6, 4e6, 4e6, 1e8, 1e8, 1e8])


def true_pose(t: float) -> Floats:
    return se3.make(so3.exp(RATE * t), AMPLITUDE * np.sin(SWING * t))


def stream(seconds: float = 3.0) -> ImuStream:
    """What an IMU feels that swings and turns, known in closed form, with biases on it."""
    t = np.arange(0, seconds, 0.005)
    force = -AMPLITUDE * SWING**2 * np.sin(SWING * t[:, None]) - DOWN
    R = so3.exp(RATE * t[:, None])
    accel = np.einsum("nji,nj->ni", R, force) + ACCEL_BIAS
    return ImuStream(np.round(1e9 * t).astype(np.int64), accel, np.tile(RATE + GYRO_BIAS, (len(t), 1)))


def true_moment(k: int) -> Moment:
    """Ten a second, with equations that hold the scan at the truth."""
    t, ns = 0.1 * k, 100_000_000 * k
    T = true_pose(t)
    found = ScanEquations(ns, T @ T_IMU_SCAN, POINTS, np.zeros(6))
    velocity = AMPLITUDE * SWING * np.cos(SWING * t)
    return Moment(ns, ns, T, velocity, ACCEL_BIAS, GYRO_BIAS, T_IMU_SCAN, found)


def begun(moment: Moment, sigma: float = 0.1) -> Window:
    """A window whose gravity, velocity and biases are known to `sigma`."""
    covariance = np.diag(np.repeat([BEGIN_SIGMA, sigma, 1e-3], [6, 12, 9])) ** 2
    gyroscope = Gyroscope(moment.gyro_bias, covariance=covariance[15:, 15:])
    estimate = ImuEstimate(moment.velocity, DOWN, moment.accel_bias, gyroscope, covariance[6:15, 6:15])
    state = NavigationState(moment.T_world_imu, estimate, covariance)
    window = Window.begin(state, moment.instant_ns, moment.stamp_ns, moment.T_imu_scan)
    return window.with_equations({} if moment.equations is None else {moment.stamp_ns: moment.equations})


def true_window(count: int) -> Window:
    window = begun(true_moment(0))
    for k in range(1, count):
        window = window.extend(true_moment(k))
    return window


def disturbed(window: Window, seed: int = 3) -> Window:
    """Small errors everywhere, as after a prediction."""
    rng = np.random.default_rng(seed)
    size = SHARED + EACH * len(window.moments)
    d = rng.normal(0, 1, size) * 1e-3
    d[SHARED : SHARED + 6] = 0.0
    return window.retract(d)


def test_increments_agree_with_the_truth() -> None:
    window, imu = true_window(2), stream()
    rest, _ = window.residual(*window.moments, imu)
    # Readings are linear between samples: of a swing of 2.5 rad/s with 5 ms of them that is 1e-5 m/s2.
    np.testing.assert_allclose(rest, 0, atol=2e-5)
    off = replace(window.moments[0], accel_bias=ACCEL_BIAS + 0.1)
    assert np.abs(window.residual(off, window.moments[1], imu)[0]).max() > 5e-3


def test_jacobians_are_derivatives() -> None:
    imu, (a, b) = stream(), disturbed(true_window(2)).moments
    window = Window((a, b), DOWN, np.eye(3) + 0.01, 1e-6, USUAL_NOISE, true_window(1).past)
    _, J = window.residual(a, b, imu)
    numerical = np.zeros_like(J)
    step = 1e-6
    for i in range(J.shape[1]):
        d = np.zeros(J.shape[1])
        d[i] = step
        ends = []
        for sign in (1, -1):
            there = window.retract(sign * d)
            ends.append(there.residual(*there.moments, imu)[0])
        numerical[:, i] = (ends[0] - ends[1]) / (2 * step)
    turns, rates = slice(3, 6), np.r_[3:SHARED, SHARED + 12 : SHARED + 15]
    others = np.setdiff1d(np.arange(J.shape[1]), rates)
    np.testing.assert_allclose(J[:, others], numerical[:, others], atol=2e-3)
    # The rate is constant here, as the columns of the gyroscope's axes take it to be.
    np.testing.assert_allclose(J[turns][:, rates], numerical[turns][:, rates], atol=1e-3)
    # What an error of the rate does to the direction of forces within a step is left out.
    assert np.abs(numerical[6:9][:, rates]).max() < 0.1


def test_the_factor_of_a_scan_includes_the_lever_arm() -> None:
    window = replace(true_window(1), moments=(replace(true_moment(0), T_world_imu=true_pose(0.02)),))
    H, g = np.zeros((SHARED + EACH,) * 2), np.zeros(SHARED + EACH)
    window._add_scan(H, g, 0)
    moment = window.moments[0]
    assert moment.equations is not None

    def cost(d: Floats) -> float:
        e = pose_error(true_pose(0.0) @ T_IMU_SCAN, moment.retract(d).T_world_lidar)
        return float(0.5 * e @ POINTS @ e)

    steps = 1e-6 * np.eye(EACH)
    numerical = np.array([(cost(s) - cost(-s)) / 2e-6 for s in steps])
    np.testing.assert_allclose(g[SHARED:], numerical, rtol=0.02, atol=1e-3 * np.abs(numerical).max())


def test_a_walk_widens_the_covariance_of_what_walks_and_keeps_the_mean() -> None:
    rng = np.random.default_rng(2)
    J = rng.normal(size=(30, 8))
    H, g = J.T @ J, rng.normal(size=8)
    wider, gradient = add_random_walk(H, g, slice(0, 3), 0.5)
    expected = np.linalg.inv(H) + np.diag(np.repeat([0.5, 0.0], [3, 5]))
    np.testing.assert_allclose(np.linalg.inv(wider), expected, atol=1e-10)
    np.testing.assert_allclose(np.linalg.solve(wider, gradient), np.linalg.solve(H, g), atol=1e-10)


def test_a_marginalised_window_has_the_estimate_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """The batch of all moments, against one that marginalised half of them on the way, where gravity does not walk."""
    monkeypatch.setattr("lslam.odometry.inertial.window.GRAVITY_WALK", 1e-9)
    imu, batch = stream(), disturbed(true_window(8))
    whole, H = batch.solve(imu)
    slid = replace(batch, moments=batch.moments[:4])
    for k in range(4, 8):
        slid = slid.solve(imu)[0].without_first(imu).extend(batch.moments[k])
    part, H_part = slid.solve(imu)
    assert len(part.moments) == 4
    tail = np.r_[0:SHARED, len(H) - 4 * EACH : len(H)]
    sigma = np.sqrt(np.diag(linalg.inverse(H))[tail])
    off = np.concatenate([
        part.gravity - whole.gravity, (part.axes - whole.axes).ravel(),
        *(a.away(b) for a, b in zip(part.moments, whole.moments[4:], strict=True)),
    ])  # fmt: skip
    # Linearised earlier: a small part of what is known at all.
    assert np.abs(off / sigma).max() < 0.05
    np.testing.assert_allclose(np.sqrt(np.diag(linalg.inverse(H_part))), sigma, rtol=0.02)


def test_biases_and_velocity_are_found() -> None:
    imu, first = stream(), true_moment(0)
    wrong = replace(
        first, velocity=first.velocity + 0.2, accel_bias=np.zeros(3), gyro_bias=np.zeros(3), equations=first.equations
    )  # fmt: skip
    window = begun(wrong, 0.3)
    for k in range(1, 25):
        m = window.moments[-1]
        guess = replace(true_moment(k), velocity=m.velocity, accel_bias=m.accel_bias, gyro_bias=m.gyro_bias)
        window, H = window.extend(guess).solve(imu)
        if len(window.moments) > 5:
            window = window.without_first(imu)
    newest = window.moments[-1]
    np.testing.assert_allclose(newest.gyro_bias, GYRO_BIAS, atol=5e-4)
    np.testing.assert_allclose(newest.accel_bias, ACCEL_BIAS, atol=0.02)
    np.testing.assert_allclose(newest.velocity, true_velocity(2.4), atol=5e-3)
    assert abs(np.linalg.norm(window.gravity) - GRAVITY) < 0.03
    state = window.newest(H, NavigationState(np.eye(4), like(), np.zeros((STATE_SIZE, STATE_SIZE))))
    assert np.linalg.eigvalsh(state.covariance)[0] > 0
    np.testing.assert_array_equal(state.estimate.gyroscope.bias, newest.gyro_bias)


def true_velocity(t: float) -> Floats:
    return np.asarray(AMPLITUDE * SWING * np.cos(SWING * t))


def like() -> ImuEstimate:
    return ImuEstimate(np.zeros(3), DOWN, np.zeros(3), Gyroscope(np.zeros(3)), np.zeros((9, 9)))


def test_an_unsolvable_window_is_unchanged_and_has_no_covariance() -> None:
    window = begun(true_moment(0))
    window = replace(window, past=replace(window.past, information=-window.past.information))
    found, H = window.solve(stream())
    np.testing.assert_array_equal(found.moments[0].T_world_imu, window.moments[0].T_world_imu)
    newest = found.newest(H, NavigationState(np.eye(4), like(), np.zeros((STATE_SIZE, STATE_SIZE))))
    assert not np.isfinite(newest.covariance).all()
