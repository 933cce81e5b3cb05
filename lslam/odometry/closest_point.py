"""Planes as their closest point to the origin (Geneva et al. 2018): p = n d for the plane n . x = d.

Three numbers for three degrees of freedom, and the sign of the normal drops out. It is singular where d = 0, so that a plane
is kept in the frame of a sensor that saw it, its anchor.
"""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import so3
from lslam.core.types.arrays import Floats


def split(cp: Floats) -> tuple[Floats, Floats]:
    """Normals (..., 3) and distances (...) of closest points (..., 3), m."""
    distance = np.linalg.norm(cp, axis=-1)
    return cp / distance[..., None], distance


def seen_from(cp: Floats, T: Floats) -> Floats:
    """Closest points (..., 3) in frame a of planes given in frame b; T : (..., 4, 4) T_b_a."""
    n, d = split(cp)
    ahead = d - np.einsum("...i,...i->...", n, T[..., :3, 3])
    return np.asarray(np.einsum("...ji,...j->...i", T[..., :3, :3], n) * ahead[..., None])


def linearised(cp: Floats, T_world_anchor: Floats, T_world_lidar: Floats) -> tuple[Floats, Floats, Floats]:
    """Planes as a LiDAR sees them, and how that changes with its pose and with the planes.

    cp : (K, 3) in their anchors, m; T_world_anchor, T_world_lidar : (K, 4, 4)

    Returns
    -------
    (K, 3) closest points in the LiDAR frames; (K, 3, 6) by t' = t + d[:3], R' = exp(d[3:]) R of the LiDAR, world axes;
    (K, 3, 3) by `cp`
    """
    n, d = split(cp)
    Ra, Rl = T_world_anchor[:, :3, :3], T_world_lidar[:, :3, :3]
    n_world = np.einsum("kij,kj->ki", Ra, n)
    n_lidar = np.einsum("kji,kj->ki", Rl, n_world)
    offset = np.einsum("kji,kj->ki", Ra, T_world_lidar[:, :3, 3] - T_world_anchor[:, :3, 3])
    ahead = d - np.einsum("ki,ki->k", n, offset)
    by_pose = np.empty((len(cp), 3, 6))
    by_pose[:, :, :3] = -n_lidar[:, :, None] * n_world[:, None, :]
    by_pose[:, :, 3:] = ahead[:, None, None] * (np.swapaxes(Rl, 1, 2) @ so3.hat(n_world))
    across = (np.eye(3) - n[:, :, None] * n[:, None, :]) / d[:, None, None]
    along = n - np.einsum("kij,kj->ki", across, offset)
    by_plane = ahead[:, None, None] * (np.swapaxes(Rl, 1, 2) @ Ra @ across) + n_lidar[:, :, None] * along[:, None, :]
    return n_lidar * ahead[:, None], by_pose, by_plane


def covariance(cp: Floats, count: float, mean: Floats, scatter: Floats, variance: float) -> Floats:
    """(3, 3) m2 of a closest point (3,) that `count` points fitted, each off the plane with `variance`, m2.

    mean (3,), scatter (3, 3) : m, m2, first moment and covariance of the points
    The inverse of the Fisher information: n . x - d changes with the closest point by (I - n nT) x / d - n.
    """
    n, d = split(cp)
    across = (np.eye(3) - np.outer(n, n)) / d
    along = across @ mean - n
    return np.asarray(np.linalg.inv(count * (across @ scatter @ across + np.outer(along, along)) / variance))
