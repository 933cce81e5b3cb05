"""Positive definite matrices: Cholesky factors with the same bits for any number of threads, unlike those of LAPACK.

Rows and columns are first scaled to a unit diagonal, since metres and radians differ. Inner loops run along rows and sum no
terms, so that they are vectorised without changing the order of sums. The result of a matrix that is not positive definite is
NaN.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, kernel

Floats = NDArray[np.float64]


@inline
def _factorise(A: Floats, scale: Floats, L: Floats, column: Floats) -> None:
    """L (N, N) lower triangular with L L^T = S A S, S = diag(`scale`) (N,), which is found first."""
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
    """Inverse (N, N) of A (N, N), symmetric to the last bit."""
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
def solved(A: Floats, b: Floats) -> Floats:
    """Solution x (N,) of A x = b with A (N, N) and b (N,)."""
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
