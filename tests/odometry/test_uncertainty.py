"""From one registration's covariance to that of a pose in the world."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3
from lslam.odometry.uncertainty import PoseUncertainty
from lslam.registration.result import RegistrationResult

C = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
LEVER = 10.0


def result(x: float, covariance: NDArray[np.float64] | None = C, ok: bool = True) -> RegistrationResult:
    pose = se3.make(np.eye(3), np.array([x, 0.0, 0.0]))
    return RegistrationResult(pose, ok=ok, covariance=covariance, lever_arm=LEVER)


def shares(count: int, step: float) -> NDArray[np.float64]:
    """Of its registration, that enter the map with each of `count` scans, `step` m apart."""
    n = np.arange(1, count + 1)
    return np.maximum(np.where(n > 1, step / LEVER, 0.0), 1 / n**2)


def test_a_standing_sensor_does_not_drift() -> None:
    uncertainty = PoseUncertainty()
    for n in range(1, 501):
        now = uncertainty.add(result(3.0))
        assert now is not None
        np.testing.assert_allclose(now, C * (1 + shares(n, 0.0).sum()), rtol=1e-9)
        # The sum ends: what the first scans were wrong by is in the map, and nothing follows.
        assert (now < C * (1 + np.pi**2 / 6) + 1e-18).all()


def test_scans_of_a_sensor_at_rest_leave_the_error_of_the_map_as_it_is() -> None:
    uncertainty = PoseUncertainty()
    first = uncertainty.add(result(3.0))
    resting = dataclasses.replace(result(3.0), is_stationary=True)
    for _ in range(20):
        np.testing.assert_allclose(uncertainty.add(resting), first, rtol=1e-12)
    # It is as old as its reference, and made of all of them.
    assert uncertainty.map_age == 21
    np.testing.assert_allclose(uncertainty.add(result(3.0)), C * (2 + 1 / 22**2), rtol=1e-9)


def test_errors_of_the_first_registrations_remain_in_all_later_poses() -> None:
    """They agree with each other, so half of a large error of the second lasts, however good the later ones are."""
    exact, poor, good = 1e-9 * C, 100 * C, 0.01 * C
    uncertainty, chained = PoseUncertainty(), PoseUncertainty(is_scan_to_scan=True)
    for own in (exact, poor, *[good] * 20):
        now = uncertainty.add(result(0.0, own))
        chain = chained.add(result(0.0, own))
    np.testing.assert_allclose(now, 0.5**2 * poor + good * (1 + shares(22, 0.0)[2:].sum()), rtol=1e-6, atol=1e-20)
    # From scan to scan all of it is.
    np.testing.assert_allclose(chain, poor + 21 * good, rtol=1e-6, atol=1e-20)


def test_distance_adds_a_registration_per_lever_arm() -> None:
    uncertainty = PoseUncertainty()
    last = np.zeros((6, 6))
    for k in range(1, 101):
        now = uncertainty.add(result(0.5 * k))
        assert now is not None
        assert np.linalg.eigvalsh(now).min() > 0
        assert np.trace(now) > np.trace(last)
        last = now
    # 49.5 m are 4.95 lever arms, beside the few scans at the start; along x nothing but these adds up.
    entered = shares(100, 0.5).sum()
    assert 4.95 < entered < 4.95 + 1.3
    assert last[0, 0] == pytest.approx(C[0, 0] * (1 + entered), rel=1e-9)
    assert last[5, 5] == pytest.approx(C[5, 5] * (1 + entered), rel=1e-9)
    # A yaw error at the start swings the end sideways.
    assert last[1, 1] > C[1, 1] * (1 + entered) + 0.5 * 4.95 * C[5, 5] * 24.0**2


def test_driving_equals_accumulating_a_random_walk() -> None:
    """Draw the drift the model describes, scan by scan, and compare the spread of the end poses with the covariance."""
    rng = np.random.default_rng(0)
    runs, steps, step = 4000, 40, 1.0
    uncertainty = PoseUncertainty()
    found = None
    for k in range(steps + 1):
        found = uncertainty.add(result(step * k))
    d = np.zeros((runs, 6))
    for k, share in enumerate(shares(steps + 1, step)):
        swing = np.cross(d[:, 3:], [step if k else 0.0, 0.0, 0.0])
        d[:, :3] += swing
        d += rng.multivariate_normal(np.zeros(6), C * share, runs)
    d += rng.multivariate_normal(np.zeros(6), C, runs)
    assert found is not None
    np.testing.assert_allclose(np.sqrt(np.diag(found)), d.std(0), rtol=0.06)
    correlation = found[1, 5] / np.sqrt(found[1, 1] * found[5, 5])
    assert correlation == pytest.approx(np.corrcoef(d[:, 1], d[:, 5])[0, 1], abs=0.05)


def test_a_failed_scan_enlarges_the_covariance_of_its_own_pose_only() -> None:
    uncertainty, without = PoseUncertainty(), PoseUncertainty()
    doubt = np.diag([0.25] * 3 + [1e-3] * 3)
    for k in range(5):
        uncertainty.add(result(0.0 + k))
        without.add(result(0.0 + k))
    bad = uncertainty.add(result(5.0, doubt, ok=False))
    assert bad is not None
    assert (np.diag(bad) > np.diag(doubt)).all()
    after, expected = uncertainty.add(result(6.0)), without.add(result(6.0))
    assert after is not None
    assert expected is not None
    np.testing.assert_allclose(np.diag(after), np.diag(expected), rtol=0.2)


def test_deskew_uncertainty_averages_out_on_the_map_and_that_of_the_first_stays() -> None:
    """The first sweep's is twice as far off, so four times the covariance, in all poses."""
    own, sweep = np.diag([1e-4, 2e-4, 3e-4, 0, 0, 0]), np.diag([7e-5, 0, 1e-5, 0, 0, 0])
    uncertainty = PoseUncertainty()
    for k in range(41):
        now = uncertainty.add(result(0.5 * k, own), sweep)
        n = np.arange(2, k + 2)
        of_sweeps = 1 + 4 + (np.maximum(0.5 / LEVER, 1 / n) ** 2).sum()
        np.testing.assert_allclose(now, (1 + shares(k + 1, 0.5).sum()) * own + of_sweeps * sweep, atol=1e-16)


