"""The motion prior of a method without an IMU."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.core.types.scan_result import MOST_ACCELERATION_M_S2
from lslam.odometry.inertial.constant_velocity import ConstantVelocity

TENTH = 100_000_000
# Stamps at the start of the sweep, in its middle, a quarter over and at its end.
SPANS = [Span(begin, begin + 0.1) for begin in (0.0, -0.05, -0.025, -0.1)]
TWIST = np.array([1.2, 0.1, -0.05, 0.01, -0.02, 0.2])


def poses(n: int) -> NDArray[np.float64]:
    start = se3.exp(np.array([5.0, -3.0, 1.0, 0.3, -0.2, 2.0]))
    return np.stack([start @ se3.exp(k * TWIST) for k in range(n)])


def test_without_history_nothing_moves() -> None:
    motion = ConstantVelocity()
    np.testing.assert_array_equal(motion.predict(5), np.eye(4))
    T = poses(1)[0]
    motion.correct(5, T)
    np.testing.assert_array_equal(motion.predict(10 * TENTH), T)


def test_a_screw_motion_is_predicted_exactly() -> None:
    motion = ConstantVelocity()
    T = poses(6)
    for k in range(5):
        motion.correct(k * TENTH, T[k])
    np.testing.assert_allclose(motion.predict(5 * TENTH), T[5], atol=1e-9)


def test_the_step_follows_the_time_between_scans() -> None:
    motion = ConstantVelocity()
    T = poses(8)
    motion.correct(0, T[0])
    motion.correct(TENTH, T[1])
    for gap in (0, 1, 3):
        np.testing.assert_allclose(motion.predict((1 + gap) * TENTH), T[1 + gap], atol=1e-9)
    half = T[1] @ se3.exp(0.5 * TWIST)
    np.testing.assert_allclose(motion.predict(TENTH + TENTH // 2), half, atol=1e-9)


def test_a_long_pause_is_not_stretched_beyond_reason() -> None:
    motion = ConstantVelocity()
    T = poses(2)
    motion.correct(0, T[0])
    motion.correct(TENTH, T[1])
    np.testing.assert_allclose(motion.predict(1000 * TENTH), T[1] @ se3.exp(5.0 * TWIST), atol=1e-9)
    np.testing.assert_allclose(motion.predict(-1000 * TENTH), T[1], atol=1e-9)


def test_equal_or_backward_stamps_keep_the_last_velocity() -> None:
    motion = ConstantVelocity()
    T = poses(4)
    motion.correct(0, T[0])
    motion.correct(TENTH, T[1])
    motion.correct(TENTH, T[2])
    np.testing.assert_allclose(motion.predict(2 * TENTH), T[3], atol=1e-9)


def test_predictions_are_rotations_after_thousands_of_steps() -> None:
    motion = ConstantVelocity()
    T = np.eye(4)
    for k in range(3000):
        motion.correct(k * TENTH, T)
        T = motion.predict((k + 1) * TENTH) if k else se3.exp(TWIST)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)


def drive(motion: ConstantVelocity, twist: NDArray[np.float64], scans: int, span: Span) -> NDArray[np.float64]:
    """Register `scans` sweeps of 0.1 s that all move by `twist`, perfectly; returns the true poses, one more than scans."""
    poses = np.stack([se3.exp(k * twist) for k in range(scans + 1)])
    for k in range(scans):
        motion.correct(k * TENTH, poses[k], motion.sweep(k * TENTH, span))
    return poses


@pytest.mark.parametrize("span", SPANS)
def test_a_sweep_moves_as_the_sensor_did(span: Span) -> None:
    motion = ConstantVelocity()
    assert len(motion.sweep(0, span).times) == 1, "the first speed is unknown"
    poses = drive(motion, TWIST, 4, span)
    sweep = motion.sweep(4 * TENTH, span)
    # The first sweep could not be deskewed, later ones measure from middle to middle.
    np.testing.assert_allclose(sweep.pose, poses[4], atol=1e-5)
    np.testing.assert_allclose(sweep.poses[0], poses[4] @ se3.exp(10 * span.begin_s * TWIST), atol=1e-5)
    np.testing.assert_allclose(se3.relative(sweep.poses[0], sweep.poses[-1]), se3.exp(TWIST), atol=1e-6)
    assert len(motion.sweep(4 * TENTH, Span()).times) == 1, "compensated scans have one instant"


@pytest.mark.parametrize("span", SPANS)
def test_refining_estimates_the_velocity_from_the_middle_of_the_sweep(span: Span) -> None:
    """The prior is 20 % too slow; registration puts the middle of the sweep right, as it does for a skewed cloud."""
    motion = ConstantVelocity()
    poses = drive(motion, TWIST, 4, span)
    right = motion.sweep(4 * TENTH, span)
    middle = poses[4] @ se3.exp((0.5 - span.stamp_share) * TWIST)
    slow = middle @ se3.exp(np.linspace(-0.4, 0.4, len(right.times))[:, None] * TWIST)
    prior = MotionPrior(right.times, slow)
    better = motion.refine(prior, 4 * TENTH, prior.pose)
    np.testing.assert_allclose(better.poses, right.poses, atol=1e-6)
    single = MotionPrior.at_once(poses[4])
    assert motion.refine(single, 4 * TENTH, poses[4]) is single


@pytest.mark.parametrize("span", SPANS)
def test_the_first_sweep_has_no_motion_to_refine(span: Span) -> None:
    """Nothing was registered before it: what it was given stays, wherever it is found."""
    twists = np.linspace(-0.4, 0.4, 5)[:, None] * TWIST
    prior = MotionPrior(np.linspace(span.begin_s, span.begin_s + 0.1, 5), poses(3)[2] @ se3.exp(twists))
    assert ConstantVelocity().refine(prior, TENTH, poses(4)[3]) is prior


def test_a_velocity_change_is_accepted_when_it_persists() -> None:
    """At 30 m/s, one scan half a metre too far: 50 m/s2 no sensor has. What the next step says again is believed."""
    most = MOST_ACCELERATION_M_S2 * 0.1**2

    def predicted(places: list[float]) -> float:
        motion = ConstantVelocity()
        for k, x in enumerate(places):
            motion.correct(k * TENTH, se3.make(np.eye(3), np.array([x, 0.0, 0.0])))
        return float(motion.predict(len(places) * TENTH)[0, 3])

    assert predicted([0.0, 3.0, 6.0, 9.5]) == pytest.approx(9.5 + 3.0 + most)
    assert predicted([0.0, 3.0, 6.0, 8.5]) == pytest.approx(8.5 + 3.0 - most)
    assert predicted([0.0, 3.0, 6.0, 9.5, 13.0]) == pytest.approx(16.5)
    assert predicted([0.0, 3.0, 6.0, 9.1]) == pytest.approx(12.2)
