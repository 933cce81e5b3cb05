"""The features of one scan in hashed grids: what the next scan of `loam-odom`, `loam` and `lego-loam` is registered on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.feature_grid import build
from lslam.preprocessing.features import FeaturePoints, Features

Grid = tuple[
    NDArray[np.float64], NDArray[np.uint16], NDArray[np.int32], NDArray[np.int64], NDArray[np.int32]
]  # fmt: skip

CELL = 1.0  # m
# m, how far a counterpart may lie: the rings of sixteen beams are that far apart on the ground at 10 m.
REACH = 2.0


@dataclass(frozen=True)
class FeatureScan:
    """Less sharp edges and less planar points of a scan, world frame, in grids of cells of `size`, m."""

    features: Features
    T_world_lidar: NDArray[np.float64]
    edges: Grid
    planes: Grid
    size: float = CELL


def feature_scan(features: Features, T_world_lidar: NDArray[np.float64]) -> FeatureScan:
    """Index the features of a scan at its pose (4, 4)."""
    R, t = np.ascontiguousarray(T_world_lidar[:3, :3]), np.ascontiguousarray(T_world_lidar[:3, 3])

    def grid(part: FeaturePoints) -> Grid:
        return build(part.points, part.rings, R, t, CELL)

    return FeatureScan(features, T_world_lidar, grid(features.less_edges), grid(features.less_planes))
