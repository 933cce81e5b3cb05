"""The surface round a source point: of its voxel, where several rings make one, or of its nearest neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import is_near, random_pose, room, seen_from
from numpy.typing import NDArray

from lslam.core.config.odometry import RegistrationConfig
from lslam.registration.gaussian_map import COVARIANCE_POINTS, Neighbourhood, source_covariance
from lslam.registration.registration import Registration

THIN = 9e-4


def full(six: NDArray[np.float64]) -> NDArray[np.float64]:
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def test_neighbours_are_the_twenty_nearest_and_make_a_disc() -> None:
    rng = np.random.default_rng(0)
    cloud = room(rng).astype(np.float32)[::5]
    source = cloud[::50].astype(np.float64) + rng.normal(0, 0.02, (len(cloud[::50]), 3))
    found = full(source_covariance(source, cloud, THIN, "knn"))
    for point, C in zip(source, found, strict=True):
        near = cloud[np.argsort(((cloud - point) ** 2).sum(1), kind="stable")[:COVARIANCE_POINTS]].astype(np.float64)
        _, vectors = np.linalg.eigh(np.cov(near.T))
        values, axes = np.linalg.eigh(C)
        np.testing.assert_allclose(values, [THIN, 1.0, 1.0], atol=1e-9)
        assert abs(axes[:, 0] @ vectors[:, 0]) > 1 - 1e-6


def test_one_ring_has_no_surface_in_its_voxel_and_a_false_one_of_its_neighbours() -> None:
    """Twenty points along a line have some normal; it is that of nothing."""
    along = np.linspace(0, 2 * np.pi, 2000)
    ring = np.column_stack([8 * np.cos(along), 8 * np.sin(along), np.full_like(along, -1.7)]).astype(np.float32)
    source = ring[::40].astype(np.float64)
    np.testing.assert_allclose(
        full(source_covariance(source, ring, THIN, "voxel")), THIN * np.tile(np.eye(3), (50, 1, 1))
    )
    assert np.all(np.linalg.eigvalsh(full(source_covariance(source, ring, THIN, "knn")))[:, 1] > 0.99)


@pytest.mark.parametrize(("apart", "has_normal"), [(0.8, True), (1.6, True), (2.8, False)])
def test_rings_within_two_metres_make_a_surface(apart: float, has_normal: bool) -> None:
    """Two rings along x on level ground, the second in the same cell of 1 m, of 2 m, and in another: only these see no ground."""
    x = np.arange(0.05, 1.95, 0.05)
    cloud = np.concatenate([np.column_stack([x, np.full_like(x, y), np.full_like(x, 0.5)]) for y in (0.1, 0.1 + apart)])
    found = full(source_covariance(cloud[:10].astype(np.float64), cloud.astype(np.float32), THIN))
    expected = np.diag([1.0, 1.0, THIN]) if has_normal else THIN * np.eye(3)
    np.testing.assert_allclose(found, np.tile(expected, (10, 1, 1)), atol=1e-6)


@pytest.mark.parametrize("neighbourhood", ["voxel", "knn"])
@pytest.mark.parametrize("residual", ["gicp", "vgicp"])
def test_both_source_covariances_recover_a_known_motion(residual: str, neighbourhood: Neighbourhood) -> None:
    rng = np.random.default_rng(3)
    registration = Registration(RegistrationConfig(residual=residual, neighbourhood=neighbourhood))
    registration.register(room(np.random.default_rng(0)).astype(np.float32))
    T = random_pose(rng, 0.5, 3.0)
    assert is_near(T, registration.register(seen_from(room(rng), T)).T_world_lidar, 0.01, 0.05)


def test_voxel_and_neighbour_covariances_give_different_results() -> None:
    poses = []
    for neighbourhood in ("voxel", "knn"):
        rng = np.random.default_rng(3)
        config = RegistrationConfig.model_validate({"residual": "gicp", "neighbourhood": neighbourhood})
        registration = Registration(config)
        registration.register(room(np.random.default_rng(0)).astype(np.float32))
        poses.append(registration.register(seen_from(room(rng), random_pose(rng, 0.5, 3.0))).T_world_lidar)
    assert not np.array_equal(poses[0], poses[1])
