"""Covariances of poses, from this house's order into gtsam's and back, and chi-square distances and their quantiles.

Here a pose is disturbed as t' = t + d[:3], R' = exp(d[3:]) R: translation first, in the axes of the parent frame.
gtsam disturbs it as T' = T exp(xi): rotation first, in the axes of the body. To first order xi = J d.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import so3


def changes(T: NDArray[Any], after: NDArray[Any]) -> Floats:
    """(..., 6) changes d from poses `T` to `after` (..., 4, 4), world axes, m and rad: t' = t + d[:3], R' = exp(d[3:]) R."""
    turns = so3.log(after[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2))
    return np.concatenate([after[..., :3, 3] - T[..., :3, 3], turns], axis=-1)


def to_body(covariance: NDArray[Any], T: NDArray[Any]) -> Floats:
    """(..., 6, 6) covariances of poses `T` (..., 4, 4) in gtsam's order and axes: rotation first, body axes."""
    J = into_body(T)
    return np.asarray(J @ np.asarray(covariance, np.float64) @ np.swapaxes(J, -1, -2))


def from_body(covariance: NDArray[Any], T: NDArray[Any]) -> Floats:
    """The inverse of `to_body`: covariances in gtsam's order and body axes, with translation first in world axes."""
    J = np.swapaxes(into_body(T), -1, -2)  # orthogonal: the transpose is the inverse
    return np.asarray(J @ np.asarray(covariance, np.float64) @ np.swapaxes(J, -1, -2))


def transport(covariance: NDArray[Any], step: NDArray[Any]) -> Floats:
    """(..., 6, 6) covariance of a pose that is rigidly `step` (..., 3), m, world axes, away from one with `covariance`.

    A rotation error moves what lies ahead.
    """
    F = np.zeros((*np.asarray(step).shape[:-1], 6, 6))
    F[...] = np.eye(6)
    F[..., :3, 3:] = -so3.hat(step)
    return np.asarray(F @ np.asarray(covariance, np.float64) @ np.swapaxes(F, -1, -2))


def rotate(covariance: NDArray[Any], R: NDArray[Any]) -> Floats:
    """(..., 6, 6) covariances in other axes: translation and rotation parts are rotated by `R` (..., 3, 3)."""
    R = np.asarray(R, np.float64)
    B = np.zeros((*R.shape[:-2], 6, 6))
    B[..., :3, :3] = B[..., 3:, 3:] = R
    return np.asarray(B @ np.asarray(covariance, np.float64) @ np.swapaxes(B, -1, -2))


def into_body(T: NDArray[Any]) -> Floats:
    """(..., 6, 6) orthogonal matrices J at poses `T` (..., 4, 4) by which gtsam's body twist is xi = J d of a change d."""
    Rt = np.swapaxes(np.asarray(T, np.float64)[..., :3, :3], -1, -2)
    J = np.zeros((*Rt.shape[:-2], 6, 6))
    J[..., :3, 3:] = J[..., 3:, :3] = Rt
    return J


def squared_distances(error: NDArray[Any], covariance: NDArray[Any]) -> Floats:
    """(P,) squared Mahalanobis distances of `error` (P, n) with its `covariance` (P, n, n) or (n, n)."""
    return np.asarray(np.einsum("ij,ij->i", error, np.linalg.solve(covariance, error[..., None])[..., 0]))


# A loop or a fix within this quantile of its own chi-square distribution is right.
RIGHT_PROBABILITY = 0.999


def quantile(probability: float, dim: int) -> float:
    """The value that a chi-square variable of `dim` degrees of freedom stays below with `probability`.

    As `scipy.stats.chi2.ppf`, whose import takes longer than many a graph.

    >>> round(quantile(0.95, 3), 3)
    7.815
    """
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * dim, probability))


def chance_of_median(median: float, dim: int, count: int) -> float:
    """The probability that the median of `count` chi-square variables of `dim` degrees of freedom stays below `median`.

    >>> round(chance_of_median(quantile(0.95, 3), 3, 1), 3)
    0.95
    >>> round(chance_of_median(quantile(0.5, 3), 3, 33), 3)
    0.5
    """
    from scipy.special import betainc, gammainc

    rank = 0.5 * (count + 1)
    return float(betainc(rank, rank, gammainc(0.5 * dim, 0.5 * median)))
