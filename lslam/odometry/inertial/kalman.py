"""One step of a Kalman filter."""

from __future__ import annotations

from lslam.core.types.arrays import Floats
from lslam.odometry.kernels import kalman

# Innovations beyond so many sigma are outliers and count accordingly less.
OUTLIER = 4.0


def update(x: Floats, P: Floats, H: Floats, rest: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Mean (N,) and covariance (N, N) after the innovation `rest` (M,) with H (M, N) and `noise` (M, M).

    An outlier's noise is raised to what it shows.
    """
    return kalman.update(x, P, H, rest, noise, OUTLIER)


def surprise(rest: Floats, expected: Floats) -> float:
    """Squared Mahalanobis length of the innovation (M,), over the outlier threshold."""
    return float(kalman.square(rest, expected)) / (len(rest) * OUTLIER**2)
