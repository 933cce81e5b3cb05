"""The matrix products of small Kalman filters: in NumPy the overhead of a call exceeds the computation."""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import kernel
from lslam.odometry.kernels.rotation import exponential, logarithm, multiply, straighten


@kernel
def _eliminate(A: Floats, B: Floats) -> None:
    """B (M, N) <- inv(A) B by Gaussian elimination with partial pivoting; A (M, M) is overwritten."""
    m, n = B.shape
    for c in range(m):
        p = c
        for r in range(c + 1, m):
            if abs(A[r, c]) > abs(A[p, c]):
                p = r
        if p != c:
            for j in range(m):
                A[c, j], A[p, j] = A[p, j], A[c, j]
            for j in range(n):
                B[c, j], B[p, j] = B[p, j], B[c, j]
        for r in range(c + 1, m):
            f = A[r, c] / A[c, c]
            for j in range(c, m):
                A[r, j] -= f * A[c, j]
            for j in range(n):
                B[r, j] -= f * B[c, j]
    for c in range(m - 1, -1, -1):
        for j in range(n):
            for r in range(c + 1, m):
                B[c, j] -= A[c, r] * B[r, j]
            B[c, j] /= A[c, c]


@kernel
def _product(A: Floats, B: Floats) -> Floats:
    """Matrix product A B, skipping zeros of A."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    out[i, j] += a * B[k, j]
    return out


@kernel
def _transpose(A: Floats) -> Floats:
    """A copy of A (M, N), transposed and contiguous."""
    out = np.empty((A.shape[1], A.shape[0]))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[j, i] = A[i, j]
    return out


@kernel
def _sum(A: Floats, B: Floats, factor: float) -> Floats:
    """A + factor B; an array expression takes many times as long to compile."""
    out = np.empty(A.shape)
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = A[i, j] + factor * B[i, j]
    return out


@kernel
def _copy(A: Floats) -> Floats:
    """A copy of A."""
    out = np.empty(A.shape)
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = A[i, j]
    return out


@kernel
def _in_axes_of(H: Floats, P: Floats) -> Floats:
    """Covariance H P H^T of a linear function H (M, N) of what has covariance P (N, N)."""
    return _product(_product(H, P), _transpose(H))


@kernel
def square(rest: Floats, S: Floats) -> float:
    """Squared Mahalanobis norm of the residual `rest` (M,) with covariance S (M, M)."""
    solved = np.empty((len(rest), 1))
    for i in range(len(rest)):
        solved[i, 0] = rest[i]
    _eliminate(_copy(S), solved)
    total = 0.0
    for i in range(len(rest)):
        total += rest[i] * solved[i, 0]
    return total


@kernel
def update(x: Floats, P: Floats, H: Floats, rest: Floats, noise: Floats, outlier: float) -> tuple[Floats, Floats]:
    """Mean (N,) and covariance (N, N) after the innovation `rest` (M,) with H (M, N) and `noise` (M, M).

    An innovation whose squared Mahalanobis norm, per dimension, exceeds `outlier`^2 has its noise multiplied by that excess.
    """
    n, m = len(x), len(rest)
    S, gain = _in_axes_of(H, P), _product(H, P)
    beyond = square(rest, _sum(S, noise, 1.0)) / (m * outlier * outlier)
    factor = beyond if beyond > 1.0 else 1.0
    _eliminate(_sum(S, noise, factor), gain)
    K = _transpose(gain)
    left, mean = _product(K, H), np.empty(n)
    for i in range(n):
        for j in range(n):
            left[i, j] = (1.0 if i == j else 0.0) - left[i, j]
        mean[i] = x[i]
        for k in range(m):
            mean[i] += K[i, k] * rest[k]
    return mean, _sum(_in_axes_of(left, P), _in_axes_of(K, noise), factor)


@kernel
def propagate(
    x: Floats,
    covariance: Floats,
    t: float,
    velocity_gain: Floats,
    displacement: Floats,
    velocity_arm: Floats,
    position_arm: Floats,
    R: Floats,
    force_noise: float,
) -> tuple[Floats, Floats]:
    """Mean (12,) and covariance (12, 12) of displacement, velocity, gravity and accelerometer bias after `t` seconds.

    x (9,), covariance (9, 9) : velocity, m/s, gravity and accelerometer bias, m/s2, at the beginning
    velocity_gain (3,), displacement (3,), velocity_arm (3, 3), position_arm (3, 3) : velocity, position and their arms at the
        end, as in `Increments`
    R : (3, 3) world from IMU at the beginning; force_noise : m/s2 per sqrt(Hz)
    """
    mean, F = np.empty(12), np.zeros((12, 9))
    for i in range(3):
        mean[i] = t * x[i] + 0.5 * t * t * x[3 + i]
        mean[3 + i] = x[i] + t * x[3 + i]
        mean[6 + i], mean[9 + i] = x[3 + i], x[6 + i]
        F[i, i], F[i, 3 + i] = t, 0.5 * t * t
        F[3 + i, i], F[3 + i, 3 + i] = 1.0, t
        F[6 + i, 3 + i] = F[9 + i, 6 + i] = 1.0
        for k in range(3):
            mean[i] += R[i, k] * displacement[k]
            mean[3 + i] += R[i, k] * velocity_gain[k]
            for j in range(3):
                F[i, 6 + j] -= R[i, k] * position_arm[k, j]
                F[3 + i, 6 + j] -= R[i, k] * velocity_arm[k, j]
    P = _in_axes_of(F, covariance)
    density = force_noise * force_noise
    for i in range(3):
        P[i, i] += density * t * t * t / 3.0
        P[i, 3 + i] += density * t * t / 2.0
        P[3 + i, i] += density * t * t / 2.0
        P[3 + i, 3 + i] += density * t
    return mean, P


@kernel
def correct_by_displacement(
    x: Floats, P: Floats, displacement: Floats, noise: Floats, gravity: float, gravity_sigma: float, outlier: float
) -> tuple[Floats, Floats]:
    """Mean (12,) and covariance (12, 12) of `propagate` after the update by the `displacement` (3,), m, of registration.

    noise : (3, 3) covariance of `displacement`, m2; gravity, gravity_sigma : magnitude of gravity and its sigma, m/s2
    outlier : as in `update`
    """
    H, rest = np.zeros((3, 12)), np.empty(3)
    for i in range(3):
        H[i, i] = 1.0
        rest[i] = displacement[i] - x[i]
    mean, covariance = update(x, P, H, rest, noise, outlier)
    norm = math.sqrt(mean[6] * mean[6] + mean[7] * mean[7] + mean[8] * mean[8])
    along, less, sigma = np.zeros((1, 12)), np.empty(1), np.empty((1, 1))
    for i in range(3):
        along[0, 6 + i] = mean[6 + i] / norm
    less[0], sigma[0, 0] = gravity - norm, gravity_sigma * gravity_sigma
    return update(mean, covariance, along, less, sigma, outlier)


@kernel
def turn_bias(rotation: Floats, velocity_arm: Floats, axes: Floats, rest: Floats) -> Floats:
    """Amount (3,), rad/s, by which a gyroscope's bias is below the assumed one when its rotation lacks `rest` (3,), rad.

    rotation (3, 3), from the end to the beginning, and velocity_arm (3, 3) : as in `Increments`; axes : (3, 3) of the gyroscope
    """
    less, out = np.empty((3, 1)), np.empty(3)
    for i in range(3):
        less[i, 0] = rest[i]
    _eliminate(_product(_product(_transpose(rotation), velocity_arm), axes), less)
    for i in range(3):
        out[i] = less[i, 0]
    return out


@kernel
def turn_columns(rotation: Floats, velocity_arm: Floats, axes: Floats, seconds: float) -> Floats:
    """Jacobian (3, 12) of `rotation` (3, 3) over `seconds` at constant rate by the gyroscope's bias and the rows of `axes`.

    velocity_arm : (3, 3) s, rotations integrated over the step
    """
    out, reading, turn = np.zeros((3, 12)), np.empty((3, 1)), np.empty(3)
    logarithm(rotation, turn)
    for i in range(3):
        reading[i, 0] = turn[i]
    _eliminate(_copy(axes), reading)
    arm = _product(_transpose(rotation), velocity_arm)
    scaled = _product(arm, axes)
    for i in range(3):
        for j in range(3):
            out[i, j] = -scaled[i, j]
            for k in range(3):
                out[i, 3 + 3 * j + k] = arm[i, j] * reading[k, 0] / seconds
    return out


@kernel
def turn_covariance(
    covariance: Floats, rate_variance: float, rotation: Floats, velocity_arm: Floats, axes: Floats, seconds: float
) -> Floats:
    """Covariance (3, 3), rad2, of a rotation that takes `seconds`, in the IMU's axes at its end.

    covariance : (12, 12) of the gyroscope's bias and the rows of its `axes` (3, 3); rate_variance : (rad/s)^2 per Hz
    rotation (3, 3), from the end to the beginning, and velocity_arm (3, 3) : as in `Increments`
    """
    H = turn_columns(rotation, velocity_arm, axes, seconds)
    out = _in_axes_of(H, covariance)
    for i in range(3):
        out[i, i] += rate_variance * seconds
    return out


@kernel
def correct_turn(
    x: Floats,
    covariance: Floats,
    rate_variance: float,
    rotation: Floats,
    velocity_arm: Floats,
    seconds: float,
    rest: Floats,
    noise: Floats,
    bias_walk: float,
    outlier: float,
) -> tuple[Floats, Floats, float]:
    """Bias and rows of the axes, x (12,), and their covariance (12, 12), updated by a rotation larger by `rest` (3,), rad.

    noise : (3, 3) covariance of the measured rotation, rad2; bias_walk : rad/s per sqrt(s); the others as in `turn_covariance`
    Returns also the excess, rad2, of the squared norm of `rest`, bounded at `outlier` sigma, over its expected value.
    """
    before, own = _copy(covariance), _copy(noise)
    for i in range(3):
        before[i, i] += bias_walk * bias_walk * seconds
        own[i, i] += rate_variance * seconds
    axes = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            axes[i, j] = x[3 + 3 * i + j]
    H = turn_columns(rotation, velocity_arm, axes, seconds)
    S = _in_axes_of(H, before)
    allowed, shown = 0.0, 0.0
    for i in range(3):
        allowed += S[i, i] + own[i, i]
        shown += rest[i] * rest[i]
    mean, P = update(x, before, H, rest, own, outlier)
    return mean, P, min(shown, outlier * outlier * allowed) - allowed


@kernel
def fuse_poses(T: Floats, rest: Floats, C: Floats, P: Floats, age: float) -> tuple[Floats, Floats]:
    """Weighted mean of the pose T (4, 4) with covariance C (6, 6) and of one with covariance P (6, 6), and its covariance.

    Poses on one map share its error, as large as their own, all but one part in `age`. The other pose starts at one of them and
    has it too, so that averaging does not reduce it.

    rest : (6,) from the other pose to T; all in world axes, m and rad
    age : factor on P
    """
    gain = _copy(C)
    _eliminate(_sum(C, P, age), gain)
    K = _transpose(gain)
    white = _sum(C, _product(K, C), -1.0)
    d, share = np.zeros(6), np.empty((6, 6))
    for i in range(6):
        for k in range(6):
            d[i] -= K[i, k] * rest[k]
            share[i, k] = (1.0 if i == k else 0.0) - K[i, k]
    pose, turn, R = _copy(T), np.empty((3, 3)), np.empty((3, 3))
    exponential(d[3], d[4], d[5], turn)
    multiply(turn, T, R)
    straighten(R)
    for i in range(3):
        pose[i, 3] += d[i]
        for j in range(3):
            pose[i, j] = R[i, j]
    return pose, _sum(white, _product(white, _transpose(share)), 1.0 - 1.0 / age)
