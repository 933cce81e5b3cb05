"""Closest points: equivalent to planes of points, and Jacobians equal differences."""

from __future__ import annotations

import numpy as np
from analytic_scenes import random_pose

from lslam.core.geometry import se3, so3
from lslam.odometry.plane_segmentation import linearise_view, plane_covariance, to_hesse, transform_planes

RNG = np.random.default_rng(0)


def test_a_plane_seen_from_elsewhere_holds_the_same_points() -> None:
    for _ in range(20):
        cp, T_b_a = RNG.normal(size=3) * 5, random_pose(RNG, 20, 180)
        n, d = to_hesse(cp)
        on_plane = RNG.normal(size=(10, 3)) * 10
        on_plane += (d - on_plane @ n)[:, None] * n
        m, e = to_hesse(transform_planes(cp, T_b_a))
        np.testing.assert_allclose(se3.apply(se3.inverse(T_b_a), on_plane) @ m, e, atol=1e-9)


def test_from_the_other_side_the_normal_turns_round() -> None:
    beyond = se3.make(np.eye(3), np.array([5.0, 0.0, 0.0]))
    np.testing.assert_allclose(transform_planes(np.array([2.0, 0.0, 0.0]), beyond), [-3.0, 0.0, 0.0])


def test_derivatives_are_those_of_differences() -> None:
    cp = RNG.normal(size=(4, 3)) * 4
    anchors = np.stack([random_pose(RNG, 10, 90) for _ in range(4)])
    poses = np.stack([random_pose(RNG, 10, 90) for _ in range(4)])
    found, by_pose, by_plane = linearise_view(cp, anchors, poses)
    np.testing.assert_allclose(found, transform_planes(cp, se3.relative(anchors, poses)), atol=1e-12)
    h = 1e-6
    for k in range(6):
        d = np.zeros(6)
        d[k] = h
        moved = se3.make(so3.exp(d[3:]) @ poses[:, :3, :3], poses[:, :3, 3] + d[:3])
        other, _, _ = linearise_view(cp, anchors, moved)
        np.testing.assert_allclose((other - found) / h, by_pose[:, :, k], atol=2e-4)
    for k in range(3):
        other, _, _ = linearise_view(cp + h * np.eye(3)[k], anchors, poses)
        np.testing.assert_allclose((other - found) / h, by_plane[:, :, k], atol=2e-4)


def test_the_covariance_is_that_of_fitted_planes() -> None:
    """Normal and distance of a wall, fitted again and again to other noise."""
    sigma, fitted = 0.02, []
    wall = np.stack([np.full(200, 6.0), *RNG.uniform([[-3], [-1]], [[5], [2]], (2, 200))], axis=1)
    for _ in range(400):
        points = wall + np.outer(RNG.normal(0, sigma, 200), [1, 0, 0])
        n = np.linalg.eigh(np.cov(points.T))[1][:, 0]
        fitted.append(n * (n @ points.mean(axis=0)))
    off = np.array(fitted) - [6.0, 0.0, 0.0]
    C = plane_covariance(np.array([6.0, 0.0, 0.0]), 200.0, wall.mean(axis=0), np.cov(wall.T, bias=True), sigma**2)
    nees = np.einsum("ki,ij,kj->k", off, np.linalg.inv(C), off).mean() / 3
    assert 0.85 < nees < 1.15
