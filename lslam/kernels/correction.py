"""Splitting raw (x, y, z, intensity) records and the vertical correction of the HDL-64E, in one pass over a scan."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import kernel

Floats = NDArray[np.float32]


@kernel
def split(raw: Floats, points: Floats, intensity: Floats) -> None:
    """Copy (N, 4) records into points (N, 3) and intensity (N,)."""
    for i in range(raw.shape[0]):
        points[i, 0] = raw[i, 0]
        points[i, 1] = raw[i, 1]
        points[i, 2] = raw[i, 2]
        intensity[i] = raw[i, 3]


@kernel
def rotate_up(points: Any, sine: float, cosine: float) -> None:
    """Rotate every point (N, 3) about p x z, in place, by the angle of `sine` and `cosine`; positive lifts the point.

    The axis is horizontal and perpendicular to p, so Rodrigues' formula needs no trigonometry: the horizontal range h
    becomes h cos - z sin and the height z cos + h sin. Points on the z axis have no such axis and stay; NaN stays NaN.
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
