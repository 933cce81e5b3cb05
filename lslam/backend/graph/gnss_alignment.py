"""Robust rigid alignment of a trajectory with GNSS fixes.

Roll about a straight street and the tilt of a short path are not observable from fixes: the world's up direction is a
measurement beside them, which they outweigh as soon as the geometry allows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.geometry import se3, so3
from lslam.core.geometry.noise import quantile
from lslam.core.types.arrays import Bools, Floats

# RANSAC samples, and the least distance of a pair as a share of the largest.
TRIALS, APART_SHARE = 500, 0.5
# Least share of inliers.
MAJORITY_SHARE = 0.5


@dataclass(frozen=True)
class GnssAlignment:
    """T_enu_world (4, 4); inliers : (F,) bool; residuals : (F, 3) m, east, north, up, of fixes minus trajectory."""

    T_enu_world: Floats
    inliers: Bools
    residuals: Floats


def align(
    antenna: Floats, fixes: Floats, sigmas: Floats, slack: Floats, up: Floats, up_sigma: float, min_fixes: int
) -> GnssAlignment | None:
    """Fit the antenna's positions in the world to its fixes; None with fewer than `min_fixes` or half of them as inliers.

    Parameters
    ----------
    antenna : (F, 3) m, in the world of the trajectory; fixes : (F, 3) m, east, north, up; sigmas : (F, 3) m
    slack : (F,) m, one sigma of odometry's drift at each, in the inlier test
    up : (3,) unit, up in the world of the trajectory; up_sigma : rad
    """
    if len(antenna) < max(min_fixes, 2):
        return None
    level = so3.least_rotation(up, np.array([0.0, 0.0, 1.0]))
    a = antenna @ level.T
    judged = np.sqrt(sigmas**2 + slack[:, None] ** 2 + _tilted(a - np.median(a, axis=0), up_sigma) ** 2)
    T = _consensus(a, fixes, judged)
    if T is None:
        return None
    # Repeated, since outliers of the first fit may be inliers of the refined one.
    for _ in range(3):
        inliers = _fits(T, a, fixes, judged)
        if inliers.sum() < max(min_fixes, MAJORITY_SHARE * len(a)):
            return None
        T = fit_pose(T, a[inliers], fixes[inliers], judged[inliers], up_sigma)
    T_enu_world = T @ se3.make(level, np.zeros(3))
    return GnssAlignment(T_enu_world, inliers, fixes - se3.apply(T_enu_world, antenna))


def _tilted(a: Floats, up_sigma: float) -> Floats:
    """(F, 3) m by which a tilt of one sigma moves points `a` (F, 3): mostly vertically.

    A single sigma for all axes would accept a fix off to the side by an eleventh of the way.
    """
    way, height = np.linalg.norm(a[:, :2], axis=1), np.abs(a[:, 2])
    side = up_sigma * height + 0.5 * up_sigma**2 * way
    return np.column_stack([side, side, up_sigma * way])


def _consensus(a: Floats, fixes: Floats, sigmas: Floats) -> Floats | None:
    """Heading and position by RANSAC over pairs of fixes (4 degrees of freedom)."""
    rng = np.random.default_rng(0)
    reach = float(np.linalg.norm(a[:, :2] - np.median(a[:, :2], axis=0), axis=1).max())
    best: Floats | None = None
    most = (0, 0.0)
    for i, j in rng.integers(0, len(a), (TRIALS, 2)):
        own, other = a[j] - a[i], fixes[j] - fixes[i]
        away = float(np.hypot(own[0], own[1]))
        if away < max(APART_SHARE * reach, 0.5) or not np.isfinite(other).all():
            continue
        R = so3.exp(np.array([0.0, 0.0, np.arctan2(other[1], other[0]) - np.arctan2(own[1], own[0])]))
        T = se3.make(R, 0.5 * (fixes[i] + fixes[j]) - R @ (0.5 * (a[i] + a[j])))
        # The hypothesis has the noise of two fixes.
        count = int(_fits(T, a, fixes, np.sqrt(3) * sigmas).sum())
        # Of equals the farther pair, whose heading is more accurate.
        if (count, away) > most:
            best, most = T, (count, away)
    return best


def _fits(T: Floats, a: Floats, fixes: Floats, sigmas: Floats) -> Bools:
    with np.errstate(invalid="ignore"):
        whitened = ((fixes - se3.apply(T, a)) / sigmas) ** 2
    return np.asarray(np.nan_to_num(whitened.sum(1), nan=np.inf) <= quantile(0.999, 3))


def fit_pose(T: Floats, a: Floats, fixes: Floats, sigmas: Floats, up_sigma: float) -> Floats:
    """Least squares over all six degrees of freedom, with the up direction as prior on the tilt."""
    from scipy.optimize import least_squares

    centre = a.mean(0)

    def moved(x: Floats) -> Floats:
        R = so3.exp(x[3:]) @ T[:3, :3]
        t = se3.apply(T, centre[None])[0] + x[:3] - R @ centre
        return se3.make(R, t)

    def errors(x: Floats) -> Floats:
        M = moved(x)
        tilt = M[:2, :3] @ np.array([0.0, 0.0, 1.0]) / up_sigma
        return np.concatenate([((fixes - se3.apply(M, a)) / sigmas).ravel(), tilt])

    return moved(np.asarray(least_squares(errors, np.zeros(6), loss="soft_l1").x))
