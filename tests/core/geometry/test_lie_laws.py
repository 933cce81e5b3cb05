"""Laws of SO(3) and SE(3), over random and awkward values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from lslam.core.geometry import se3, so3

vectors = arrays(np.float64, 3, elements=st.floats(-1.7, 1.7))
twists = arrays(np.float64, 6, elements=st.floats(-1.7, 1.7))


@given(vectors)
def test_exp_equals_scipy(phi: np.ndarray) -> None:
    np.testing.assert_allclose(so3.exp(phi), Rotation.from_rotvec(phi).as_matrix(), atol=1e-12)


@given(vectors)
def test_log_inverts_exp(phi: np.ndarray) -> None:
    np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, atol=1e-9)


@pytest.mark.parametrize("angle", [0, 1e-12, 1e-6, 1.0, np.pi - 1e-9, np.pi])
def test_angle_near_zero_and_pi(angle: float) -> None:
    axis = np.array([1.0, -2.0, 0.5]) / np.sqrt(5.25)
    assert so3.angle(so3.exp(angle * axis)) == pytest.approx(angle, abs=1e-9)


@given(twists)
def test_se3_exp_equals_matrix_exponential(xi: np.ndarray) -> None:
    m = np.zeros((4, 4))
    m[:3, :3], m[:3, 3] = so3.hat(xi[3:]), xi[:3]
    np.testing.assert_allclose(se3.exp(xi), expm(m), atol=1e-11)


@given(twists)
def test_se3_log_inverts_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-8)


@given(twists, twists)
def test_compose_with_relative_gives_the_other(a: np.ndarray, b: np.ndarray) -> None:
    A, B = se3.exp(a), se3.exp(b)
    np.testing.assert_allclose(A @ se3.relative(A, B), B, atol=1e-12)


@given(twists, twists)
def test_a_motion_is_as_large_in_any_frame(a: np.ndarray, b: np.ndarray) -> None:
    move, turn = se3.magnitude(se3.exp(a))
    assert move == pytest.approx(np.linalg.norm(se3.exp(a)[:3, 3]))
    assert turn == pytest.approx(np.linalg.norm(a[3:]), abs=1e-9)
    seen = se3.relative(se3.exp(b), se3.exp(b) @ se3.exp(a))
    assert se3.magnitude(seen) == pytest.approx((move, turn), abs=1e-7)


@given(twists, twists)
def test_adjoint_moves_twists_through(a: np.ndarray, b: np.ndarray) -> None:
    T = se3.exp(a)
    np.testing.assert_allclose(se3.exp(se3.adjoint(T) @ b * 0.1), T @ se3.exp(b * 0.1) @ se3.inverse(T), atol=1e-9)


@given(vectors)
def test_quaternion_round_trip(phi: np.ndarray) -> None:
    R = so3.exp(phi)
    q = so3.to_quaternion(R)
    np.testing.assert_allclose(so3.from_quaternion(q), R, atol=1e-12)
    assert q[3] >= 0


def test_euler_round_trip() -> None:
    rpy = np.array([[0.1, -0.4, 2.9], [-3.0, 1.2, -0.5]])
    np.testing.assert_allclose(so3.euler_rpy(so3.from_euler_rpy(rpy)), rpy, atol=1e-12)


def test_normalise_returns_to_the_group() -> None:
    R = so3.exp(np.array([0.3, 0.2, -0.1])) + 1e-4
    N = so3.normalise(R)
    np.testing.assert_allclose(N @ N.T, np.eye(3), atol=1e-12)


def test_interpolation_hits_poses_and_halves() -> None:
    poses = np.stack([np.eye(4), se3.exp(np.array([1.0, 0, 0, 0, 0, 0.4]))])
    out = se3.poses_at(np.array([0, 100]), poses, np.array([0, 50, 100]))
    np.testing.assert_allclose(out[[0, 2]], poses, atol=1e-12)
    assert so3.log(out[1, :3, :3])[2] == pytest.approx(0.2)


@given(twists, st.floats(0.5, 2))
def test_umeyama_finds_the_transform(xi: np.ndarray, scale: float) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    T = se3.exp(xi)
    found, s, determined = se3.umeyama(points, scale * points @ T[:3, :3].T + T[:3, 3], with_scale=True)
    assert determined
    assert s == pytest.approx(scale)
    np.testing.assert_allclose(found, T, atol=1e-9)


def test_umeyama_says_a_line_is_not_determined() -> None:
    line = np.outer(np.arange(5.0), [1, 2, 3])
    assert not se3.umeyama(line, line)[2]


def test_least_rotations() -> None:
    x, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    slanted = np.array([0.6, 0.0, 0.8])
    for a, b in (
        (up, up),
        (-up, up),
        (slanted, up),
        (np.array([0.0, 1.0, 0.0]), up),
        (-x, x),
        (-slanted, slanted),
        (x, slanted),
    ):
        R = so3.least_rotation(a, b)
        np.testing.assert_allclose(R @ a, b, atol=1e-12)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        assert so3.angle(R) == pytest.approx(np.arccos(a @ b), abs=1e-7)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5, 1e-3, 0.5, 3.0, np.pi])
def test_a_single_pose_has_the_bytes_of_one_in_a_stack(size: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(40):
        phi = rng.normal(size=3)
        phi *= size / np.linalg.norm(phi)
        xi = np.concatenate([rng.normal(size=3), phi])
        T, other = se3.exp(xi), se3.exp(rng.normal(size=6))
        blurred = T[:3, :3] + rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-17, -1)
        pairs = [
            (T, se3.exp(xi[None])),
            (se3.log(T), se3.log(T[None])),
            (se3.relative(T, other), se3.relative(T[None], other[None])),
            (so3.exp(phi), so3.exp(phi[None])),
            (so3.log(T[:3, :3]), so3.log(T[None, :3, :3])),
            (so3.angle(T[:3, :3]), so3.angle(T[None, :3, :3])),
            (so3.to_quaternion(T[:3, :3]), so3.to_quaternion(T[None, :3, :3])),
            (so3.normalise(blurred), so3.normalise(blurred[None])),
            (so3.is_rotation(blurred, 1e-3), so3.is_rotation(blurred[None], 1e-3)),
        ]
        for single, stacked in pairs:
            assert np.array_equal(single, stacked[0])
