"""`icp` on simulated drives: accuracy, starts at speed, consistent covariances, and gates that no sentinel passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives import ate, coasting, drive, nees_per_dof, poses_of, standing
from numpy.typing import NDArray

from lslam import Registration
from lslam.core.geometry import se3, so3
from lslam.registration.result import RegistrationResult
from lslam.simulation.scenarios import simulate

CENTIMETRE = 0.01
LONG = [("street", 1, 35), ("street", 2, 35), ("block", 0, 95), ("block", 1, 95)]


@pytest.mark.parametrize(("scenario", "seed", "count"), LONG)
def test_error_stays_under_a_centimetre(scenario: str, seed: int, count: int) -> None:
    d = drive(scenario, seed, count)
    results = d.results
    assert all(r.ok and r.converged for r in results)
    assert ate(poses_of(results), d.truth) < CENTIMETRE


@pytest.mark.parametrize(("scenario", "seed", "count"), [LONG[0], LONG[2]])
def test_no_sentinel_passes_the_gate(scenario: str, seed: int, count: int) -> None:
    truth = drive(scenario, seed, count).truth
    assert ate(truth, truth) < 1e-9
    assert ate(standing(truth), truth) > 10 * CENTIMETRE
    assert ate(coasting(truth), truth) > 10 * CENTIMETRE


@pytest.mark.parametrize("lidar", ["hdl64", "vlp16"])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_no_start_is_lost_at_up_to_two_and_a_half_metres_per_scan(every: int, lidar: str) -> None:
    d = drive("street", 0, 4, every, lidar, 8.3)
    step = np.linalg.norm(d.truth[1, :3, 3])
    assert step == pytest.approx(0.83 * every, rel=0.02)
    results = d.results
    assert all(r.ok for r in results)
    errors = np.linalg.norm((poses_of(results) - d.truth)[:, :3, 3], axis=1)
    assert errors[1] < 0.1
    assert errors.max() < 0.1
    # StationaryDetector still would be a lost start.
    assert step > 0.1


def test_covariances_mean_something() -> None:
    """Mean NEES per degree of freedom over runs with three LiDARs; 1 is honest."""
    runs = [
        *(drive("block", seed, 95) for seed in (0, 1, 2)),
        *(drive("street", seed, 35) for seed in (1, 2)),
        drive("street", 4, 30, lidar="os1-32"),
    ]
    means = [nees_per_dof(d.results, d.truth).mean() for d in runs]
    assert 0.3 < np.mean(means) < 3.0
    assert max(means) < 10.0


def test_sixteen_rings_within_thirty_degrees_hold_the_pitch_from_the_start() -> None:
    """One ring per fine voxel: planes tilt, unless the points there keep the coarse plane. 9 mrad off before they did."""
    means, pitch = [], []
    for seed in (4, 6, 7):
        d = drive("street", seed, 10, lidar="vlp16")
        results = d.results
        means.append(nees_per_dof(results, d.truth).mean())
        errors = [so3.log(r.T_world_lidar[:3, :3] @ T[:3, :3].T)[1] for r, T in zip(results, d.truth, strict=True)]
        pitch.append(np.abs(errors).max())
    assert np.mean(means) < 3.0
    assert max(pitch) < 4e-3


def test_nees_sees_covariances_that_are_a_hundred_times_off() -> None:
    d = drive("block", 0, 95)
    results = d.results
    honest = nees_per_dof(results, d.truth).mean()
    for factor in (0.01, 100.0):
        scaled = [replace(r, covariance=factor * covariance(r)) for r in results]
        mean = nees_per_dof(scaled, d.truth).mean()
        assert mean == pytest.approx(honest / factor, rel=1e-6)
        assert not 0.3 < mean < 3.0


def covariance(result: RegistrationResult) -> NDArray[np.float64]:
    assert result.covariance is not None
    return result.covariance


@pytest.mark.parametrize("scenario", ["small-eight", "climbing"])
def test_a_sparse_sensor_over_roofs_starts_although_few_of_its_points_find_a_plane(scenario: str) -> None:
    """Ten metres up, one scan of 32 rings makes planes for a sixth of the next one's points; they are right."""
    d = drive(scenario, 0, 12)
    results = d.results
    assert all(r.ok for r in results)
    assert max(np.linalg.norm(r.T_world_lidar[:3, 3] - T[:3, 3]) for r, T in zip(results, d.truth, strict=True)) < 0.05


def test_a_start_forty_metres_up_takes_larger_planes() -> None:
    """There the rings lie so far apart that a twentieth of the points finds a plane in coarse voxels; it was lost."""
    climb = simulate("climbing", count=300)
    assert climb.ground_truth is not None
    first, second = climb.ground_truth.poses[[290, 291]]
    registration = Registration()
    registration.register(climb.scan(290).points, np.eye(4))
    result = registration.register(climb.scan(291).points, np.eye(4))
    assert result.ok
    assert np.linalg.norm(result.T_world_lidar[:3, 3] - se3.relative(first, second)[:3, 3]) < 0.1
