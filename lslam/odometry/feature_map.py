"""The feature map of the LOAM family: voxels of edges, read as lines, and a pyramid of planar points, read as planes."""

from __future__ import annotations

import numpy as np

from lslam.core.config.input import PreprocessConfig
from lslam.core.kernels import voxel
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.state import State, Stateful
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import LocalMap
from lslam.registration.map_scans import LastKeyframes
from lslam.registration.preprocessing.features import Features
from lslam.registration.preprocessing.prepare import NO_TIMES

# As LOAM fits its lines: five points at least.
MIN_LINE_POINTS = 5
# m, grid of the less planar points for wide voxels, and where they stand in for the planar ones.
WIDE_GRID = PreprocessConfig().source_voxel


class FeatureMap(Stateful):
    """Less sharp edges and less planar points of past scans, in voxels around the sensor.

    Parameters
    ----------
    size : m, edge of a voxel of edges
    plane_size : m, edge of the smallest voxel of planar points; as `size` when absent
    coarse_factor, min_points, planarity, count_cap, reach : of the planes, as in `LocalMap`
    """

    STATE = ("planes", "edges")

    def __init__(
        self, size: float, *, plane_size: float | None = None, coarse_factor: int = 3, min_points: int = 6,
        planarity: float = 0.3, count_cap: float = 200.0, reach: float = 150.0, capacity: int = 1 << 16,
    ) -> None:  # fmt: skip
        self.planes = LocalMap(
            plane_size or size, coarse_factor=coarse_factor, min_points=min_points, planarity=planarity,
            count_cap=count_cap, reach=reach,
        )  # fmt: skip
        self.edges = GaussianMap(size, count_cap=count_cap, reach=reach, capacity=capacity // 4)
        self._lines = _lines_for(self.edges)

    @property
    def lines(self) -> tuple[Floats, Longs, Floats]:
        """Rows of `kernels.lines` for the edge voxels, the keys and sums they were computed at; kept up to date by it."""
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
        self.planes.insert(flat, thinned(features)[0], T_world_lidar)

    def clear(self) -> None:
        """Forget all points."""
        self.planes.clear()
        self.edges.clear()
        self._lines = _lines_for(self.edges)

    def restore(self, state: State) -> None:
        """Go on with the voxels of `state`."""
        super().restore(state)
        self._lines = _lines_for(self.edges)


class FeatureKeyframes(LastKeyframes):
    """Keeps the features of the newest keyframes in a feature map, and no others'."""

    def insert(self, target: FeatureMap, cloud: Features, T_world_lidar: Floats) -> None:
        """Add the features of one scan."""
        target.insert(cloud, T_world_lidar)


def thinned(features: Features) -> tuple[Floats, Floats]:
    """Centroids (S, 3) of the less planar points and the scatter (S, 6) behind each."""
    points, _, scatter, _ = voxel.centroids(features.less_planes.points.astype(np.float32), NO_TIMES, WIDE_GRID)
    return points.astype(np.float64), scatter.astype(np.float64)


def _lines_for(edges: GaussianMap) -> tuple[Floats, Longs, Floats]:
    capacity = len(edges.keys)
    return np.zeros((capacity, 8)), np.full(capacity, -1, np.int64), np.zeros(capacity)
