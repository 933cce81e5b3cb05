"""One step of a Kalman filter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Innovations beyond so many sigma are outliers and count accordingly less.
OUTLIER = 4.0


def update(x: Floats, P: Floats, H: Floats, rest: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Mean (N,) and covariance (N, N) after the innovation `rest` (M,) with H (M, N) and `noise` (M, M).

    An outlier's noise is raised to what it shows.
    """
    S = H @ P @ H.T + noise
    beyond = surprise(rest, S)
    if beyond > 1:
        noise = noise * beyond
        S = H @ P @ H.T + noise
    K = np.linalg.solve(S, H @ P).T
    left = np.eye(len(x)) - K @ H
    return x + K @ rest, left @ P @ left.T + K @ noise @ K.T


def surprise(rest: Floats, expected: Floats) -> float:
    """Squared Mahalanobis length of the innovation (M,), over the outlier threshold."""
    return float(rest @ np.linalg.solve(expected, rest)) / (len(rest) * OUTLIER**2)
