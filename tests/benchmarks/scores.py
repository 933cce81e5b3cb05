"""Errors of poses (N, 4, 4) against the truth's, in m and deg, as the tables of the peers give them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3

Floats = NDArray[np.float64]


def ate(estimate: Floats, truth: Floats) -> float:
    """ATE, m, rmse, rotation and translation aligned over positions."""
    p, q = estimate[:, :3, 3], truth[:, :3, 3]
    T, _, _ = se3.umeyama(p, q)
    return float(np.sqrt(np.mean(np.sum((se3.apply(T, p) - q) ** 2, axis=1))))


def rotation_rpe(estimate: Floats, truth: Floats, metres: float = 10.0) -> float:
    """Every pose with the first one at least so many metres further along the truth, deg, rmse."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    last = np.searchsorted(along, along + metres)
    first = np.flatnonzero(last < len(along))
    if not len(first):
        return float("nan")
    last = last[first]
    e = se3.relative(se3.relative(truth[first], truth[last]), se3.relative(estimate[first], estimate[last]))
    return float(np.degrees(np.sqrt(np.mean(so3.angle(e[:, :3, :3]) ** 2))))


def origin(estimate: Floats, truth: Floats) -> float:
    """ATE, m, rmse, with the first pose on the first true pose."""
    e, t = (se3.relative(poses[0], poses)[:, :3, 3] for poses in (estimate, truth))
    return float(np.sqrt(np.mean(np.sum((e - t) ** 2, axis=1))))
