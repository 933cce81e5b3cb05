"""Banded systems of equations, without LAPACK: the same bytes on every processor."""

from __future__ import annotations

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import kernel


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
