"""Eigenvalues and rotations in kernels against LAPACK and Rodrigues."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels import linalg
from lslam.core.kernels.jit import kernel

Floats = NDArray[np.float64]


@kernel
def rotate_many(R: Floats, steps: Floats) -> None:
    for i in range(len(steps)):
        linalg.rotate_in_place(R, steps[i, 0], steps[i, 1], steps[i, 2])


def plane(m: Floats) -> tuple[Floats, Floats]:
    found = linalg.plane_of(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2])
    return np.array(found[:3]), np.array(found[3:])


def rotated(values: Floats, rng: np.random.Generator) -> Floats:
    R = so3.exp(rng.normal(size=3) * 2)
    return np.asarray(R @ np.diag(values) @ R.T)


@kernel
def inverted(c: Floats) -> tuple[float, float, float, float, float, float]:
    return linalg.invert_symmetric(c[0], c[1], c[2], c[3], c[4], c[5])


@kernel
def turned(R: Floats, c: Floats) -> tuple[float, float, float, float, float, float]:
    return linalg.rotate_symmetric(R, c)


def test_symmetric_matrices_are_inverted_and_rotated_as_by_numpy() -> None:
    rng = np.random.default_rng(0)
    upper = np.triu_indices(3)
    for _ in range(20):
        root, R = rng.normal(size=(3, 3)), so3.exp(rng.normal(size=3))
        C = root @ root.T + 0.1 * np.eye(3)
        np.testing.assert_allclose(inverted(C[upper]), np.linalg.inv(C)[upper], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(turned(R, C[upper]), (R @ C @ R.T)[upper], atol=1e-12)


def test_planes_equal_lapack_on_random_covariances() -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        m = np.cov(rng.normal(size=(3, 8)) * rng.uniform(0.01, 1.0, (3, 1)))
        values, vectors = np.linalg.eigh(m)
        found, normal = plane(m)
        np.testing.assert_allclose(found, values, atol=1e-7 * values[2])
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        if values[1] - values[0] > 0.02 * values[2]:
            assert abs(normal @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("thickness", [0.0, 1e-9, 1e-6, 1e-4])
def test_thin_discs_of_any_orientation_have_the_right_normal(thickness: float) -> None:
    rng = np.random.default_rng(1)
    for k in range(100):
        R = np.eye(3)[:, rng.permutation(3)] if k < 6 else so3.exp(rng.normal(size=3) * 2)
        m = R @ np.diag([thickness, 0.03, 0.05]) @ R.T
        values, normal = plane(m)
        np.testing.assert_allclose(values, [thickness, 0.03, 0.05], atol=5e-9)
        assert abs(normal @ R[:, 0]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    "values", [[0, 0, 0], [1, 1, 1], [0, 0, 1], [0, 1, 1], [1e-20, 1e-20, 1e-20], [1e-8, 1e-8, 1.0], [1e8, 1e8, 1e8]]
)
def test_degenerate_matrices_give_finite_unit_normals(values: list[float]) -> None:
    rng = np.random.default_rng(2)
    for m in [np.diag(np.array(values, float)), *(rotated(np.array(values, float), rng) for _ in range(20))]:
        found, normal = plane(m)
        np.testing.assert_allclose(found, sorted(values), atol=2e-7 * max(values) + 1e-15)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_jacobi_equals_lapack(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(50):
        a = rng.normal(size=(n, n)) * 10 ** rng.uniform(-3, 3, (1, n))
        m = a.T @ a
        values, vectors = linalg.eigen(m)
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(m), atol=1e-11 * np.abs(m).max())
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-12)
        np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, m, atol=1e-11 * np.abs(m).max())


@pytest.mark.parametrize(
    "matrix", [np.zeros((6, 6)), np.eye(6), np.diag([0, 0, 1e-300, 1, 1, 1e12]), np.ones((6, 6)), -np.eye(6)]
)
def test_jacobi_on_degenerate_matrices(matrix: Floats) -> None:
    values, vectors = linalg.eigen(matrix)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(matrix), atol=1e-12)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(6), atol=1e-12)


def test_jacobi_leaves_its_argument_alone_and_ends_on_nan() -> None:
    m = np.ones((6, 6)) + np.eye(6)
    kept = m.copy()
    linalg.eigen(m)
    np.testing.assert_array_equal(m, kept)
    values, _ = linalg.eigen(np.full((6, 6), np.nan))
    assert np.isnan(values).any()


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-7, 1e-6, 1e-3, 0.5, 3.0])
def test_rotate_left_is_the_exponential_map(scale: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        R = so3.exp(rng.normal(size=3))
        w = rng.normal(size=3) * scale
        expected = so3.exp(w) @ R
        linalg.rotate_in_place(R, *w)
        np.testing.assert_allclose(R, expected, atol=2e-15 + 1e-15 * scale)


def test_a_hundred_thousand_updates_stay_on_the_manifold() -> None:
    rng = np.random.default_rng(4)
    R = np.eye(3)
    steps = rng.normal(0, 0.02, (100_000, 3))
    rotate_many(R, steps)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=5e-16 * 4)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_one_update_puts_a_matrix_back_on_the_manifold(row: int) -> None:
    R = so3.exp(np.array([0.3, -0.2, 0.9]))
    R[row] = 1.01 * R[row] + 0.01 * R[(row + 1) % 3]
    assert np.abs(R @ R.T - np.eye(3)).max() > 5e-3
    linalg.rotate_in_place(R, 0.01, 0.02, -0.03)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)


def test_a_full_turn_in_small_steps_comes_back() -> None:
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    R = np.eye(3)
    rotate_many(R, np.tile(axis * 2 * np.pi / 100_000, (100_000, 1)))
    np.testing.assert_allclose(R, np.eye(3), atol=1e-10)


@pytest.mark.parametrize("values", [(0.0, 0.0, 0.0), (1e-40, 1e-40, 1e-40), (2.0, 2.0, 2.0), (0.0, 0.0, 4e-15)])
def test_a_ball_and_a_line_have_a_normal_though_many_would_do(values: tuple[float, float, float]) -> None:
    found, normal = plane(np.diag(values[::-1]))
    np.testing.assert_allclose(found, values, atol=1e-7 * values[2])
    assert np.linalg.norm(normal) == pytest.approx(1.0)
