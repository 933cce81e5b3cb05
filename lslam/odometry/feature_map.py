"""What the LOAM family registers features on: those of the last scan, and the feature map.

The features of one scan lie in hashed grids. The map has voxels of edges, read as lines, and a pyramid of planar points, read as
planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.kernels import voxel
from lslam.core.types.state import State, Stateful
from lslam.odometry.kernels.feature_grid import Matches, build
from lslam.odometry.kernels.feature_residuals import add_normals
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import LastKeyframes, LocalMap
from lslam.registration.preprocessing.features import FeaturePoints, Features
from lslam.registration.preprocessing.prepare import NO_TIMES

Grid = tuple[Floats, NDArray[np.uint16], Ints, Longs, Ints]

# m, how far a counterpart may lie: the rings of sixteen beams are that far apart on the ground at 10 m.
MATCH_REACH_M = 2.0
# rad, one sigma: a normal that wavers more is not known.
NORMAL_SIGMA_RAD = 0.03
# m, one sigma: what is thicker is no surface, but two that meet.
SURFACE_SIGMA_M = 0.1


@dataclass(frozen=True)
class FeatureScan:
    """Less sharp edges and less planar points, world, in grids of cells of `size`, m; reach : m, farthest counterpart."""

    features: Features
    T_world_lidar: Floats
    reach: float

    @property
    def size(self) -> float:
        """Edge of a cell, m."""
        return self.reach / 2

    @cached_property
    def edges(self) -> Grid:
        """The less sharp edges."""
        return self._grid(self.features.less_edges)

    @cached_property
    def planes(self) -> Grid:
        """The less planar points."""
        return self._grid(self.features.less_planes)

    @cached_property
    def normals(self) -> Floats:
        """(N, 3) of the surfaces around the less planar points, in the order of their grid."""
        return _normals(self.planes[0])

    def _grid(self, part: FeaturePoints) -> Grid:
        """Grid in the world of one kind of features, given in the LiDAR frame."""
        R, t = np.ascontiguousarray(self.T_world_lidar[:3, :3]), np.ascontiguousarray(self.T_world_lidar[:3, 3])
        return build(part.points, part.rings, R, t, self.size)

    @cached_property
    def _matches(self) -> dict[tuple[str, int], Matches]:
        return {}

    def matches_of(self, kind: str, count: int) -> Matches:
        """Stored matches of `count` points, `kind` edges or planar points, as the last alignment with this scan left them.

        A kernel searches anew only for points that moved away from where they were matched.
        """
        return self._matches.setdefault((kind, count), no_counterparts(count))


def no_counterparts(count: int) -> Matches:
    """Initial state of a search for `count` points."""
    return np.full((count, 3), -1, np.int32), np.full((count, 3, 4), -1.0)


def surface_size(size: float, grid_step: float) -> float:
    """Edge, m, of voxels of planar points: `size`, or larger, so that a voxel holds six points of a grid of `grid_step`, m."""
    return max(size, 1.5 * grid_step)


def feature_scan(features: Features, T_world_lidar: Floats, grid_step: float = 0.0) -> FeatureScan:
    """The features of a scan, thinned by a grid of `grid_step`, m, at its pose (4, 4): indexed where one registers on them."""
    return FeatureScan(features, T_world_lidar, surface_size(MATCH_REACH_M, grid_step))


def to_arrays(features: Features) -> Features:
    """The features with all points computed as arrays, for checkpoints."""
    return features.each(lambda part: FeaturePoints(part.points, part.rings, part.times))


def _normals(points: Floats) -> Floats:
    """(N, 3) unit normals of the surfaces around points (N, 3), zero where there is none.

    They come from voxels of twice half the reach, where there are, for two rings of a sparse sensor; else from half the reach.
    """
    capacity = 1 << max(8, int(np.ceil(np.log2(len(points) + 1))))
    fine, normals = GaussianMap(MATCH_REACH_M / 2, capacity=capacity, reach=np.inf), np.zeros_like(points)
    fine.insert(points.astype(np.float32), np.eye(4))
    for around in (fine.coarsen(2), fine):
        add_normals(
            points,
            around.size,
            SURFACE_SIGMA_M**2,
            NORMAL_SIGMA_RAD**2,
            around.planes,
            around.keys,
            around.table,
            normals,
        )
    return normals


# As LOAM fits its lines: five points at least.
MIN_LINE_POINTS = 5
# m, grid of the less planar points for wide voxels, and where they stand in for the planar ones.
WIDE_GRID = PreprocessConfig().source_voxel


class FeatureMap(Stateful):
    """Less sharp edges and less planar points of past scans, in voxels around the sensor.

    size : m, edge of a voxel of edges; plane_size : m, edge of the smallest voxel of planar points
    reach : m, voxels farther than this from the sensor are given back
    capacity : voxels at first, a quarter of them of edges; it grows
    """

    STATE = ("planes", "edges")

    def __init__(self, size: float, plane_size: float, reach: float, capacity: int = 1 << 16) -> None:
        self.planes = LocalMap(plane_size, reach=reach)
        self.edges = GaussianMap(size, reach=reach, capacity=capacity // 4)
        self._lines = _lines_for(self.edges)

    @property
    def lines(self) -> tuple[Floats, Longs, Floats]:
        """Lines fitted to the edge voxels, as rows of `kernels.lines`, with the voxels' keys and sums at that time.

        The kernel fits a line again when its voxel has changed.
        """
        if len(self._lines[0]) != len(self.edges.keys):
            self._lines = _lines_for(self.edges)
        return self._lines

    def __len__(self) -> int:
        """Voxels that hold points."""
        return len(self.planes) + len(self.edges)

    def insert(self, features: Features, T_world_lidar: Floats) -> None:
        """Add the less sharp edges and the less planar points of a scan."""
        self.edges.insert(features.less_edges.points.astype(np.float32), T_world_lidar)
        flat = features.less_planes.points.astype(np.float32)
        self.planes.insert(flat, thin_planes(features)[0], T_world_lidar)

    def clear(self) -> None:
        """Forget all points."""
        self.planes.clear()
        self.edges.clear()
        self._lines = _lines_for(self.edges)

    def restore(self, state: State) -> None:
        """Replace all voxels by those of `state`."""
        super().restore(state)
        self._lines = _lines_for(self.edges)


class FeatureKeyframes(LastKeyframes):
    """Keeps the features of the newest keyframes in a feature map, and no others'."""

    def insert(self, target: FeatureMap, cloud: Features, T_world_lidar: Floats) -> None:
        """Add the features of one scan, LiDAR frame, to the map at its pose (4, 4)."""
        target.insert(cloud, T_world_lidar)


def thin_planes(features: Features) -> tuple[Floats, Floats]:
    """Down-sample the less planar points by a grid: centroids (S, 3), m, and scatter (S, 6), m2, of the points behind each."""
    points, _, scatter, _ = voxel.centroids(features.less_planes.points.astype(np.float32), NO_TIMES, WIDE_GRID)
    return points.astype(np.float64), scatter.astype(np.float64)


def _lines_for(edges: GaussianMap) -> tuple[Floats, Longs, Floats]:
    """Empty arrays for the lines of all edge voxels."""
    capacity = len(edges.keys)
    return np.zeros((capacity, 8)), np.full(capacity, -1, np.int64), np.zeros(capacity)
