"""The features of one scan in hashed grids: what the next scan of `loam-odom`, `loam` and `lego-loam` is registered on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats, Longs
from lslam.odometry.kernels.feature_grid import build
from lslam.odometry.kernels.feature_residuals import add_normals
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.preprocessing.features import FeaturePoints, Features

Grid = tuple[
    Floats, NDArray[np.uint16], NDArray[np.int32], Longs, NDArray[np.int32]
]  # fmt: skip

# m, how far a counterpart may lie: the rings of sixteen beams are that far apart on the ground at 10 m.
REACH = 2.0
# rad, one sigma: a normal that wavers more is not known.
WAVER = 0.03
# m, one sigma: what is thicker is no surface, but two that meet.
THICK = 0.1


@dataclass(frozen=True)
class FeatureScan:
    """Less sharp edges and less planar points of a scan, world frame, in grids of cells of `size`, m.

    reach : m, how far a counterpart may lie
    """

    features: Features
    T_world_lidar: Floats
    edges: Grid
    planes: Grid
    normals: Floats
    size: float
    reach: float


def surface_size(size: float, grid_step: float) -> float:
    """Edge of voxels, m, of `size` or as large as points of a grid of `grid_step`, m, need: a plane takes six of them."""
    return max(size, 1.5 * grid_step)


def feature_scan(features: Features, T_world_lidar: Floats, grid_step: float = 0.0) -> FeatureScan:
    """Index the features of a scan, thinned by a grid of `grid_step`, m, at its pose (4, 4)."""
    R, t = np.ascontiguousarray(T_world_lidar[:3, :3]), np.ascontiguousarray(T_world_lidar[:3, 3])
    reach = surface_size(REACH, grid_step)
    size = reach / 2

    def grid(part: FeaturePoints) -> Grid:
        return build(part.points, part.rings, R, t, size)

    planes = grid(features.less_planes)
    return FeatureScan(features, T_world_lidar, grid(features.less_edges), planes, _normals(planes[0]), size, reach)


def _normals(points: Floats) -> Floats:
    """(N, 3) normals of the surfaces around points (N, 3), zero where none is found.

    Voxels of half the reach tell them, and before these voxels twice as large, for two rings of a sparse sensor.
    """
    fine, normals = GaussianMap(REACH / 2, capacity=1 << 12), np.zeros_like(points)
    fine.insert(points.astype(np.float32), np.eye(4))
    for around in (fine.coarsen(2), fine):
        add_normals(
            points, around.size, THICK**2, WAVER**2, around.planes, around.keys, around.table, normals
        )  # fmt: skip
    return normals
