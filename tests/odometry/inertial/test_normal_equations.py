"""Normal equations: marginalising loses nothing, and what has no minimum has no step."""

from __future__ import annotations

import numpy as np

from lslam.core.kernels import linalg
from lslam.odometry.inertial.filter import Normal


def test_marginalising_a_linear_problem_leaves_its_solution_and_covariance() -> None:
    rng = np.random.default_rng(1)
    J, rest = rng.normal(size=(40, 12)), rng.normal(size=40)
    scale = 10.0 ** rng.uniform(-3, 3, 12)
    H, g = (J * scale).T @ (J * scale), (J * scale).T @ rest
    gone = np.isin(np.arange(12), [0, 4, 5, 9])
    left = Normal(H, g).without(gone)
    np.testing.assert_allclose(left.step(), Normal(H, g).step()[~gone], rtol=1e-7)
    np.testing.assert_allclose(linalg.inverse(left.H), linalg.inverse(H)[np.ix_(~gone, ~gone)], rtol=1e-6)


def test_an_indefinite_problem_has_no_step() -> None:
    assert not np.isfinite(Normal(np.diag([1.0, -1.0, 2.0]), np.ones(3)).step()).any()
