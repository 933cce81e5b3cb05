"""The inertial filter's kernels against the same formulas in NumPy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.kernels.jit import kernel
from lslam.odometry.kernels import kalman, rotation, strapdown

Floats = NDArray[np.float64]
OUTLIER = 4.0


@kernel
def _straightened(R: Floats) -> None:
    rotation.straighten(R)


@kernel
def _exponential(v: Floats, out: Floats) -> None:
    rotation.exponential(v[0], v[1], v[2], out)


def covariance(n: int, rng: np.random.Generator) -> Floats:
    root = rng.normal(size=(n, n))
    return np.asarray(root @ root.T + 0.1 * np.eye(n))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi - 1e-9])
def test_rotations_and_their_vectors_are_those_of_so3(angle: float) -> None:
    rng = np.random.default_rng(0)
    for axis in np.vstack([np.eye(3), -np.eye(3), rng.normal(size=(10, 3))]):
        vector, out = angle * axis / np.linalg.norm(axis), np.empty((3, 3))
        _exponential(vector, out)
        np.testing.assert_allclose(out, so3.exp(vector), atol=2e-15)
        A = so3.exp(rng.normal(size=3))
        np.testing.assert_allclose(rotation.vector_between(A, A @ out), vector, atol=2e-14 + 1e-6 * (angle > 3.1))


def test_what_rounding_left_is_put_back_to_the_nearest_rotation() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        R = so3.exp(rng.normal(size=3)) + rng.uniform(-1e-9, 1e-9, (3, 3))
        nearest = so3.normalise(R)
        _straightened(R)
        np.testing.assert_allclose(R, nearest, atol=2e-15)


def test_poses_are_apart_by_their_move_and_their_turn() -> None:
    rng = np.random.default_rng(2)
    a, b = (se3.exp(rng.normal(size=6)) for _ in range(2))
    delta = se3.relative(a, b)
    assert rotation.apart(a, b, 7.0) == pytest.approx(np.linalg.norm(delta[:3, 3]) + 7 * so3.angle(delta[:3, :3]))


def sums(
    stamps: NDArray[np.int64], gyro: Floats, accel: Floats, instants: NDArray[np.int64], bias: Floats, axes: Floats
) -> list[Floats]:
    """Midpoint rule between all samples and instants, one after the other."""
    grid = np.unique(np.concatenate([instants, stamps[(stamps > instants[0]) & (stamps < instants[-1])]]))
    R, (v, p), (V, P) = np.eye(3), np.zeros((2, 3)), np.zeros((2, 3, 3))
    rows = {int(grid[0]): (R, v, p, V, P)}
    for begin, end in itertools.pairwise(grid):
        dt, middle = 1e-9 * (end - begin), 0.5 * (begin + end)
        rate, force = (np.array([np.interp(middle, stamps, x[:, k]) for k in range(3)]) for x in (gyro, accel))
        rate, force = axes @ (rate - bias[:3]), force - bias[3:]
        halfway = R @ so3.exp(0.5 * dt * rate)
        p, v = p + v * dt + 0.5 * dt**2 * halfway @ force, v + dt * halfway @ force
        P, V = P + V * dt + 0.5 * dt**2 * halfway, V + dt * halfway
        R = R @ so3.exp(dt * rate)
        rows[int(end)] = (R, v, p, V, P)
    return [np.stack(column) for column in zip(*(rows[int(t)] for t in instants), strict=True)]


@pytest.mark.parametrize(
    ("begin", "end"), [(0.2, 0.31), (0.2, 0.2), (-0.05, 0.1), (0.95, 1.1), (0.203, 0.207), (2.0, 2.1)]
)
def test_a_stream_is_integrated_as_by_its_definition_within_and_beyond_its_ends(begin: float, end: float) -> None:
    rng = np.random.default_rng(3)
    stamps = np.sort(rng.choice(1_000_000_000, 100, replace=False)).astype(np.int64)
    gyro, accel, bias = rng.normal(size=(100, 3)), rng.normal(size=(100, 3)) + 9.8, rng.normal(size=6)
    axes = np.eye(3) + rng.normal(0, 0.02, (3, 3))
    inner = np.sort(np.concatenate([1e9 * rng.uniform(begin, end, 9), [1e9 * begin, 1e9 * end]])).astype(np.int64)
    on_samples = stamps[(stamps > 1e9 * begin) & (stamps < 1e9 * end)][:2]
    instants = np.unique(np.concatenate([inner, on_samples]))
    first = int(np.searchsorted(stamps, instants[0], side="right"))
    found = strapdown.integrate(stamps, gyro, accel, first, instants, bias[:3], bias[3:], axes)
    for got, expected in zip(found, sums(stamps, gyro, accel, instants, bias, axes), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-14)


def test_a_state_is_propagated_by_its_matrix() -> None:
    rng = np.random.default_rng(4)
    x, P, t, R = rng.normal(size=9), covariance(9, rng), 0.13, so3.exp(rng.normal(size=3))
    gained, moved, V, S = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    one, none = np.eye(3), np.zeros((3, 3))
    F = np.block([[t * one, t**2 / 2 * one, -R @ S], [one, t * one, -R @ V], [none, one, none], [none, none, one]])
    noise = np.zeros((12, 12))
    noise[:6, :6] = np.kron(0.05**2 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]]), one)
    # The bias is in what was felt already: the matrix tells what an error of it adds.
    mean = F[:, :6] @ x[:6] + np.concatenate([R @ moved, R @ gained, np.zeros(3), x[6:]])
    found, found_P = kalman.propagate(x, P, t, gained, moved, V, S, R, 0.05)
    np.testing.assert_allclose(found, mean, atol=1e-13)
    np.testing.assert_allclose(found_P, F @ P @ F.T + noise, atol=1e-12)


def columns(R: Floats, V: Floats, axes: Floats, seconds: float) -> Floats:
    arm, reading = R.T @ V, np.linalg.solve(axes, so3.log(R)) / seconds
    return np.hstack([-arm @ axes, arm @ np.kron(np.eye(3), reading)])


def test_a_rotation_updates_the_gyroscope_as_the_full_update() -> None:
    rng = np.random.default_rng(5)
    R, V, t = so3.exp(rng.normal(size=3)), rng.normal(size=(3, 3)), 0.1
    axes, bias, P = np.eye(3) + rng.normal(0, 0.02, (3, 3)), rng.normal(size=3), covariance(12, rng)
    rest, noise = rng.normal(size=3), covariance(3, rng)
    H = columns(R, V, axes, t)
    np.testing.assert_allclose(
        kalman.turn_covariance(P, 0.3, R, V, axes, t), H @ P @ H.T + 0.3 * t * np.eye(3), rtol=1e-12
    )
    np.testing.assert_allclose(kalman.turn_bias(R, V, axes, rest), np.linalg.solve(R.T @ V @ axes, rest), rtol=1e-10)
    x, before, own = np.concatenate([bias, axes.ravel()]), P.copy(), noise + 0.3 * t * np.eye(3)
    before[:3, :3] += 0.2**2 * t * np.eye(3)
    expected, after = kalman.update(x, before, H, rest, own, OUTLIER)
    mean, found, excess = kalman.correct_turn(x, P, 0.3, R, V, t, rest, noise, 0.2, OUTLIER)
    np.testing.assert_allclose(mean, expected, rtol=1e-10)
    np.testing.assert_allclose(found, after, atol=1e-10)
    assert excess == pytest.approx(rest @ rest - np.trace(H @ before @ H.T + own))


def test_a_displacement_and_the_strength_of_gravity_are_two_updates() -> None:
    rng = np.random.default_rng(6)
    x, P, moved, noise = rng.normal(size=12), covariance(12, rng), rng.normal(size=3), covariance(3, rng)
    H = np.hstack([np.eye(3), np.zeros((3, 9))])
    mean, after = kalman.update(x, P, H, moved - x[:3], noise, OUTLIER)
    norm = float(np.linalg.norm(mean[6:9]))
    along = np.zeros((1, 12))
    along[0, 6:9] = mean[6:9] / norm
    mean, after = kalman.update(mean, after, along, np.array([9.8 - norm]), np.array([[0.03**2]]), OUTLIER)
    found, found_P = kalman.correct_by_displacement(x, P, moved, noise, 9.8, 0.03, OUTLIER)
    np.testing.assert_allclose(found, mean, rtol=1e-10)
    np.testing.assert_allclose(found_P, after, atol=1e-10)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_lengths_and_weights_are_those_of_lapack(size: int) -> None:
    rng = np.random.default_rng(size)
    rest, S = rng.normal(size=size), covariance(size, rng)
    # Rows must be swapped here.
    S[0, 0] = 1e-14 if size == 3 else S[0, 0]
    assert kalman.square(rest, S) == pytest.approx(rest @ np.linalg.solve(S, rest), rel=1e-9)


def test_a_pose_is_weighed_against_another_by_both_covariances() -> None:
    rng = np.random.default_rng(7)
    T, rest, C, P = se3.exp(rng.normal(size=6)), 0.01 * rng.normal(size=6), covariance(6, rng), covariance(6, rng)
    K = np.linalg.solve(C + 5.0 * P, C).T
    d = -K @ rest
    pose, left = kalman.fuse_poses(T, rest, C, P, 5.0)
    np.testing.assert_allclose(pose[:3, :3], so3.exp(d[3:]) @ T[:3, :3], atol=1e-14)
    np.testing.assert_allclose(pose[:3, 3], T[:3, 3] + d[:3], atol=1e-14)
    L = np.eye(6) - K
    np.testing.assert_allclose(left, L @ C + (1 - 1 / 5.0) * L @ C @ L.T, atol=1e-11)


def test_stretches_overlap_by_more_than_an_instant() -> None:
    stretches = np.array([[0, 10], [50, 60]])
    cases = {(10, 50): False, (10, 51): True, (9, 20): True, (60, 70): False, (52, 53): True}
    assert {case: strapdown.overlaps(stretches, *case) for case in cases} == cases
