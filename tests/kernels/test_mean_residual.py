"""Points on the means of voxels, point to point: the normal equations are those of NumPy, all three axes alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from numpy_voxels import Match, VoxelMap, matches

from lslam.geometry import so3
from lslam.kernels import facts as at
from lslam.kernels.mean_residual import linearise_means
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import Matches

Floats = NDArray[np.float64]
SIZE, SIGMA2, NO_PLANES = 0.4, 0.16, 2.0


@pytest.mark.parametrize("c", [0.1, 0.4, 1.0])
def test_normal_equations_are_those_of_numpy(c: float) -> None:
    target, source, found, R, t = posts()
    search, H, S, g = Matches(len(source)), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    facts = np.zeros(at.COUNT)
    linearise_means(
        (source,), (target.planes, target.keys, target.table), (SIZE, SIGMA2, 1.0, 1.0, True), search.search(), (R, t),
        (c, c, np.inf), (H, S, g, facts),
    )  # fmt: skip
    expected_H, expected_g = np.zeros((6, 6)), np.zeros(6)
    for m in found:
        r, J = m.rows(R, t)
        w = m.information(R, t, c)
        expected_H += w * J.T @ J
        expected_g += w * J.T @ r
    np.testing.assert_allclose(np.triu(H), np.triu(expected_H), rtol=1e-6, atol=1e-6 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=1e-6 * np.abs(expected_g).max())
    assert facts[at.MATCHED] == len(found) == np.count_nonzero(search.is_done) > 100
    assert facts[at.INLIERS] == sum(m.distance2(R, t) < c * c for m in found)


def posts() -> tuple[GaussianMap, Floats, list[Match], Floats, Floats]:
    """A map of posts, points on and off them, their matches in NumPy, and a pose that is a little off."""
    rng = np.random.default_rng(5)
    # Amid voxels, many points in each: of a single one nobody can tell whether it is a plane.
    places = (SIZE * (rng.integers(-30, 30, (30, 2)) + 0.5)).repeat(60, axis=0) + rng.normal(0, 0.03, (1800, 2))
    cloud = np.column_stack([places, np.tile(np.linspace(0.0, 3.99, 60), 30)]).astype(np.float32)
    target = GaussianMap(SIZE, min_points=1, planarity=NO_PLANES, reach=np.inf)
    reference = VoxelMap(SIZE)
    target.insert(cloud, np.eye(4))
    reference.insert(cloud, np.eye(3), np.zeros(3))
    R, t = so3.exp(np.array([0.01, -0.02, 0.04])), np.array([0.1, -0.05, 0.08])
    source = (cloud[::3].astype(np.float64) + rng.normal(0, 0.05, (len(cloud[::3]), 3))) @ R
    source[::20] += 9.0
    found = matches(
        reference, source, np.zeros((len(source), 6)), R, t, SIGMA2, 1.0, 0.0, min_points=1, planarity=NO_PLANES
    )
    return target, source, [replace(m, across=np.eye(3)) for m in found], R, t
