"""Splines and smoothing against SciPy's, which go through LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from lslam.simulation.curve import gaussian_smooth, interpolating_spline


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("count", [13, 400])
def test_quintic_splines(closed: bool, count: int) -> None:
    rng = np.random.default_rng(count)
    x = np.cumsum(rng.uniform(0.45, 0.55, count))
    y = np.cumsum(rng.normal(size=(count, 2)), axis=0)
    if closed:
        y[-1] = y[0]
    ours = interpolating_spline(x, y, closed)
    theirs = make_interp_spline(x, y, k=5, bc_type="periodic" if closed else None)
    at = np.linspace(x[0], x[-1], 2000)
    for order, tolerance in ((0, 1e-11), (1, 1e-10), (2, 1e-9)):
        np.testing.assert_allclose(ours(at, nu=order), theirs(at, nu=order), rtol=0, atol=tolerance * max(1, np.ptp(y)))
    if closed:
        ends = np.array([ours(x[[0, -1]], nu=order) for order in range(5)])
        np.testing.assert_allclose(ends[:, 0], ends[:, 1], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("mode", ["reflect", "wrap"])
def test_smoothing(mode: str) -> None:
    values = np.random.default_rng(1).normal(size=(200, 2))
    theirs = gaussian_filter1d(values, 3.3, axis=0, mode=mode)
    np.testing.assert_allclose(gaussian_smooth(values, 3.3, mode), theirs, rtol=0, atol=1e-14)  # type: ignore[arg-type]
