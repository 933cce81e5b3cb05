"""Linear algebra for kernels: eigenvalues, rotations, blocks of normal equations, factors of definite and banded matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, kernel


@inline
def plane_of(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Eigenvalues l0 <= l1 <= l2 of a symmetric 3x3 matrix and the unit eigenvector of l0.

    Trigonometric solution (Smith 1961); the eigenvector is the longest cross product of two rows of A - l0 I. Returns
    (l0, l1, l2, nx, ny, nz).
    """
    q = (xx + yy + zz) / 3.0
    off = xy * xy + xz * xz + yz * yz
    p2 = (xx - q) ** 2 + (yy - q) ** 2 + (zz - q) ** 2 + 2.0 * off
    if p2 < 1e-30:
        return q, q, q, 0.0, 0.0, 1.0
    p = math.sqrt(p2 / 6.0)
    a, b, c = (xx - q) / p, (yy - q) / p, (zz - q) / p
    d, e, f = xy / p, xz / p, yz / p
    half = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
    phi = math.acos(min(1.0, max(-1.0, half))) / 3.0
    l2 = q + 2.0 * p * math.cos(phi)
    l0 = q + 2.0 * p * math.cos(phi + 2.0943951023931953)
    l1 = 3.0 * q - l0 - l2
    rx, ry, rz = xx - l0, yy - l0, zz - l0
    ax, ay, az = xy * yz - xz * ry, xz * xy - rx * yz, rx * ry - xy * xy
    bx, by, bz = xy * rz - xz * yz, xz * xz - rx * rz, rx * yz - xy * xz
    cx, cy, cz = ry * rz - yz * yz, yz * xz - xy * rz, xy * yz - ry * xz
    na, nb, nc = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
    if nb > na and nb >= nc:
        ax, ay, az, na = bx, by, bz, nb
    elif nc > na:
        ax, ay, az, na = cx, cy, cz, nc
    if na < 1e-60:
        return l0, l1, l2, 0.0, 0.0, 1.0
    s = 1.0 / math.sqrt(na)
    return l0, l1, l2, ax * s, ay * s, az * s


