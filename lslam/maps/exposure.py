"""Brightness of each image by channel, estimated from points that several images show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Bools, Floats

_ROUNDS = 20
_STEP = 1.0 / 255.0  # of a pixel's value: no two of them agree better than that


def image_gains(views: NDArray[np.int32], colours: NDArray[np.uint8], is_view: Bools, images: int) -> Floats:
    """Gains (V, 3) of `images` images, about 1: the value of a pixel is the gain times the colour of its point.

    views, is_view : (N, K) the images that show each point, and where there is one; colours : (N, K, 3)

    Least squares of the logarithms, every point's colour eliminated, with Cauchy weights by the median deviation, since some
    views show what passed before the point. One observation of gain 1 for every image fixes what the points leave open.
    """
    unsaturated = is_view & ((colours > 0) & (colours < 255)).all(2)
    several = unsaturated.sum(1) > 1
    point, slot = np.nonzero(unsaturated[several])
    gains = np.ones((images, 3))
    if not len(point):
        return gains
    view = views[several][point, slot]
    logs = np.log(colours[several][point, slot].astype(np.float64))
    for channel in range(3):
        gains[:, channel] = np.exp(_log_gains(point, view, logs[:, channel], images))
    return gains


def _log_gains(point: NDArray[np.intp], view: NDArray[np.int32], logs: Floats, images: int) -> Floats:
    """Logarithms of the gains (V,) from the logarithm of each observation (M,), by its point and its view."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    points = int(point.max()) + 1
    weight, gain = np.ones(len(logs)), np.zeros(images)
    for _ in range(_ROUNDS):
        total = np.bincount(point, weight, points)
        share = sparse.csr_array((weight, (point, view)), (points, images))
        normal = sparse.diags_array(np.bincount(view, weight, images) + 1.0) - share.T @ (
            sparse.diags_array(1.0 / total) @ share
        )
        mean = np.bincount(point, weight * logs, points) / total
        before, gain = gain, spsolve(sparse.csc_array(normal), np.bincount(view, weight * (logs - mean[point]), images))
        free = np.bincount(point, weight * (logs - gain[view]), points) / total
        residual = logs - gain[view] - free[point]
        scale = max(1.4826 * float(np.median(np.abs(residual))), _STEP)
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        if np.abs(gain - before).max() < _STEP:
            break
    return np.asarray(gain, np.float64)
