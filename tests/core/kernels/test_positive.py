"""Kernels for positive definite matrices, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.kernels import linalg


@pytest.mark.parametrize("n", [1, 7, 120])
def test_inverse_solution_and_complement(n: int) -> None:
    rng = np.random.default_rng(n)
    root, scale = rng.normal(size=(n + 3, n + 3)), np.diag(10.0 ** rng.uniform(-4, 4, n + 3))
    A = scale @ (root @ root.T + np.eye(n + 3)) @ scale
    found = linalg.inverse(A)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(scale @ found @ scale, np.linalg.inv(root @ root.T + np.eye(n + 3)), atol=1e-9)
    b = A @ np.ones(n + 3)
    np.testing.assert_allclose(linalg.solve(A, b), 1.0, rtol=1e-6)
    corner = np.ascontiguousarray(A[:n, :n]), np.ascontiguousarray(A[:n, n:]), np.ascontiguousarray(A[n:, n:])
    # The inverse of a complement is the corner of the inverse.
    np.testing.assert_allclose(linalg.complement(*corner) @ found[n:, n:], np.eye(3), atol=1e-5)


def test_what_is_not_positive_definite_gives_no_number() -> None:
    assert np.isnan(linalg.solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.ones(2))).any()