def test_independent_errors_of_sweeps_walk_the_map_by_the_part_that_is_renewed() -> None:
    """Monte Carlo: a map that is the mean of the last scans, each laid on it with an error of its own."""
    rng, runs, steps, renewed = np.random.default_rng(0), 4000, 200, 0.1
    at_map = np.zeros(runs)
    for _ in range(steps):
        at_map = at_map + renewed * rng.normal(0, 0.01, runs)
    walked = PoseUncertainty()
    sweep = np.diag([1e-4, 0, 0, 0, 0, 0])
    values = [walked.add(result(renewed * LEVER * k, np.zeros((6, 6))), sweep) for k in range(steps + 60)]
    assert values[59] is not None
    assert values[-1] is not None
    assert values[-1][0, 0] - values[59][0, 0] == pytest.approx(at_map.var(), rel=0.1)


def test_no_covariance_gives_none() -> None:
    assert PoseUncertainty().add(result(1.0, None)) is None


def test_map_age_is_the_number_of_scans_over_a_lever_arm() -> None:
    """One scan makes a new one, a standing sensor's is the mean of all; on the way it is renewed over a lever arm."""
    standing, driving, jumping = PoseUncertainty(), PoseUncertainty(), PoseUncertainty(is_scan_to_scan=True)
    for k in range(1, 400):
        standing.add(result(0.0))
        driving.add(result(0.5 * k))
        jumping.add(result(0.5 * k))
        assert standing.map_age == pytest.approx((k + 1) / 2)
        assert jumping.map_age == 1
    assert driving.map_age == pytest.approx(LEVER / 0.5, rel=1e-3)
    before = driving.map_age
    driving.add(result(200.0, ok=False))
    assert driving.map_age == before, "a scan that failed is not in the map"


def test_covariances_do_not_depend_on_the_origin_of_the_world() -> None:
    """The first sweep's tilt swings what lies ahead about the first place, not about the origin."""
    rng = np.random.default_rng(4)
    sweep = 1e-6 * np.cov(rng.normal(size=(6, 50)))
    here, far = PoseUncertainty(), PoseUncertainty()
    for k in range(6):
        x = 3.0 * k
        moved = dataclasses.replace(result(x), T_world_lidar=result(x).T_world_lidar.copy())
        moved.T_world_lidar[:3, 3] += [500.0, -300.0, 20.0]
        np.testing.assert_allclose(far.add(moved, sweep), here.add(result(x), sweep), rtol=1e-9)
