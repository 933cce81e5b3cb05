"""The prior of rates: how correlated two of them are, and how far they lead."""

import numpy as np
import pytest

from lslam.backend.graph.drift import MEMORY_M, linear_basis, rate_roots, walk_root
from lslam.core.config.backend import GraphConfig

CONFIG = GraphConfig(drift_percent=2.0, drift_deg_per_100m=0.25)
SIGMA = np.array([0.02] * 3 + [np.radians(0.25) / 100] * 3)
LENGTH = 1000.0
WAY = np.linspace(0.0, LENGTH, 501)


@pytest.mark.parametrize(("apart", "knots"), [(MEMORY_M, 11), (30.0, 35), (2 * LENGTH, 2)])
def test_knots_share_every_step(apart: float, knots: int) -> None:
    """No rate between two knots but what these have, and a straight line stays one."""
    shares = linear_basis(WAY, apart)
    assert shares.shape == (len(WAY) - 1, knots)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    np.testing.assert_allclose(shares @ np.linspace(0, LENGTH, knots), 0.5 * (WAY[1:] + WAY[:-1]), atol=1e-9)


@pytest.mark.parametrize("is_smooth", [True, False])
def test_rates_are_as_alike_as_they_are_near(is_smooth: bool) -> None:
    axes, shares = [0, 2, 5], (0.0, 0.6)
    for share, root in zip(shares, rate_roots(LENGTH, CONFIG, axes, shares, 50.0, is_smooth), strict=True):
        covariance = (root @ root.T).reshape(21, 3, 21, 3)
        for axis, sigma in enumerate(SIGMA[axes]):
            for k, far in ((4, 0.0), (6, 1.0), (8, 2.0)):  # times MEMORY_M
                alike = np.exp(-0.5 * far**2 if is_smooth else -far)
                assert covariance[4, axis, k, axis] == pytest.approx(sigma**2 * (share + (1 - share) * alike))
        assert covariance[4, 0, 4, 1] == 0.0, "no axis tells of another"


@pytest.mark.parametrize("apart", [20.0, MEMORY_M])
def test_a_walk_leads_as_far_over_the_memory_as_a_rate_that_lasts(apart: float) -> None:
    """And over four times that twice as far, not four times; knots at either end count half."""
    axes = [0, 1, 5]
    root = walk_root(LENGTH, CONFIG, axes, apart)
    for times in (1, 4):
        is_gone = (WAY[1:] > 300.0) & (WAY[1:] < 301.0 + times * MEMORY_M)
        gone = np.kron((np.diff(WAY) * is_gone) @ linear_basis(WAY, apart), np.eye(3))
        sigma = np.sqrt(np.diag(gone @ root @ root.T @ gone.T))
        expected = np.sqrt((times * MEMORY_M - 0.5 * apart) * MEMORY_M) * SIGMA[axes]
        np.testing.assert_allclose(sigma, expected, rtol=0.01)
