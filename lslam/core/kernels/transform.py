"""Points moved: by one rigid transform, by the motion of the sensor within a sweep, by the HDL-64E's vertical correction."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import kernel


@kernel
def transform(points: NDArray[np.float32], T: Floats, out: NDArray[np.float32]) -> None:
    """Write T (4, 4) applied to points (N, 3), m, into `out` (N, 3); computed in float64."""
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        for j in range(3):
            out[i, j] = T[j, 0] * x + T[j, 1] * y + T[j, 2] * z + T[j, 3]


@kernel
def deskew(points: Any, times: NDArray[np.float32], start: float, step: float, knots: Floats, out: Any) -> None:
    """Write points (N, 3), m, transformed by the pose at their times (N,), s, to `out` (N, 3).

    A time that is not finite counts as 0.
    knots : (K, 3, 4) transforms at start, start + step, ..., s. Matrices are interpolated linearly between two knots, and
        extrapolated from the outer pair before the first and after the last one.
    """
    last = len(knots) - 2
    for i in range(len(points)):
        s = (times[i] - start) / step
        if not np.isfinite(s):
            s = -start / step
        k = min(max(int(np.floor(s)), 0), last)
        b = s - k
        a = 1.0 - b
        p, q = knots[k], knots[k + 1]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(3):
            out[i, j] = (
                (a * p[j, 0] + b * q[j, 0]) * x
                + (a * p[j, 1] + b * q[j, 1]) * y
                + (a * p[j, 2] + b * q[j, 2]) * z
                + a * p[j, 3]
                + b * q[j, 3]
            )


@kernel
def rotate_up(points: Any, sine: float, cosine: float) -> None:
    """Rotate every point (N, 3) about p x z, in place, by the angle of `sine` and `cosine`; positive lifts the point.

    The axis is horizontal and perpendicular to p, so Rodrigues' formula needs no trigonometry: the horizontal range h
    becomes h cos - z sin and the height z cos + h sin. Points on the z axis have no such axis and are unchanged, as is NaN.
    """
    one, s, c = np.float32(1), np.float32(sine), np.float32(cosine)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        h = np.sqrt(x * x + y * y)
        if h != 0:
            share = c - z * s * (one / h)
            points[i, 0] = x * share
            points[i, 1] = y * share
            points[i, 2] = z * c + h * s
