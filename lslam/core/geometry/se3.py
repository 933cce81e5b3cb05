"""Rigid transforms as 4x4 matrices, stacked or single: (..., 4, 4). `T_a_b` maps coordinates of b into a.

Tangent vectors are (translation, rotation): xi = (rho, phi), metres then radians. Updates are left-multiplied:
T' = exp(xi) T, so a covariance of xi is expressed in the parent frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Stamps
from lslam.core.geometry import portable, so3


def make(R: NDArray[Any], t: NDArray[Any]) -> Floats:
    """(..., 4, 4) transform of rotations (..., 3, 3) and translations (..., 3), m."""
    R, t = np.asarray(R, np.float64), np.asarray(t, np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def exp(xi: NDArray[Any]) -> Floats:
    """(..., 6) twists to (..., 4, 4) transforms."""
    xi = np.asarray(xi, np.float64)
    rho, phi = xi[..., :3], xi[..., 3:]
    return make(so3.exp(phi), portable.rotate(_left_jacobian(phi), rho))


def log(T: NDArray[Any]) -> Floats:
    """(..., 4, 4) transforms to (..., 6) twists."""
    T = np.asarray(T, np.float64)
    phi = so3.log(T[..., :3, :3])
    rho = portable.rotate(_inverse_left_jacobian(phi), T[..., :3, 3])
    return np.concatenate([rho, phi], axis=-1)


def inverse(T: NDArray[Any]) -> Floats:
    """Inverse of rigid transforms, by the transpose."""
    T = np.asarray(T, np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return make(Rt, -portable.rotate(Rt, T[..., :3, 3]))


def relative(T_a: NDArray[Any], T_b: NDArray[Any]) -> Floats:
    """inv(T_a) @ T_b: pose b seen from pose a."""
    T_a, T_b = np.asarray(T_a, np.float64), np.asarray(T_b, np.float64)
    if T_a.shape == T_b.shape == (4, 4):
        return _relative_of(T_a, T_b)
    return portable.product(inverse(T_a), T_b)


def _relative_of(T_a: Floats, T_b: Floats) -> Floats:
    """inv(T_a) T_b of two single poses by plain floats, with the same bits as `relative`, in a quarter of the time."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z) = T_a[:3].tolist()
    p, q, r, last = T_b.tolist()
    inverse_rows = ((a, d, g), (b, e, h), (c, f, i))
    rows = [(u, v, w, -(u * x + v * y + w * z)) for u, v, w in inverse_rows]
    out = [[u * p[k] + v * q[k] + w * r[k] + s * last[k] for k in range(4)] for u, v, w, s in rows]
    return np.array([*out, last])


def apply(T: NDArray[Any], points: NDArray[Any]) -> Floats:
    """One transform (4, 4) applied to points (N, 3), m; float64 out."""
    T = np.asarray(T, np.float64)
    return np.asarray(portable.product(np.asarray(points, np.float64), T[:3, :3].T) + T[:3, 3])


def normalise(T: NDArray[Any]) -> Floats:
    """The same transforms with their rotations made orthogonal again (nearest rotation)."""
    T = np.asarray(T, np.float64)
    return make(so3.normalise(T[..., :3, :3]), T[..., :3, 3])


def magnitude(T: Floats) -> tuple[float, float]:
    """Length of the translation, m, and angle of the rotation, rad, of one motion (4, 4)."""
    return float(np.linalg.norm(T[:3, 3])), float(so3.angle(T[:3, :3]))


