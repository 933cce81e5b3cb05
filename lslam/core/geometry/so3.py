"""Rotations: exponential and logarithm on SO(3), quaternions (xyzw), angles. Arrays may be stacked: (..., 3, 3)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats
from lslam.core.geometry import portable

# Length of x as seen from above, below which it is vertical: 15 deg.
_STEEP = 0.25


def hat(v: NDArray[Any]) -> Floats:
    """(..., 3) vectors to (..., 3, 3) skew matrices, so that `hat(a) @ b == cross(a, b)`."""
    v = np.asarray(v, np.float64)
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return m


def exp(phi: NDArray[Any]) -> Floats:
    """(..., 3) rotation vectors, rad, to (..., 3, 3) matrices (Rodrigues)."""
    phi = np.asarray(phi, np.float64)
    if phi.ndim == 1:
        return _exp_of(*phi.tolist())
    theta2 = np.sum(phi * phi, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta2 < 1e-10
    safe = np.where(small, 1.0, theta)
    sine, cosine = portable.sine_cosine(safe)
    a = np.where(small, 1 - theta2 / 6, sine / safe)
    b = np.where(small, 0.5 - theta2 / 24, (1 - cosine) / safe**2)
    return np.asarray(np.eye(3) + a * hat(phi) + b * square(phi))


def _exp_of(x: float, y: float, z: float) -> Floats:
    """Exponential of one rotation vector by plain floats, with the same bits as `exp`, in a tenth of the time."""
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-10:
        return polynomial(x, y, z, 1 - theta2 / 6, 0.5 - theta2 / 24)
    theta = math.sqrt(theta2)
    sine, cosine = portable.sine_cosine_of(theta)
    return polynomial(x, y, z, sine / theta, (1 - cosine) / (theta * theta))


def polynomial(x: float, y: float, z: float, a: float, b: float) -> Floats:
    """I + a hat(phi) + b hat(phi)^2 (3, 3) of one rotation vector phi = (x, y, z)."""
    d = x * x + y * y + z * z
    return np.array(
        [
            [1 + b * (x * x - d), -a * z + b * (x * y), a * y + b * (x * z)],
            [a * z + b * (y * x), 1 + b * (y * y - d), -a * x + b * (y * z)],
            [-a * y + b * (z * x), a * x + b * (z * y), 1 + b * (z * z - d)],
        ]
    )


def square(phi: Floats) -> Floats:
    """hat(phi) @ hat(phi) of vectors (..., 3)."""
    return np.asarray(phi[..., :, None] * phi[..., None, :] - np.eye(3) * portable.dot(phi, phi)[..., None, None])


def log(R: NDArray[Any]) -> Floats:
    """(..., 3, 3) rotations to (..., 3) rotation vectors, rad, of angle 0..pi; stable near 0 and near pi."""
    R = np.asarray(R, np.float64)
    if R.ndim == 2:
        return np.array(_log_of(R))
    q = to_quaternion(R)
    v, w = q[..., :3], q[..., 3]
    n = np.linalg.norm(v, axis=-1)
    small = n < 1e-9
    scale = np.where(small, 2.0, 2 * portable.arctan2(n, w) / np.where(small, 1.0, n))
    return np.asarray(v * scale[..., None])


def _log_of(R: Floats) -> tuple[float, float, float]:
    """`log` of one rotation by plain floats, with the same bits, in a twentieth of the time."""
    x, y, z, w = _quaternion_of(R)
    n = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if n < 1e-9 else 2 * portable.arctan2_of(n, w) / n
    return x * scale, y * scale, z * scale


def angle(R: NDArray[Any]) -> Floats:
    """Rotation angle |log R| in rad, shape (...)."""
    if np.ndim(R) == 2:
        x, y, z = _log_of(np.asarray(R, np.float64))
        return np.asarray(math.sqrt(x * x + y * y + z * z))
    return np.asarray(np.linalg.norm(log(R), axis=-1))


def least_rotation(a: Floats, b: Floats) -> Floats:
    """(3, 3) smallest rotation that maps the unit vector `a` (3,) to `b` (3,); for opposite ones by pi about a normal axis."""
    axis, cosine = np.cross(a, b), float(portable.dot(a, b))
    sine = float(portable.norm(axis))
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        least = int(np.argmin(np.abs(a)))
        axis = np.eye(3)[least] - a[least] * a
        return exp(np.pi * axis / portable.norm(axis))
    return exp(axis / sine * portable.arctan2(sine, cosine))


def level_frame(up: Floats) -> Floats:
    """Rotation (3, 3) of unit vector `up` (3,) to z that keeps the heading of x, or the least one where x is nearly vertical."""
    if np.array_equal(up, (0.0, 0.0, 1.0)):
        return np.eye(3)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    length = float(portable.norm(ahead))
    if length < _STEEP:
        return least_rotation(up, np.array([0.0, 0.0, 1.0]))
    return np.stack([ahead / length, np.cross(up, ahead / length), up])


def to_quaternion(R: NDArray[Any]) -> Floats:
    """(..., 3, 3) rotations to (..., 4) unit quaternions xyzw with w >= 0 (Shepperd's method: the largest term leads)."""
    R = np.asarray(R, np.float64)
    if R.ndim == 2:
        return np.array(_quaternion_of(R))
    r00, r11, r22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # 4 q q^T
    rows = np.empty((*R.shape[:-2], 4, 4))
    rows[..., 0, 0], rows[..., 1, 1] = 1 + r00 - r11 - r22, 1 - r00 + r11 - r22
    rows[..., 2, 2], rows[..., 3, 3] = 1 - r00 - r11 + r22, 1 + r00 + r11 + r22
    rows[..., 0, 1] = rows[..., 1, 0] = R[..., 1, 0] + R[..., 0, 1]
    rows[..., 0, 2] = rows[..., 2, 0] = R[..., 0, 2] + R[..., 2, 0]
    rows[..., 1, 2] = rows[..., 2, 1] = R[..., 2, 1] + R[..., 1, 2]
    rows[..., 0, 3] = rows[..., 3, 0] = R[..., 2, 1] - R[..., 1, 2]
    rows[..., 1, 3] = rows[..., 3, 1] = R[..., 0, 2] - R[..., 2, 0]
    rows[..., 2, 3] = rows[..., 3, 2] = R[..., 1, 0] - R[..., 0, 1]
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def _quaternion_of(R: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion xyzw of one rotation by plain floats, with the same bits as `to_quaternion`."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = R.tolist()
    diagonal = (1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22, 1 + r00 + r11 + r22)
    xy, xz, yz, wx, wy, wz = r10 + r01, r02 + r20, r21 + r12, r21 - r12, r02 - r20, r10 - r01
    xx, yy, zz, ww = diagonal
    rows = ((xx, xy, xz, wx), (xy, yy, yz, wy), (xz, yz, zz, wz), (wx, wy, wz, ww))
    x, y, z, w = rows[max(range(4), key=diagonal.__getitem__)]
    n = math.sqrt(x * x + y * y + z * z + w * w)
    n = -n if w / n < 0 else n
    return x / n, y / n, z / n, w / n


def from_quaternion(q: NDArray[Any]) -> Floats:
    """(..., 4) quaternions xyzw, any non-zero length, to (..., 3, 3) rotations."""
    q = np.asarray(q, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    m = np.empty((*q.shape[:-1], 3, 3))
    m[..., 0, 0], m[..., 0, 1], m[..., 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    m[..., 1, 0], m[..., 1, 1], m[..., 1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    m[..., 2, 0], m[..., 2, 1], m[..., 2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    return m


def is_rotation(R: NDArray[Any], tolerance: float) -> Bools:
    """(...,) whether each (..., 3, 3) matrix is a rotation up to `tolerance` in R^T R; False where numbers are not finite."""
    R = np.asarray(R, np.float64)
    if R.ndim == 2:
        return np.asarray(_is_rotation(R, tolerance))
    is_small = np.abs(R).max(axis=(-2, -1)) < 2  # NaN is not, and nothing below overflows
    R = np.where(is_small[..., None, None], R, 0.0)
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-2, -1))
    return np.asarray(is_small & (off <= tolerance) & (np.linalg.det(R) > 0))


def _is_rotation(R: Floats, tolerance: float) -> bool:
    """`is_rotation` of one matrix by plain floats."""
    a, b, c = R.tolist()
    if not all(abs(x) < 2 for x in (*a, *b, *c)):
        return False
    off = max(abs(x) for row in _gram_less_one(a, b, c) for x in row)
    return off <= tolerance and _determinant(a, b, c) > 0


def _gram_less_one(a: list[float], b: list[float], c: list[float]) -> list[list[float]]:
    """R^T R - I, by the rows a, b, c of R."""
    return [[a[i] * a[j] + b[i] * b[j] + c[i] * c[j] - (1.0 if i == j else 0.0) for j in range(3)] for i in range(3)]


def _determinant(a: list[float], b: list[float], c: list[float]) -> float:
    """Determinant of the matrix with rows a, b, c."""
    return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])


def normalise(R: NDArray[Any]) -> Floats:
    """Nearest rotation to (..., 3, 3) matrices that rounding moved off SO(3)."""
    R = np.asarray(R, np.float64)
    if R.ndim == 2 and np.isfinite(R).all():
        return _normalise_one(R)
    for _ in range(6):
        # Newton and Schulz's iteration for the polar factor squares the distance; far off the singular vectors tell.
        off = portable.product(np.swapaxes(R, -1, -2), R) - np.eye(3)
        largest = np.abs(off).max(initial=0.0)
        if not largest < 0.1:
            return _nearest(R)
        R = R - 0.5 * portable.product(R, off)
        if largest < 1e-9:
            break
    return R if bool(np.all(np.linalg.det(R) > 0)) else _nearest(R)


def _normalise_one(R: Floats) -> Floats:
    """Nearest rotation to one matrix by plain floats, with the same bits as `normalise`."""
    rows = R.tolist()
    for _ in range(6):
        off = _gram_less_one(*rows)
        largest = max(abs(x) for row in off for x in row)
        if not largest < 0.1:
            return _nearest(np.array(rows))
        rows = [[r[j] - 0.5 * (r[0] * off[0][j] + r[1] * off[1][j] + r[2] * off[2][j]) for j in range(3)] for r in rows]
        if largest < 1e-9:
            break
    return np.array(rows) if _determinant(*rows) > 0 else _nearest(np.array(rows))


def _nearest(R: Floats) -> Floats:
    """Nearest rotations to matrices (..., 3, 3), by SVD."""
    u, _, vt = np.linalg.svd(R)
    d = np.sign(np.linalg.det(u @ vt))
    u[..., :, 2] *= d[..., None]
    return np.asarray(u @ vt)


def euler_rpy(R: NDArray[Any]) -> Floats:
    """(..., 3) roll, pitch, yaw in rad with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    R = np.asarray(R, np.float64)
    roll = portable.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = portable.arctan2(-R[..., 2, 0], portable.hypot(R[..., 0, 0], R[..., 1, 0]))
    yaw = portable.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)


def from_euler_rpy(rpy: NDArray[Any]) -> Floats:
    """(..., 3) roll, pitch, yaw in rad to Rz(yaw) Ry(pitch) Rx(roll)."""
    rpy = np.asarray(rpy, np.float64)
    axes = np.eye(3)
    level = portable.product(exp(rpy[..., 2:3] * axes[2]), exp(rpy[..., 1:2] * axes[1]))
    return portable.product(level, exp(rpy[..., 0:1] * axes[0]))
