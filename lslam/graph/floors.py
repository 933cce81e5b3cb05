"""Consensus of the floor planes of keyframes on one plane, before they enter the graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.graph.problem import FloorPlane

Floats = NDArray[np.float64]

# Largest difference of two measurements of one flat floor, m and rad.
NOISE_M, NOISE_RAD = 0.05, np.deg2rad(0.5)
# Least share of inliers: on hills a half or fewer, on flat streets nearly all.
MOST = 0.8


def on_one_plane(
    floors: Sequence[FloorPlane], poses: Floats, distances: Floats, config: GraphConfig
) -> list[FloorPlane]:
    """The floors consistent with the one that has the most support; none where so few are that the ground is not flat.

    poses : (K, 4, 4) of the keyframes by odometry, with the drift of `config`; distances : (K,) m travelled
    """
    if not floors:
        return []
    of = np.array([floor.keyframe for floor in floors])
    normals = np.einsum("fij,fj->fi", poses[of, :3, :3], np.stack([floor.normal for floor in floors]))
    feet = poses[of, :3, 3] - np.array([[floor.offset] for floor in floors]) * normals
    way = np.abs(distances[of, None] - distances[None, of])
    turn = np.deg2rad(config.drift_deg_per_100m) / 100 * way
    between = feet[None, :] - feet[:, None]
    rise = np.abs(np.einsum("fi,fgi->fg", normals, between))
    bend = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    slack = NOISE_M + 0.01 * config.drift_percent * way + turn * np.linalg.norm(between, axis=-1)
    agrees = (bend <= NOISE_RAD + turn) & (np.maximum(rise, rise.T) <= slack)
    inliers = agrees[agrees.sum(1).argmax()]
    if inliers.sum() < MOST * len(floors):
        return []
    return [floor for floor, is_right in zip(floors, inliers, strict=True) if is_right]
