"""Projection of points into cameras, by the parameters of `lslam.core.types.camera.Lens`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, kernel


@inline
def project(x: float, y: float, z: float, lens: NDArray[np.float64]) -> tuple[float, float]:
    """Pixel of a point of the camera's frame, m; NaN where the lens does not see: behind it, or where its model folds back."""
    flat = np.sqrt(x * x + y * y)
    if lens[0] > 0.5:
        angle = np.arctan2(flat, z)
        if not angle <= lens[13]:
            return np.nan, np.nan
        a2 = angle * angle
        out = angle * (1.0 + a2 * (lens[5] + a2 * (lens[6] + a2 * (lens[7] + a2 * lens[8]))))
        share = out / flat if flat > 0.0 else 0.0
        return lens[1] * x * share + lens[3], lens[2] * y * share + lens[4]
    if not (z > 0.0 and flat <= lens[13] * z):
        return np.nan, np.nan
    a, b = x / z, y / z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    radial /= 1.0 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    u = a * radial + 2.0 * lens[7] * a * b + lens[8] * (r2 + 2.0 * a * a)
    v = b * radial + lens[7] * (r2 + 2.0 * b * b) + 2.0 * lens[8] * a * b
    return lens[1] * u + lens[3], lens[2] * v + lens[4]


@kernel
def project_all(points: NDArray[np.float64], lens: NDArray[np.float64], pixels: NDArray[np.float64]) -> None:
    """Write the pixels (N, 2) of points (N, 3) of the camera's frame, m; NaN where the lens does not see."""
    for i in range(len(points)):
        u, v = project(points[i, 0], points[i, 1], points[i, 2], lens)
        pixels[i, 0], pixels[i, 1] = u, v


@kernel
def shifted_means(
    image: NDArray[np.float32], pixels: NDArray[np.float64], weights: NDArray[np.float64], means: NDArray[np.float64]
) -> None:
    """Write the weighted mean of the image over pixels (N, 2) moved by each shift into `means` (2R+1, 2R+1), rows and columns.

    Pixels that some shift moves out of the image are left out of all; zeros where none is left.
    """
    height, width = image.shape
    reach = means.shape[0] // 2
    means[:] = 0.0
    total = 0.0
    for i in range(len(pixels)):
        if not (pixels[i, 0] >= reach and pixels[i, 1] >= reach):
            continue
        u, v = int(np.rint(pixels[i, 0])), int(np.rint(pixels[i, 1]))
        if u + reach >= width or v + reach >= height:
            continue
        total += weights[i]
        for row in range(-reach, reach + 1):
            for column in range(-reach, reach + 1):
                means[row + reach, column + reach] += weights[i] * image[v + row, u + column]
    if total > 0.0:
        means /= total
