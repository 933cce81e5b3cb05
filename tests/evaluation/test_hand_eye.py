"""The rotation between two bodies: found within its sigma, and not where the motion does not observe it."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.frames import body_turn

Floats = NDArray[np.float64]
ARM = np.array([0.8, -0.3, 1.2])


def drive(count: int = 400, bend: float = 1.0, relief: float = 0.05) -> Floats:
    """(N, 4, 4) of a vehicle at 1 m a pose: bends to both sides, hills."""
    k = np.arange(count)
    yaw, pitch = bend * np.sin(k / 30.0), relief * np.sin(k / 17.0)
    R = so3.from_euler_rpy(np.column_stack([0.3 * pitch, pitch, yaw]))
    steps = np.concatenate([np.zeros((1, 3)), R[:-1, :, 0]])
    return np.asarray(se3.make(R, np.cumsum(steps, axis=0)))


def noisy(poses: Floats, metres: float, degrees: float, seed: int) -> Floats:
    """A walk, as odometry makes it: noise from each pose to the next."""
    rng = np.random.default_rng(seed)
    sigmas = np.repeat([metres, np.deg2rad(degrees)], 3)
    out = [poses[0]]
    for step in se3.relative(poses[:-1], poses[1:]):
        out.append(out[-1] @ step @ se3.exp(sigmas * rng.normal(size=6)))
    return np.stack(out)


def turned(poses: Floats, rotation_deg: Floats) -> Floats:
    """The poses of a body that is turned by that vector and sits elsewhere, in its own world."""
    X = se3.make(so3.exp(np.deg2rad(rotation_deg)), ARM)
    return np.asarray(se3.inverse(X) @ poses @ X)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("degrees", [5.0, -25.0])
def test_a_turn_is_found_in_spite_of_noise_and_a_lever_arm(axis: int, degrees: float, seed: int) -> None:
    wanted = degrees * np.eye(3)[axis]
    truth = drive()
    found = body_turn(noisy(truth, 0.02, 0.05, seed), turned(truth, wanted))
    assert found is not None
    np.testing.assert_allclose(np.rad2deg(found.rotation), wanted, atol=0.6)
    assert np.rad2deg(found.sigma) < 0.8
    assert found.mahalanobis2 > 30.7


def test_without_noise_it_is_exact_and_lever_arms_are_no_turn() -> None:
    truth = drive()
    exact, still = (
        body_turn(truth, turned(truth, np.array([3.0, -2.0, 4.0]))),
        body_turn(truth, turned(truth, np.zeros(3))),
    )
    assert exact is not None
    assert still is not None
    np.testing.assert_allclose(np.rad2deg(exact.rotation), [3.0, -2.0, 4.0], atol=1e-3)
    assert still.angle < 1e-5


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_is_no_turn(seed: int) -> None:
    truth = drive(150)
    found = body_turn(noisy(truth, 0.08, 0.3, seed), truth)
    assert found is not None
    assert found.mahalanobis2 < 16, "chi-square of three, once in a thousand"


def test_unobserved_rotations_are_not_estimated() -> None:
    """Straight on nothing tells a roll, whatever the noise; yaw shows. Without noise: to a radian, and to what drift leaves."""
    truth = drive(300, bend=0.0, relief=0.0)
    odometry = noisy(truth, 0.02, 0.02, 0)
    roll, yaw = (body_turn(odometry, turned(truth, v)) for v in (np.array([20.0, 0, 0]), np.array([0, 0, 5.0])))
    assert roll is not None
    assert yaw is not None
    assert roll.mahalanobis2 < 16
    assert np.rad2deg(np.sqrt(roll.covariance[0, 0])) > 2.0
    assert yaw.mahalanobis2 > 30.7
    assert body_turn(truth[:20], truth[:20]) is None, "20 m are no way"
    assert body_turn(truth[[0] * 300], truth[[0] * 300]) is None, "nor is standing for long"
    still = body_turn(truth, truth)
    assert still is not None
    np.testing.assert_allclose(np.sqrt(np.diag(still.covariance)), [1.0, 0.01, 0.01], rtol=1e-3)


def test_poses_that_are_missing_in_the_middle_are_no_turn() -> None:
    truth = drive(200)
    found = body_turn(truth[:160], np.concatenate([truth[:100], truth[140:]]))
    assert found is not None
    assert found.mahalanobis2 < 16


def test_the_evaluation_says_so_once_and_names_the_angle(caplog: pytest.LogCaptureFixture) -> None:
    poses = drive()
    stamps = np.arange(len(poses), dtype=np.int64) * 100_000_000
    estimate = Trajectory(stamps, poses, source="icp")
    with caplog.at_level(logging.WARNING):
        notes = evaluate(estimate, Trajectory(stamps, turned(poses, np.array([0, 5.0, 0])))).notes
    [note] = [note for note in notes if "WRONG" in note]
    assert "turned by 5.0 deg (sigma 0.6)" in note
    assert "roll, pitch, yaw = 0.0, 5.0, 0.0 deg" in note.replace("-0.0", "0.0")
    assert len(caplog.records) == 1
    assert not any("WRONG" in note for note in evaluate(estimate, estimate).notes)
    far = turned(poses, np.array([0, 0, 60.0]))
    [note] = [note for note in evaluate(estimate, Trajectory(stamps, far)).notes if "WRONG" in note]
    assert "60" in note
