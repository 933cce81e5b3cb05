"""Quintic splines and Gaussian smoothing for paths, with the same bytes on every processor."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import portable

DEGREE = 5
_REACH = 60  # points from one end after which nothing of it is left: an influence falls by 0.43 from knot to knot


def interpolating_spline(x: NDArray[Any], y: NDArray[Any], closed: bool = False) -> Any:
    """Quintic B-spline (scipy.interpolate.BSpline) through values `y` (N,) or (N, C) at increasing `x` (N,), N > 5.

    closed : the last point is the first one again, and all derivatives agree there
    """
    from scipy.interpolate import BSpline

    from lslam.kernels.banded import solve_banded

    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if closed:
        # Beyond both ends the curve is gone round again, far enough for the ends of the spline not to be felt.
        count = len(x) - 1
        index = np.arange(-_REACH, count + _REACH + 1)
        x, y = x[index % count] + (index // count) * (x[-1] - x[0]), y[index % count]
    half = (DEGREE + 1) // 2
    knots = np.concatenate([np.repeat(x[0], DEGREE + 1), x[half:-half], np.repeat(x[-1], DEGREE + 1)])
    matrix = BSpline.design_matrix(x, knots, DEGREE)
    rows = np.repeat(np.arange(len(x)), np.diff(matrix.indptr))
    bands = np.zeros((len(x), 2 * DEGREE + 1))
    bands[rows, DEGREE + matrix.indices - rows] = matrix.data
    coefficients = y.reshape(len(x), -1).copy()
    solve_banded(bands, coefficients)
    return BSpline(knots, coefficients.reshape(y.shape), DEGREE)


def smoothed(values: NDArray[Any], sigma: float, mode: Literal["reflect", "wrap"] = "reflect") -> NDArray[np.float64]:
    """`values` (N, ...) convolved along their first axis by a Gaussian of `sigma` steps; `mode` as scipy.ndimage's."""
    from scipy.ndimage import correlate1d

    reach = int(4 * sigma + 0.5)
    weights = portable.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(correlate1d(np.asarray(values, np.float64), weights / weights.sum(), axis=0, mode=mode))
