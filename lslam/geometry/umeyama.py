"""Least-squares alignment of two point sets (Umeyama 1991)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3

Floats = NDArray[np.float64]


def align(source: NDArray[Any], target: NDArray[Any], with_scale: bool = False) -> tuple[Floats, float, bool]:
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
    return se3.make(R, mean_b - scale * R @ mean_a), scale, determined