@kernel
def eigen(matrix: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (n,) and eigenvectors in columns (n, n) of a small symmetric matrix, by cyclic Jacobi rotations.

    The last bits of LAPACK's results depend on vendor and threads; these loops give the same bytes everywhere.
    """
    n = len(matrix)
    a = matrix.copy()
    v = np.zeros((n, n))
    for i in range(n):
        v[i, i] = 1.0
    for _ in range(30):
        off = 0.0
        total = 0.0
        for i in range(n):
            total += a[i, i] * a[i, i]
            for j in range(i + 1, n):
                off += a[i, j] * a[i, j]
        if off <= 1e-24 * total or off == 0.0:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    akp, akq = a[k, p], a[k, q]
                    a[k, p] = c * akp - s * akq
                    a[k, q] = s * akp + c * akq
                for k in range(n):
                    apk, aqk = a[p, k], a[q, k]
                    a[p, k] = c * apk - s * aqk
                    a[q, k] = s * apk + c * aqk
                for k in range(n):
                    vkp, vkq = v[k, p], v[k, q]
                    v[k, p] = c * vkp - s * vkq
                    v[k, q] = s * vkp + c * vkq
    values = np.empty(n)
    for i in range(n):
        values[i] = a[i, i]
    return values, v


@inline
def rotate_in_place(R: Floats, wx: float, wy: float, wz: float) -> None:
    """R <- exp((wx, wy, wz)) R in place, then back onto SO(3) by Gram-Schmidt of its rows."""
    theta2 = wx * wx + wy * wy + wz * wz
    theta = math.sqrt(theta2)
    if theta2 < 1e-12:
        a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    else:
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        cx, cy, cz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        dx, dy, dz = wy * cz - wz * cy, wz * cx - wx * cz, wx * cy - wy * cx
        R[0, j] = x + a * cx + b * dx
        R[1, j] = y + a * cy + b * dy
        R[2, j] = z + a * cz + b * dz
    s = 1.0 / math.sqrt(R[0, 0] ** 2 + R[0, 1] ** 2 + R[0, 2] ** 2)
    for j in range(3):
        R[0, j] *= s
    d = R[0, 0] * R[1, 0] + R[0, 1] * R[1, 1] + R[0, 2] * R[1, 2]
    for j in range(3):
        R[1, j] -= d * R[0, j]
    s = 1.0 / math.sqrt(R[1, 0] ** 2 + R[1, 1] ** 2 + R[1, 2] ** 2)
    for j in range(3):
        R[1, j] *= s
    R[2, 0] = R[0, 1] * R[1, 2] - R[0, 2] * R[1, 1]
    R[2, 1] = R[0, 2] * R[1, 0] - R[0, 0] * R[1, 2]
    R[2, 2] = R[0, 0] * R[1, 1] - R[0, 1] * R[1, 0]


@inline
def add_matrix(
    H: Floats, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, rx: float, ry: float, rz: float
) -> None:
    """Upper triangle of H += J^T M J, with J = [I, -hat(r)] and M the symmetric matrix xx..zz."""
    H[0, 0] += xx
    H[0, 1] += xy
    H[0, 2] += xz
    H[1, 1] += yy
    H[1, 2] += yz
    H[2, 2] += zz
    # B = -M hat(r), the block between translation and rotation.
    b00, b01, b02 = xz * ry - xy * rz, xx * rz - xz * rx, xy * rx - xx * ry
    b10, b11, b12 = yz * ry - yy * rz, xy * rz - yz * rx, yy * rx - xy * ry
    b20, b21, b22 = zz * ry - yz * rz, xz * rz - zz * rx, yz * rx - xz * ry
    H[0, 3] += b00
    H[0, 4] += b01
    H[0, 5] += b02
    H[1, 3] += b10
    H[1, 4] += b11
    H[1, 5] += b12
    H[2, 3] += b20
    H[2, 4] += b21
    H[2, 5] += b22
    # hat(r) B
    H[3, 3] += ry * b20 - rz * b10
    H[3, 4] += ry * b21 - rz * b11
    H[3, 5] += ry * b22 - rz * b12
    H[4, 4] += rz * b01 - rx * b21
    H[4, 5] += rz * b02 - rx * b22
    H[5, 5] += rx * b12 - ry * b02


@inline
def add_gradient(g: Floats, px: float, py: float, pz: float, rx: float, ry: float, rz: float) -> None:
    """g += J^T p, with J = [I, -hat(r)] and p = M e summed over the matches."""
    g[0] += px
    g[1] += py
    g[2] += pz
    g[3] += ry * pz - rz * py
    g[4] += rz * px - rx * pz
    g[5] += rx * py - ry * px


@inline
def invert_symmetric(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Inverse of a symmetric positive definite 3x3 matrix, by cofactors: xx, xy, xz, yy, yz, zz."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    w = 1.0 / (xx * a + xy * b + xz * c)
    return w * a, w * b, w * c, w * (xx * zz - xz * xz), w * (xy * xz - xx * yz), w * (xx * yy - xy * xy)


@inline
def rotate_symmetric(R: Floats, q: Floats) -> tuple[float, float, float, float, float, float]:
    """R C R^T of a symmetric matrix given by its six entries: xx, xy, xz, yy, yz, zz."""
    a00 = R[0, 0] * q[0] + R[0, 1] * q[1] + R[0, 2] * q[2]
    a01 = R[0, 0] * q[1] + R[0, 1] * q[3] + R[0, 2] * q[4]
    a02 = R[0, 0] * q[2] + R[0, 1] * q[4] + R[0, 2] * q[5]
    a10 = R[1, 0] * q[0] + R[1, 1] * q[1] + R[1, 2] * q[2]
    a11 = R[1, 0] * q[1] + R[1, 1] * q[3] + R[1, 2] * q[4]
    a12 = R[1, 0] * q[2] + R[1, 1] * q[4] + R[1, 2] * q[5]
    a20 = R[2, 0] * q[0] + R[2, 1] * q[1] + R[2, 2] * q[2]
    a21 = R[2, 0] * q[1] + R[2, 1] * q[3] + R[2, 2] * q[4]
    a22 = R[2, 0] * q[2] + R[2, 1] * q[4] + R[2, 2] * q[5]
    return (
        a00 * R[0, 0] + a01 * R[0, 1] + a02 * R[0, 2],
        a00 * R[1, 0] + a01 * R[1, 1] + a02 * R[1, 2],
        a00 * R[2, 0] + a01 * R[2, 1] + a02 * R[2, 2],
        a10 * R[1, 0] + a11 * R[1, 1] + a12 * R[1, 2],
        a10 * R[2, 0] + a11 * R[2, 1] + a12 * R[2, 2],
        a20 * R[2, 0] + a21 * R[2, 1] + a22 * R[2, 2],
    )


@inline
def extent(values: NDArray[Any]) -> tuple[Any, Any]:
    """Minimum and maximum of the values (N,), N > 0; both are NaN when a value is NaN, as in NumPy."""
    low = high = values[0]
    for value in values:
        # Only NaN differs from itself. No value compares as smaller or larger than NaN, so that it stays.
        if value < low or value != value:
            low = value
        if value > high or value != value:
            high = value
    return low, high


# Cholesky factors with the same bits for any number of threads, unlike those of LAPACK. Rows and columns are first scaled to a
# unit diagonal, since metres and radians differ. Inner loops run along rows and sum no terms, so that they are vectorised
# without changing the order of sums. The result of a matrix that is not positive definite is NaN.
@inline
def _factorise(A: Floats, scale: Floats, L: Floats, column: Floats) -> None:
    """Write the Cholesky factor of A (N, N), scaled to a unit diagonal, into L (N, N), lower triangle: L L^T = S A S.

    scale : (N,) takes the diagonal of S, 1 / sqrt(A_ii); column : (N,) workspace
    """
    n = len(A)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(A[i, i])
    for i in range(n):
        for j in range(i + 1):
            L[i, j] = A[i, j] * scale[i] * scale[j]
    for k in range(n):
        pivot = math.sqrt(L[k, k])
        L[k, k] = pivot
        for i in range(k + 1, n):
            L[i, k] /= pivot
            column[i] = L[i, k]
        for i in range(k + 1, n):
            factor = column[i]
            for j in range(k + 1, i + 1):
                L[i, j] -= factor * column[j]


@kernel
def inverse(A: Floats) -> Floats:
    """Inverse (N, N) of the positive definite A (N, N), exactly symmetric."""
    n = len(A)
    scale, L, column, W = np.empty(n), np.zeros((n, n)), np.empty(n), np.zeros((n, n))
    _factorise(A, scale, L, column)
    for i in range(n):
        W[i, i] = 1.0
        for k in range(i):
            factor = L[i, k]
            for j in range(k + 1):
                W[i, j] -= factor * W[k, j]
        for j in range(i + 1):
            W[i, j] /= L[i, i]
    out = np.zeros((n, n))
    for k in range(n):
        for i in range(k + 1):
            factor = W[k, i]
            for j in range(i + 1):
                out[i, j] += factor * W[k, j]
    for i in range(n):
        for j in range(i + 1):
            out[i, j] *= scale[i] * scale[j]
            out[j, i] = out[i, j]
    return out


@kernel
def complement(A: Floats, B: Floats, C: Floats) -> Floats:
    """Schur complement C - B^T A^-1 B (M, M) of A (N, N) with B (N, M) and symmetric C (M, M), symmetric to the last bit."""
    n, m = B.shape
    scale, L, column, X = np.empty(n), np.zeros((n, n)), np.empty(n), np.empty((n, m))
    _factorise(A, scale, L, column)
    for i in range(n):
        for j in range(m):
            X[i, j] = B[i, j] * scale[i]
        for k in range(i):
            factor = L[i, k]
            for j in range(m):
                X[i, j] -= factor * X[k, j]
        for j in range(m):
            X[i, j] /= L[i, i]
    out = C.copy()
    for k in range(n):
        for i in range(m):
            factor = X[k, i]
            for j in range(m):
                out[i, j] -= factor * X[k, j]
    return out


@kernel
def solve(A: Floats, b: Floats) -> Floats:
    """Solution x (N,) of A x = b with A (N, N) positive definite and b (N,), by Cholesky factorisation."""
    n = len(b)
    scale, L, column, x = np.empty(n), np.zeros((n, n)), np.empty(n), np.empty(n)
    _factorise(A, scale, L, column)
    for i in range(n):
        x[i] = b[i] * scale[i]
    for k in range(n):
        x[k] /= L[k, k]
        for i in range(k + 1, n):
            x[i] -= L[i, k] * x[k]
    for k in range(n - 1, -1, -1):
        x[k] /= L[k, k]
        for i in range(k):
            x[i] -= L[k, i] * x[k]
    for i in range(n):
        x[i] *= scale[i]
    return x


@kernel
def solve_banded(bands: Floats, values: Floats) -> None:
    """Solve A x = values (n, m) in place by Gaussian elimination; the band of A is destroyed.

    bands : (n, 2 w + 1), bands[i, w + j - i] = A[i, j]

    Rows are not exchanged, which is stable where A is totally positive, as the collocation matrices of B-splines are (de Boor
    and Pinkus 1977).
    """
    n, width = bands.shape
    w = width // 2
    m = values.shape[1]
    for k in range(n):
        for i in range(k + 1, min(k + w + 1, n)):
            factor = bands[i, w + k - i] / bands[k, w]
            if factor == 0.0:
                continue
            for j in range(k + 1, min(k + w + 1, n)):
                bands[i, w + j - i] -= factor * bands[k, w + j - k]
            for c in range(m):
                values[i, c] -= factor * values[k, c]
    for k in range(n - 1, -1, -1):
        for c in range(m):
            left = values[k, c]
            for j in range(k + 1, min(k + w + 1, n)):
                left -= bands[k, w + j - k] * values[j, c]
            values[k, c] = left / bands[k, w]
