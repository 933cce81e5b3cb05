"""Which planes of a scan are which landmarks: by normal, distance, extent and a chi-square gate."""

from __future__ import annotations

import numpy as np

from lslam.core.types.arrays import Floats, Longs
from lslam.odometry import closest_point
from lslam.odometry.plane_factors import Sightings, sighting_residuals
from lslam.odometry.plane_segmentation import Planes, turned
from lslam.odometry.plane_values import PLANE_SIZE, SHARED, STATE_SIZE
from lslam.odometry.plane_window import PlaneWindow

# Cosine of 10 deg between normals, and m between planes, along the normal at what the scan saw.
ALIKE, CLOSE = 0.985, 0.5
# m, by which boxes of one plane may miss each other.
APART = 3.0
# 99.9 % quantile of chi-square with three degrees of freedom.
GATE = 16.27


def associate(window: PlaneWindow, planes: Planes, covariance: Floats) -> Longs:
    """(K,) landmark of each plane, -1 where it is none of them.

    window : its newest state predicted; covariance : (27 + 3 M) square of that, from `joint_covariance`
    """
    found = np.full(len(planes), -1)
    which, landmark = _candidates(window, planes)
    if len(which) == 0:
        return found
    states, covariances = np.full(len(which), window.values.states - 1), planes.covariance[which]
    seen = Sightings(states, landmark, planes.cp[which], np.asarray(np.linalg.inv(covariances), np.float64))
    r, by_pose, by_plane = sighting_residuals(window.values, seen, window.landmarks.anchors, window.T_imu_lidar)
    J = np.concatenate([by_pose, by_plane], axis=2)
    at = np.concatenate([
        np.broadcast_to(SHARED + np.arange(6), (len(which), 6)),
        SHARED + STATE_SIZE + PLANE_SIZE * landmark[:, None] + np.arange(PLANE_SIZE),
    ], axis=1)  # fmt: skip
    S = J @ covariance[at[:, :, None], at[:, None, :]] @ np.swapaxes(J, 1, 2) + covariances
    squares = np.einsum("ki,ki->k", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
    # The nearest landmark of each plane: the last one written is the smallest.
    for k in np.argsort(-squares, kind="stable"):
        if squares[k] < GATE:
            found[which[k]] = landmark[k]
    return found


def _candidates(window: PlaneWindow, planes: Planes) -> tuple[Longs, Longs]:
    """Pairs of planes and landmarks that are alike, near, and overlap as far as was seen."""
    marks, T = window.landmarks, window.T_world_lidar
    expected = closest_point.seen_from(window.values.planes, np.linalg.inv(marks.anchors) @ T)
    n, _ = closest_point.split(planes.cp)
    m, e = closest_point.split(expected)
    # Of a landmark on whose other side the sensor is meant to be, the normal points the other way.
    cosine = n @ m.T
    off = np.abs(planes.means @ m.T - e)
    lows, highs = turned(planes, T)
    is_near = (
        (lows[:, None] - APART < marks.highs[None]) & (highs[:, None] + APART > marks.lows[None])
    ).all(axis=2)  # fmt: skip
    which, landmark = np.nonzero((cosine > ALIKE) & (off < CLOSE) & is_near)
    return which, landmark
