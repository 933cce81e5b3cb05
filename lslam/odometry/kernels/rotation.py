"""Rotations in kernels: exponential, logarithm, products, and back onto SO(3)."""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, kernel


@inline
def multiply(A: Floats, B: Floats, out: Floats) -> None:
    """out <- A B, all (3, 3); `out` is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@inline
def exponential(x: float, y: float, z: float, out: Floats) -> None:
    """out (3, 3) <- the rotation by the vector (x, y, z), rad (Rodrigues)."""
    theta2 = x * x + y * y + z * z
    theta = math.sqrt(theta2)
    if theta2 < 1e-10:
        a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    else:
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2
    out[0, 0], out[1, 1], out[2, 2] = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z), 1.0 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@inline
def logarithm(R: Floats, out: Floats) -> None:
    """out (3,) <- the rotation vector of R (3, 3), rad, of angle 0..pi, by the quaternion whose largest term leads."""
    xx, yy, zz = R[0, 0], R[1, 1], R[2, 2]
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    if xx + yy + zz >= max(xx, yy, zz):
        x, y, z, w = a, b, c, 1.0 + xx + yy + zz
    elif xx >= yy and xx >= zz:
        x, y, z, w = 1.0 + xx - yy - zz, R[1, 0] + R[0, 1], R[0, 2] + R[2, 0], a
    elif yy >= zz:
        x, y, z, w = R[1, 0] + R[0, 1], 1.0 - xx + yy - zz, R[2, 1] + R[1, 2], b
    else:
        x, y, z, w = R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], 1.0 - xx - yy + zz, c
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    n = math.sqrt(x * x + y * y + z * z)
    # Near the identity the angle is 2 n / w to the last digit.
    scale = 2.0 / w if n < 1e-9 * w else 2.0 * math.atan2(n, w) / n
    out[0], out[1], out[2] = scale * x, scale * y, scale * z


@inline
def straighten(R: Floats) -> None:
    """R (3, 3) <- the nearest rotation, for a matrix off SO(3) by rounding: one step of Newton, which squares the distance."""
    xx = R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0] + R[2, 0] * R[2, 0]
    yy = R[0, 1] * R[0, 1] + R[1, 1] * R[1, 1] + R[2, 1] * R[2, 1]
    zz = R[0, 2] * R[0, 2] + R[1, 2] * R[1, 2] + R[2, 2] * R[2, 2]
    xy = R[0, 0] * R[0, 1] + R[1, 0] * R[1, 1] + R[2, 0] * R[2, 1]
    xz = R[0, 0] * R[0, 2] + R[1, 0] * R[1, 2] + R[2, 0] * R[2, 2]
    yz = R[0, 1] * R[0, 2] + R[1, 1] * R[1, 2] + R[2, 1] * R[2, 2]
    for i in range(3):
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        R[i, 0] = x + 0.5 * (x * (1.0 - xx) - y * xy - z * xz)
        R[i, 1] = y + 0.5 * (y * (1.0 - yy) - x * xy - z * yz)
        R[i, 2] = z + 0.5 * (z * (1.0 - zz) - x * xz - y * yz)


@inline
def _between(A: Floats, B: Floats, R: Floats, out: Floats) -> None:
    """out (3,) <- rotation vector, rad, of A^T B, which is stored in R (3, 3)."""
    for i in range(3):
        for j in range(3):
            R[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]
    logarithm(R, out)


@kernel
def vector_between(A: Floats, B: Floats) -> Floats:
    """(3,) rotation vector, rad, of A^T B, both rotations (3, 3): from A to B, in the axes of either."""
    out = np.empty(3)
    _between(A, B, np.empty((3, 3)), out)
    return out


@kernel
def apart(A: Floats, B: Floats, lever: float) -> float:
    """Distance of two poses (4, 4), m, with the rotation between them times `lever`, m."""
    out = np.empty(3)
    _between(A, B, np.empty((3, 3)), out)
    move, turn = 0.0, 0.0
    for i in range(3):
        move += (A[i, 3] - B[i, 3]) ** 2
        turn += out[i] * out[i]
    return math.sqrt(move) + lever * math.sqrt(turn)
