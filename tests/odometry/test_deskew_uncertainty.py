"""The error of a pose by a motion that changes within the sweep, and its covariance."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.geometry import se3, so3
from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry.uncertainty import DeskewUncertainty, PoseUncertainty
from lslam.pipeline.run import run
from lslam.registration.result import RegistrationResult
from lslam.simulation.scenarios import simulate

SPAN = 0.1


def at(x: float) -> NDArray[np.float64]:
    return se3.make(np.eye(3), np.array([x, 0.0, 0.0]))


def steady(pose: float, velocity: float, passed: float = 0.0) -> MotionPrior:
    times = np.linspace(0.0, SPAN, 5) - passed * SPAN
    return MotionPrior(times, np.stack([at(pose + velocity * t) for t in times]))


@pytest.mark.parametrize("passed", [0.0, 0.5, 0.3])
@pytest.mark.parametrize("every", [1, 4])
def test_the_deskew_uncertainty_of_a_steady_acceleration_is_exact(every: int, passed: float) -> None:
    """Points deskewed by the velocity since the last sweep's middle: their mean error is that of the pose at the stamp.

    2 m/s2, points all over the sweep, every scan and every fourth, stamps at its start, in its middle and between.
    """
    a, step = 2.0, every * SPAN
    doubt = DeskewUncertainty()
    for k in range(20):
        t = k * step
        used = a * (t + (0.5 - passed) * SPAN - 0.5 * step)
        within = ((np.arange(1000) + 0.5) / 1000 - passed) * SPAN
        off = float(np.mean(0.5 * a * (t + within) ** 2 - used * within)) - 0.5 * a * t**2
        pose = 0.5 * a * t**2 + off
        S = doubt.observe(steady(pose, used, passed), round(1e9 * t), at(pose), has_registration=True)
    assert off > (1e-3 if passed == 0 else 5e-4)
    # Ten lessons in six directions: a part of it counts for those across, as if none were special.
    np.testing.assert_allclose(np.trace(S[:3, :3]), off**2, rtol=1e-3)
    assert S[0, 0] > 0.7 * off**2
    assert np.abs(S[3:, 3:]).max() < 1e-12


@pytest.mark.parametrize(("passed", "part"), [(0.0, 6), (0.5, 24)])
def test_the_first_deskew_uncertainty_allows_braking_and_hand_rotation(passed: float, part: int) -> None:
    """3 m/s2 and 1 rad/s2 over a sweep T put its start off by a T^2 / 6 and its middle by a T^2 / 24.

    The second scan cannot tell, the third can.
    """
    doubt = DeskewUncertainty()
    usual = (np.repeat([3.0, 1.0], 3) * SPAN**2 / part) ** 2
    for k in range(2):
        S = doubt.observe(steady(k, 10.0, passed), k * 10**8, at(k), has_registration=True)
        np.testing.assert_allclose(S, np.diag(usual))
    assert not doubt.observe(steady(2.0, 10.0, passed), 2 * 10**8, at(2.0), has_registration=True).any()


def test_deskew_uncertainty_resumes_to_the_last_bit() -> None:
    """The next lesson needs where in its sweep the stamp of the scan before lay."""
    whole, again = DeskewUncertainty(), DeskewUncertainty()
    for k in range(6):
        whole.observe(steady(k**2 / 10, 10.0, 0.2), k * 10**8, at(k**2 / 10), has_registration=True)
    again.restore(deepcopy(whole.state()))
    after = [one.observe(steady(3.6, 10.0, 0.2), 6 * 10**8, at(3.6), has_registration=True) for one in (whole, again)]
    assert after[0].any()
    np.testing.assert_array_equal(*after)


@pytest.mark.parametrize("passed", [0.0, 0.5])
def test_a_sweep_longer_than_the_step_counts_as_one_of_its_length(passed: float) -> None:
    """Stamps that come in bursts make it look so. The velocity is what was wrong, and it is the same."""
    full, longer, step = DeskewUncertainty(), DeskewUncertainty(), round(1e9 * SPAN)
    for k in range(6):
        priors = [MotionPrior(n * t, np.stack([at(k + 10.0 * n * s) for s in t])) for n in (1, 2)
                  for t in [(np.linspace(0.0, 1.0, 5) - passed) * SPAN]]  # fmt: skip
        pose = at(k + 0.01 * (-1) ** k)
        S = [
            one.observe(prior, k * step, pose, has_registration=True)
            for one, prior in zip((full, longer), priors, strict=True)
        ]
    assert S[0][0, 0] > 1e-7
    np.testing.assert_allclose(S[1], S[0], rtol=1e-9, atol=1e-15)


def test_uncertainty_lies_along_the_axes_of_the_world() -> None:
    """The same motion in a world that is turned: the same doubt, turned."""
    rng = np.random.default_rng(2)
    turn = se3.make(so3.exp(np.array([0.4, -0.3, 1.5])), np.zeros(3))
    straight, turned = DeskewUncertainty(), DeskewUncertainty()
    for k in range(12):
        prior, pose = steady(k, 10.0), at(k + 0.01 * rng.normal())
        S = straight.observe(prior, k * 10**8, pose, has_registration=True)
        found = turned.observe(
            MotionPrior(prior.times, turn @ prior.poses), k * 10**8, turn @ pose, has_registration=True
        )
    R = np.kron(np.eye(2), turn[:3, :3])
    np.testing.assert_allclose(found, R @ S @ R.T, atol=1e-15)
    assert S[0, 0] > 2 * S[1, 1]


def test_scans_of_one_instant_have_no_deskew_uncertainty() -> None:
    doubt = DeskewUncertainty()
    for k in range(5):
        S = doubt.observe(MotionPrior.at_once(at(k)), k * 10**8, at(k**2), has_registration=True)
        assert not S.any()


def test_a_failed_scan_does_not_change_the_deskew_uncertainty() -> None:
    rng = np.random.default_rng(0)
    doubt = DeskewUncertainty()
    for k in range(12):
        S = doubt.observe(steady(k, 10.0), k * 10**8, at(k + 0.01 * rng.normal()), has_registration=True)
    lost = doubt.observe(steady(12.0, 10.0), 12 * 10**8, at(40.0), has_registration=False)
    after = doubt.observe(steady(13.0, 10.0), 13 * 10**8, at(13.0), has_registration=True)
    np.testing.assert_array_equal(lost, after)
    assert after[0, 0] < 2 * S[0, 0]


def test_the_first_sweep_is_in_all_poses() -> None:
    """A tilt of the world's beginning swings what lies 90 m on; scans of one instant know no such doubt."""
    C = np.diag([1e-6] * 3 + [1e-10] * 3)
    swept, instant = PoseUncertainty(), PoseUncertainty()
    for k in range(10):
        jerk = so3.exp(np.array([0.0, 2e-3 * (-1) ** k, 0.0]))
        located = RegistrationResult(se3.make(jerk, np.array([10.0 * k, 0, 0])), covariance=C, lever_arm=20.0)
        one, one_own = instant.covariances(located, k * 10**8, MotionPrior.at_once(located.T_world_lidar))
        found, own = swept.covariances(located, k * 10**8, steady(10.0 * k, 100.0))
    assert one is not None
    assert found is not None
    assert own is not None
    np.testing.assert_allclose(one_own, C)
    assert own[4, 4] > 1e-7
    assert found[2, 2] > one[2, 2] + 90**2 * own[4, 4]


