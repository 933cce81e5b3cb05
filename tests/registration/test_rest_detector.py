"""Rest of the sensor: of poses that err as they say, and of simulated scans from one place."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3, so3
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.registration.rest import RestDetector
from lslam.registration.result import RegistrationResult
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]

# m and rad, of a registration; its points lie 10 m away.
SIGMA_M, SIGMA_RAD, LEVER_M = 0.004, 2e-4, 10.0
C = np.diag(np.repeat([SIGMA_M**2, SIGMA_RAD**2], 3))


def noisy(twists: Floats, seed: int = 0) -> list[RegistrationResult]:
    """Registrations that err by their covariance, at twists (N, 6)."""
    errors = np.random.default_rng(seed).normal(0, np.sqrt(np.diag(C)), twists.shape)
    return [RegistrationResult(se3.exp(t), covariance=C, lever_arm=LEVER_M) for t in twists + errors]


def at_rest(results: Iterable[RegistrationResult]) -> NDArray[np.bool_]:
    detector = RestDetector(0.03)
    return np.array([detector.judge(result).is_stationary for result in results])


def along(axis: int, steps: Floats) -> Floats:
    """(N, 6) twists along one axis."""
    twists = np.zeros((len(steps), 6))
    twists[:, axis] = np.cumsum(steps)
    return twists


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_at_rest_is_recognised_from_the_second_scan_on(seed: int) -> None:
    assert at_rest(noisy(np.zeros((50, 6)), seed))[1:].all()


def test_rest_is_recognised_after_a_drive_and_ends_with_it() -> None:
    steps = np.concatenate([np.full(20, 0.5), np.zeros(30), np.full(10, 0.1)])
    rests = at_rest(noisy(along(0, steps)))
    assert not rests[:21].any()
    assert rests[23:50].all()
    assert not rests[50:].any()


@pytest.mark.parametrize(("axis", "step"), [(0, 0.005), (1, 0.002), (5, np.deg2rad(0.02)), (3, np.deg2rad(0.01))])
@pytest.mark.parametrize("seed", range(3))
def test_a_slow_sensor_is_not_at_rest(axis: int, step: float, seed: int) -> None:
    """5 and 2 cm/s, 0.2 and 0.1 deg/s: each step is within the noise. Only the first of them cannot be told from rest."""
    rests = at_rest(noisy(along(axis, np.full(200, step)), seed))
    first = int(np.argmin(rests[1:])) + 1
    assert first < 20
    assert rests[first:].mean() < 0.06


def test_a_pose_that_is_unsure_or_rejected_is_no_rest() -> None:
    detector, (result, *_) = RestDetector(0.03), noisy(np.zeros((1, 6)))
    detector.judge(result)
    assert not detector.judge(RegistrationResult(result.T_world_lidar, covariance=None)).is_stationary
    detector.judge(result)
    assert not detector.judge(result.reject("the IMU", result.T_world_lidar, C)).is_stationary
    # 10 cm are no rest, however little is known.
    far = RegistrationResult(se3.exp(np.array([0.1, 0, 0, 0, 0, 0])), covariance=1e4 * C, lever_arm=LEVER_M)
    detector.judge(result)
    assert not detector.judge(far).is_stationary


def test_a_scan_that_failed_says_nothing() -> None:
    detector, results = RestDetector(0.03), noisy(np.zeros((3, 6)))
    detector.judge(results[0])
    assert not detector.judge(RegistrationResult(np.eye(4), ok=False)).is_stationary
    assert detector.judge(results[1]).is_stationary


def test_the_map_does_not_follow_scans_from_one_place() -> None:
    """On rough ground scans from one place agree about a tilt of 0.02 deg; a map that each of them moves turns by 0.09."""
    still = simulate("carpark", seed=701, lidar="vlp16", count=26, static_start=4.0, motion_compensated=True)
    registration, rests, poses = Registration(), [], []
    for scan in still:
        result = registration.update(registration.locate(prepare_points(scan.points, PreprocessConfig()), np.eye(4)))
        rests.append(result.is_stationary)
        poses.append(result.T_world_lidar)
    assert all(rests[1:])
    tilts = np.rad2deg(so3.angle(np.stack(poses)[:, :3, :3]))
    assert tilts.max() < 0.03
    assert tilts[-10:].mean() - tilts[1:11].mean() < 0.004
    assert np.linalg.norm(np.stack(poses)[:, :3, 3], axis=1).max() < 0.009
