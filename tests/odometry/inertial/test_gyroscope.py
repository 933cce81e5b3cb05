"""A gyroscope with misaligned axes: estimation of axes and bias by rotations, and the covariance of both."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.integrate import Increments, integrate
from lslam.odometry.kernels import kalman

Floats = NDArray[np.float64]

# rad/s per sqrt(Hz) of the best device that is thought of, and rad/s per sqrt(s) that Kalibr has of an ADIS16448's bias.
RATE_NOISE, BIAS_WALK = np.deg2rad(0.01), np.deg2rad(0.001)
BIAS = np.array([0.08, -0.05, 0.03])
SKEW = np.eye(3) + np.array([[0.01, -0.02, 0.015], [0.02, -0.01, 0.02], [-0.015, 0.02, 0.005]])
STEP_NS, SAMPLE_NS = 200_000_000, 5_000_000


def readings_of(rates: Floats) -> Floats:
    return np.asarray(np.linalg.solve(SKEW, rates.T).T + BIAS)


def tumbling(count: int, seed: int = 0) -> Floats:
    """(count, 3) rad/s of a body that turns about changing axes, one per sample."""
    t = np.arange(count) * SAMPLE_NS * 1e-9
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    return np.asarray(np.sin(np.outer(t, [0.9, 1.3, 0.7]) + phase) * [0.5, 0.4, 0.8])


def stream(readings: Floats) -> ImuStream:
    return ImuStream(np.arange(len(readings)) * SAMPLE_NS, np.zeros_like(readings), readings)


def turns(imu: ImuStream, gyroscope: Gyroscope, steps: int) -> list[Increments]:
    return [
        integrate(imu, np.array([k, k + 1]) * STEP_NS, gyroscope.bias, np.zeros(3), gyroscope.axes)
        for k in range(steps)
    ]


def taught(noise_of_rates: float, steps: int = 150, seen_to: float = 1e-4) -> tuple[Gyroscope, ImuStream, ImuStream]:
    """What registrations that are right to `seen_to` rad teach; the stream as read, and the true one."""
    rng = np.random.default_rng(3)
    rates = tumbling(steps * STEP_NS // SAMPLE_NS + 1)
    true = stream(rates)
    per_sample = noise_of_rates / np.sqrt(SAMPLE_NS * 1e-9)
    read = stream(readings_of(rates) + rng.normal(0, per_sample, rates.shape))
    perfect = Gyroscope(np.zeros(3))
    gyroscope = Gyroscope.of_bias(np.zeros(3), 0.1)
    for k, truth in enumerate(turns(true, perfect, steps)):
        step = integrate(read, np.array([k, k + 1]) * STEP_NS, gyroscope.bias, np.zeros(3), gyroscope.axes)
        seen = truth.rotations[-1] @ so3.exp(rng.normal(0, seen_to, 3))
        rest = np.asarray(so3.log(step.rotations[-1].T @ seen))
        gyroscope = gyroscope.learn(step, rest, seen_to**2 * np.eye(3))
    return gyroscope, read, true


def test_axes_and_bias_are_estimated_while_the_sensor_rotates() -> None:
    gyroscope, read, true = taught(RATE_NOISE)
    np.testing.assert_allclose(gyroscope.axes, SKEW, atol=4e-3)
    np.testing.assert_allclose(gyroscope.bias, BIAS, atol=2e-3)
    np.testing.assert_allclose(gyroscope.rates(readings_of(true.gyro)), true.gyro, atol=5e-3)
    before = Gyroscope.of_bias(BIAS, 2e-3)
    off = [
        [
            float(so3.angle(a.rotations[-1].T @ b.rotations[-1]))
            for a, b in zip(turns(read, g, 150), turns(true, Gyroscope(np.zeros(3)), 150), strict=True)
        ]
        for g in (before, gyroscope)
    ]
    assert np.median(off[1]) < 0.3 * np.median(off[0])


@pytest.mark.parametrize("noise", [RATE_NOISE, 6 * RATE_NOISE])
def test_rotations_are_within_their_covariance(noise: float) -> None:
    gyroscope, read, true = taught(noise)
    perfect = Gyroscope(np.zeros(3))
    ratios = []
    for step, truth in zip(turns(read, gyroscope, 150), turns(true, perfect, 150), strict=True):
        rest = np.asarray(so3.log(step.rotations[-1].T @ truth.rotations[-1]))
        ratios.append(float(rest @ np.linalg.solve(gyroscope.turn_covariance(step), rest)) / 3)
    assert 0.4 < np.mean(ratios) < 1.6
    assert gyroscope.rate_variance >= RATE_NOISE**2


def test_the_covariance_of_a_rotation_equals_its_finite_differences() -> None:
    """Each of bias and axes, against the turn integrated with that error; its rates are nearly constant over a step."""
    read = stream(readings_of(tumbling(41)))
    gyroscope = Gyroscope(BIAS, SKEW)
    step = turns(read, gyroscope, 1)[0]
    for k in range(12):
        error = np.zeros(12)
        error[k] = 1e-3
        wrong = dataclasses.replace(gyroscope, bias=BIAS + error[:3], axes=SKEW + error[3:].reshape(3, 3))
        moved = np.asarray(so3.log(step.rotations[-1].T @ turns(read, wrong, 1)[0].rotations[-1]))
        doubtful = dataclasses.replace(gyroscope, covariance=np.outer(error, error), rate_variance=0.0)
        np.testing.assert_allclose(
            doubtful.turn_covariance(step), np.outer(moved, moved), atol=0.05 * float(moved @ moved) + 1e-13
        )


def test_a_rotation_without_information_changes_nothing() -> None:
    gyroscope, read, _ = taught(RATE_NOISE, steps=20)
    step = turns(read, gyroscope, 1)[0]
    again = gyroscope.learn(step, np.array([0.01, 0.0, -0.01]), 1e6 * np.eye(3))
    np.testing.assert_allclose(again.axes, gyroscope.axes, atol=1e-8)
    np.testing.assert_allclose(again.bias, gyroscope.bias, atol=1e-8)


def test_without_information_the_bias_walks_and_the_axes_do_not() -> None:
    still = integrate(stream(np.zeros((41, 3))), np.array([0, STEP_NS]), np.zeros(3), np.zeros(3))
    gyroscope = Gyroscope(np.zeros(3))
    for _ in range(3):
        gyroscope = gyroscope.learn(still, np.zeros(3), 1e6 * np.eye(3))
    expected = np.diag(np.repeat([BIAS_WALK**2 * 3 * 0.2, 0.0], [3, 9]))
    np.testing.assert_allclose(gyroscope.covariance, expected, rtol=1e-6, atol=1e-18)


def test_an_outlier_rotation_has_a_bounded_effect_on_the_rate_variance() -> None:
    still = integrate(stream(np.zeros((41, 3))), np.array([0, STEP_NS]), np.zeros(3), np.zeros(3))
    found = [Gyroscope(np.zeros(3)).learn(still, np.array([turn, 0, 0]), 1e-8 * np.eye(3)) for turn in (0.1, 2.0)]
    assert RATE_NOISE**2 < found[0].rate_variance == found[1].rate_variance


def test_an_update_agrees_with_the_sum_of_informations() -> None:
    rng = np.random.default_rng(4)
    A, B = rng.normal(size=(5, 5)), rng.normal(size=(2, 2))
    P, noise, H, x = A @ A.T, B @ B.T, rng.normal(size=(2, 5)), rng.normal(size=5)
    rest = 0.5 * np.sqrt(np.diag(noise))
    mean, covariance = kalman.update(x, P, H, rest, noise, RARE_SIGMAS)
    information = np.linalg.inv(P) + H.T @ np.linalg.solve(noise, H)
    np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=1e-8, atol=1e-10)
    gain = np.linalg.solve(information, H.T @ np.linalg.solve(noise, rest))
    np.testing.assert_allclose(mean - x, gain, rtol=1e-8, atol=1e-10)


def test_an_outlier_moves_the_mean_less_than_what_is_likely() -> None:
    x, P, H, noise = np.zeros(1), np.eye(1), np.eye(1), np.eye(1)
    likely = kalman.update(x, P, H, np.array([4.0]), noise, RARE_SIGMAS)[0]
    outlier = kalman.update(x, P, H, np.array([400.0]), noise, RARE_SIGMAS)[0]
    assert 0 < outlier[0] < likely[0]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_bias_does_not_follow_the_noise_of_registration_over_many_steps(seed: int) -> None:
    """A minute against registrations wrong by a tenth of a degree: a bias that may wander fast follows their noise."""
    rng = np.random.default_rng(seed)
    read = stream(np.tile(BIAS, (int(60e9 / SAMPLE_NS) + 1, 1)))
    gyroscope, seen_to, errors = Gyroscope.of_bias(BIAS, 2e-4), np.deg2rad(0.1), []
    for step in turns(read, Gyroscope(BIAS), 300):
        errors.append(gyroscope.bias - BIAS)
        off = (gyroscope.bias - BIAS) * step.seconds[-1]
        gyroscope = gyroscope.learn(step, rng.normal(0, seen_to, 3) + off, seen_to**2 * np.eye(3))
    assert np.sqrt(np.mean(np.square(errors))) < np.deg2rad(0.01)


def test_the_covariance_of_the_axes_follows_a_bias_of_another_estimate() -> None:
    """A steady turn tells of bias and scale together: who knows the one knows the other, and the turn as well as before."""
    turning = ImuStream(np.arange(11) * 10_000_000, np.zeros((11, 3)), np.tile([0.0, 0.0, 2.0], (11, 1)))
    step = integrate(turning, np.array([0, 100_000_000]), np.zeros(3), np.zeros(3))
    prior = Gyroscope.of_bias(np.zeros(3), 0.01)
    learnt = prior
    for _ in range(20):
        learnt = learnt.learn(step, np.zeros(3), 1e-10 * np.eye(3))
    sure = learnt.with_bias(np.array([0.0, 0.0, 0.004]), 1e-8 * np.eye(3))
    np.testing.assert_allclose(sure.covariance[:3, :3], 1e-8 * np.eye(3), atol=1e-12)
    assert np.linalg.eigvalsh(sure.covariance)[0] > 0
    assert sure.covariance[11, 11] < 0.1 * learnt.covariance[11, 11]
    assert sure.turn_covariance(step)[2, 2] < 1.1 * learnt.turn_covariance(step)[2, 2]
    reading = np.array([0.0, 0.0, 2.0])
    np.testing.assert_allclose(sure.rates(reading), learnt.rates(reading), atol=1e-4)
    same = learnt.with_bias(learnt.bias, learnt.covariance[:3, :3])
    np.testing.assert_allclose(same.covariance, learnt.covariance, atol=1e-15)
    np.testing.assert_array_equal(same.axes, learnt.axes)
