"""Elementary functions against extended precision, products against BLAS, plain floats against arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from lslam.core.geometry import portable, se3, so3

RNG = np.random.default_rng(5)
ANGLES = np.concatenate([RNG.uniform(-10, 10, 20_000), RNG.uniform(-1e5, 1e5, 20_000), [0.0, np.pi / 2, np.pi, 1e-300]])


def units_off(ours: Any, exact: Any) -> float:
    """Largest error in units in the last place."""
    exact = np.asarray(exact, np.float64)
    return float(np.max(np.abs(ours - exact) / np.spacing(np.abs(exact))))


@pytest.mark.parametrize(
    ("ours", "reference", "at"),
    [
        (portable.sin, np.sin, ANGLES),
        (portable.cos, np.cos, ANGLES),
        (portable.tan, np.tan, RNG.uniform(-1.5, 1.5, 20_000)),
        (portable.exp, np.exp, RNG.uniform(-50, 50, 20_000)),
        (portable.log, np.log, 10 ** RNG.uniform(-10, 10, 20_000)),
        (portable.arcsin, np.arcsin, RNG.uniform(-1, 1, 20_000)),
        (portable.arccos, np.arccos, RNG.uniform(-1, 1, 20_000)),
    ],
)
def test_elementary_functions(ours: Callable[..., Any], reference: Callable[..., Any], at: Any) -> None:
    exact = reference(at.astype(np.longdouble))
    assert units_off(ours(at), exact) <= 4
    # A number by itself and single precision: the same function.
    assert all(ours(float(x)) == y for x, y in zip(at[:50], ours(at[:50]), strict=True))
    single = ours(at.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_array_equal(single, ours(at.astype(np.float32).astype(np.float64)).astype(np.float32))


def test_arctangent_in_all_quadrants() -> None:
    y, x = RNG.normal(size=(2, 20_000)) * 10 ** RNG.uniform(-5, 5, 20_000)
    angles = portable.arctan2(y, x)
    assert units_off(angles, np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))) <= 2
    assert [portable.arctan2(float(a), float(b)) for a, b in zip(y[:50], x[:50], strict=True)] == angles[:50].tolist()
    for a, b in (
        (0.0, 1.0),
        (0.0, -1.0),
        (-0.0, -1.0),
        (1.0, 0.0),
        (-1.0, 0.0),
        (0.0, 0.0),
        (np.inf, 1.0),
        (1.0, np.inf),
    ):
        assert portable.arctan2(a, b) == np.arctan2(a, b)


def test_what_is_no_number_stays_so() -> None:
    assert np.isnan(portable.sin(np.nan))
    assert np.isnan(portable.sine_cosine(np.array([np.nan] * 9))).all()
    assert portable.exp(np.array([-1000.0, 1000.0])).tolist() == [0.0, np.inf]
    assert portable.power(np.array([0.0, 2.0]), 3).tolist() == [0.0, pytest.approx(8.0, rel=1e-15)]


@pytest.mark.parametrize(
    ("a", "b"),
    [((4, 4), (4, 4)), ((50, 4, 4), (4, 4)), ((50, 7, 3), (50, 3, 3)), ((3,), (3, 2)), ((3, 3), (1000, 3, 3))],
)
def test_products(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    A, B = RNG.normal(size=a), RNG.normal(size=b)
    np.testing.assert_allclose(portable.product(A, B), A @ B, rtol=0, atol=1e-13)


def test_one_matrix_and_many_have_the_same_bytes() -> None:
    A, B = RNG.normal(size=(2, 100, 4, 4))
    many = portable.product(A, B)
    assert all((portable.product(a, b) == c).all() for a, b, c in zip(A, B, many, strict=True))
    phi = RNG.normal(size=(100, 3))
    assert all((so3.exp(v) == R).all() for v, R in zip(phi, so3.exp(phi), strict=True))
    # No turn, hardly one, half a turn about each axis, and all between.
    halves = [np.diag(signs) for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    turns = np.concatenate(
        [so3.exp(phi), so3.exp(3.14 * phi / portable.norm(phi)[:, None]), so3.exp(1e-10 * phi), halves]
    )
    assert all((so3.log(R) == v).all() for v, R in zip(so3.log(turns), turns, strict=True))


def test_poses_between_few_and_many_have_the_same_bytes() -> None:
    poses, stamps = se3.exp(RNG.normal(size=(3, 6))), np.array([0, 40, 100])
    query = np.arange(-10, 120, 7)
    one_by_one = np.concatenate([se3.poses_at(stamps, poses, query[k : k + 1]) for k in range(len(query))])
    np.testing.assert_array_equal(se3.poses_at(stamps, poses, query), one_by_one)