def adjoint(T: NDArray[Any]) -> Floats:
    """(..., 6, 6) adjoint: exp(Ad_T xi) = T exp(xi) inv(T), for (translation, rotation) twists."""
    T = np.asarray(T, np.float64)
    R, t = T[..., :3, :3], T[..., :3, 3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = portable.product(so3.hat(t), R)
    return A


def _left_jacobian(phi: Floats) -> Floats:
    """(..., 3, 3) left Jacobian of SO(3) at rotation vectors (..., 3), rad."""
    if phi.ndim == 1:
        return _left_jacobian_of(*phi.tolist())
    theta2 = np.sum(phi * phi, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta2 < 1e-8
    safe = np.where(small, 1.0, theta)
    sine, cosine = portable.sine_cosine(safe)
    b = np.where(small, 0.5 - theta2 / 24, (1 - cosine) / safe**2)
    c = np.where(small, 1 / 6 - theta2 / 120, (safe - sine) / (safe * safe * safe))
    return np.asarray(np.eye(3) + b * so3.hat(phi) + c * so3.square(phi))


def _left_jacobian_of(x: float, y: float, z: float) -> Floats:
    """Left Jacobian of one rotation vector by plain floats, with the same bits as `_left_jacobian`."""
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-8:
        return so3.polynomial(x, y, z, 0.5 - theta2 / 24, 1 / 6 - theta2 / 120)
    theta = math.sqrt(theta2)
    sine, cosine = portable.sine_cosine_of(theta)
    return so3.polynomial(x, y, z, (1 - cosine) / (theta * theta), (theta - sine) / (theta * theta * theta))


def _inverse_left_jacobian(phi: Floats) -> Floats:
    """(..., 3, 3) inverse left Jacobian of rotation vectors (..., 3) of angles up to pi (Barfoot 2017, equation 7.37b)."""
    if phi.ndim == 1:
        return _inverse_left_jacobian_of(*phi.tolist())
    theta2 = np.sum(phi * phi, axis=-1)[..., None, None]
    small = theta2 < 1e-4
    half = np.sqrt(np.where(small, 1.0, theta2)) / 2
    sine, cosine = portable.sine_cosine(half)
    series = 1 / 12 + theta2 / 720 + theta2 * theta2 / 30240
    c = np.where(small, series, (1 - half * cosine / sine) / (4 * half * half))
    return np.asarray(np.eye(3) - 0.5 * so3.hat(phi) + c * so3.square(phi))


def _inverse_left_jacobian_of(x: float, y: float, z: float) -> Floats:
    """Inverse left Jacobian of one rotation vector by plain floats, with the same bits as `_inverse_left_jacobian`."""
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-4:
        return so3.polynomial(x, y, z, -0.5, 1 / 12 + theta2 / 720 + theta2 * theta2 / 30240)
    half = math.sqrt(theta2) / 2
    sine, cosine = portable.sine_cosine_of(half)
    return so3.polynomial(x, y, z, -0.5, (1 - half * cosine / sine) / (4 * half * half))


def turns_between(a: Floats, b: Floats) -> Floats:
    """(N, 3) rotation vectors from poses `a` to `b` (N, 4, 4), in the axes of `a`."""
    return so3.log(portable.product(np.swapaxes(a[:, :3, :3], -1, -2), b[:, :3, :3]))


def poses_at(
    stamps_ns: NDArray[np.int64], poses: Floats, query_ns: NDArray[Any], turns: Floats | None = None
) -> Floats:
    """Poses (M, 4, 4) at `query_ns` (M,) interpolated between increasing `stamps_ns` (N,) with `poses` (N, 4, 4), N >= 2.

    turns : (N - 1, 3) `turns_between` successive poses, if the caller has them
    Queries outside the stamps extrapolate the first or last segment: the caller decides how far.
    """
    stamps = np.asarray(stamps_ns, np.int64)
    query = np.asarray(query_ns, np.int64)
    left = np.clip(np.searchsorted(stamps, query, side="right") - 1, 0, len(stamps) - 2)
    span = (stamps[left + 1] - stamps[left]).astype(np.float64)
    share = (query - stamps[left]).astype(np.float64) / span
    a, b = poses[left], poses[left + 1]
    if turns is None:
        # Once for each segment, where the queries are more than these.
        turn = turns_between(poses[:-1], poses[1:])[left] if len(poses) <= len(query) else turns_between(a, b)
    else:
        turn = turns[left]
    t = a[:, :3, 3] + share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
    return make(portable.product(a[:, :3, :3], so3.exp(share[:, None] * turn)), t)


def umeyama(source: NDArray[Any], target: NDArray[Any], with_scale: bool = False) -> tuple[Floats, float, bool]:
    """Transform (4, 4), scale and whether the rotation is determined: target ~ scale * R @ source + t.

    Parameters are (N, 3) matched points, m. The rotation is not determined (False) with fewer than three points or when
    the points lie on a line: the second singular value of the cross covariance is under 1e-7 of the first (a spread
    of 3 cm on 100 m).
    """
    a, b = np.asarray(source, np.float64), np.asarray(target, np.float64)
    mean_a, mean_b = a.mean(0), b.mean(0)
    cross = (b - mean_b).T @ (a - mean_a) / len(a)
    u, d, vt = np.linalg.svd(cross)
    determined = len(a) >= 3 and bool(d[1] > 1e-7 * max(d[0], 1e-300)) and bool(d[0] > 1e-12)
    s = np.eye(3)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        s[2, 2] = -1
    R = u @ s @ vt
    variance = float(((a - mean_a) ** 2).sum() / len(a))
    scale = float(np.trace(np.diag(d) @ s)) / variance if with_scale and variance > 0 else 1.0
    return make(R, mean_b - scale * R @ mean_a), scale, determined


class ContinuousMotion:
    """Motion through poses by cubic splines, in rotation those of Kang and Park (1999).

    Straight lines between poses would cut the swing of a hand: at 2 Hz and 10 scans a second by a fifth.

    stretches : stamps (N,), ns, increasing, and poses (N, 4, 4), N >= 2, of each; shorter ones are left out. Between two of
        them the motion is unknown
    """

    def __init__(self, stretches: Iterable[tuple[Stamps, Floats]]) -> None:
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        self._parts = []
        for stamps, poses in stretches:
            if len(stamps) < 2:
                continue
            seconds = 1e-9 * (stamps - stamps[0])
            turning = RotationSpline(seconds, Rotation.from_matrix(poses[:, :3, :3]))
            self._parts.append((stamps, CubicSpline(seconds, poses[:, :3, 3]), turning))

    def at(self, stamps_ns: Stamps) -> tuple[Floats, Floats, Bools]:
        """Poses (K, 4, 4) and turning rates (K,), rad/s, at `stamps_ns` (K,), and whether a stretch covers the instant."""
        poses, rates = np.tile(np.eye(4), (len(stamps_ns), 1, 1)), np.zeros(len(stamps_ns))
        within = np.zeros(len(stamps_ns), np.bool_)
        for stamps, path, turning in self._parts:
            inside = (stamps_ns >= stamps[0]) & (stamps_ns <= stamps[-1])
            if inside.any():
                seconds = 1e-9 * (stamps_ns[inside] - stamps[0])
                poses[inside] = make(turning(seconds).as_matrix(), path(seconds))
                rates[inside] = np.linalg.norm(turning(seconds, 1), axis=1)
            within |= inside
        return poses, rates, within