def test_later_motion_does_not_change_the_uncertainty_of_the_first_sweep() -> None:
    rng, C = np.random.default_rng(3), 1e-12 * np.eye(6)
    uncertainty, doubts = PoseUncertainty(), []
    for k in range(80):
        pose = at(0.1 * k + (0.02 * rng.normal() if k < 12 else 0.0))
        located = RegistrationResult(pose, covariance=C, lever_arm=1e5)
        found, own = uncertainty.covariances(located, k * 10**8, steady(pose[0, 3], 1.0))
        assert found is not None
        assert own is not None
        doubts.append((found[0, 0], own[0, 0]))
    shaken, calm = doubts[11], doubts[-1]
    assert calm[1] < 0.05 * shaken[1]
    # What is left of a shaken pose's doubt is that of the first sweep: four of five parts.
    assert calm[0] == pytest.approx(0.8 * shaken[0], rel=0.1)


def test_covariances_of_a_shaken_sensor_are_consistent() -> None:
    """Carried by a walker, deskewed at constant velocity: registrations alone are a hundred times too sure (1600).

    The error of the first sweep is in all poses, so their mean is that of a few draws: 0.7 and 4.6 for two seeds.
    """
    drive = simulate("walk", seed=0, count=40)
    outcome = run(drive, load_config(settings=["loops.use=false"], environ={}))
    truth = drive.ground_truth.poses
    results = outcome.record.results
    real = results[0].T_world_lidar @ se3.inverse(truth[0]) @ truth
    nees = []
    for result, T in zip(results[1:], real[1:], strict=True):
        off = result.T_world_lidar[:3, 3] - T[:3, 3]
        e = np.concatenate([off, so3.log(result.T_world_lidar[:3, :3] @ T[:3, :3].T)])
        nees.append(float(e @ np.linalg.solve(result.covariance, e)) / 6)
    assert 0.05 < np.mean(nees) < 10.0


def test_the_pose_of_a_rejected_scan_does_not_change_the_estimated_motion() -> None:
    """Two decimetres off, as an IMU may be: neither the way to it nor the way from it is an acceleration."""
    C, uncertainty = 1e-8 * np.eye(6), PoseUncertainty()
    for k in range(12):
        is_rejected = k == 7
        result = RegistrationResult(at(k + 0.2 * is_rejected), covariance=C, lever_arm=10.0, is_rejected=is_rejected)
        _, own = uncertainty.covariances(result, k * 10**8, steady(1.0 * k, 10.0))
    np.testing.assert_allclose(own, C, atol=1e-12)
