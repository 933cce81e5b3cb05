"""The local map in a pyramid of resolutions, and the scans that it is made of: all near by, the last keyframes, or one.

A point takes the finest voxel whose points spread across the beams.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.kernels.linearisation import SIGNIFICANT_SIGMAS
from lslam.core.types.state import State, Stateful
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.preprocessing.prepare import PreparedPoints

# A plane must have been seen across its beams by so many times the standard deviation that it is thick, squared: below that, a
# plane through the sensor explains its points as well, which is where the beams of one ring lie whatever they hit.
LEAST_BREADTH = SIGNIFICANT_SIGMAS**2
# Coarse voxels are so many times larger than fine ones: rings of sparse sensors share a voxel.
COARSE_FACTOR = 3
# Times the coarse voxels. Beams of two degrees lie two metres apart on a wall 60 m away, and on the ground 10 m ahead.
WIDE_FACTORS = (2, 4)


def surroundings_m(config: RegistrationConfig) -> float:
    """Distance, m, beyond which scans share only the widest voxels with those from a spot: their rings hit other ground."""
    return config.voxel_size * COARSE_FACTOR * WIDE_FACTORS[0]


class LocalMap(Stateful):
    """Gaussian voxels of four sizes around the sensor.

    Parameters
    ----------
    size : m, edge of a fine voxel
    reach, scan_variance, breadth : as in `GaussianMap`; breadth None: `LEAST_BREADTH`
    ring_gap : likewise, of fine voxels
    """

    def __init__(
        self,
        size: float,
        *,
        reach: float,
        scan_variance: float = 0.0,
        ring_gap: float = 0.0,
        breadth: float | None = None,
    ) -> None:
        breadth = LEAST_BREADTH if breadth is None else breadth
        level = partial(GaussianMap, reach=reach, breadth=breadth, scan_variance=scan_variance)
        # Wide voxels bend with the ground: that several rings have seen one makes it no plane.
        wide = (level(size * COARSE_FACTOR * wider) for wider in (1, *WIDE_FACTORS))
        self.levels = (level(size, ring_gap=ring_gap), *wide)
        # How often the map has changed: what was looked up in it before is void then.
        self.changes = 0

    @property
    def fine(self) -> GaussianMap:
        """The level of the smallest voxels."""
        return self.levels[0]

    @property
    def coarser(self) -> tuple[GaussianMap, ...]:
        """All other levels, the finest of them first."""
        return self.levels[1:]

    def __len__(self) -> int:
        """Fine voxels that hold points."""
        return len(self.fine)

    def insert(self, map_points: NDArray[np.float32], source: Floats, T_world_lidar: Floats) -> None:
        """Enter a scan: its small centroids (M, 3) into fine voxels, its source points (S, 3) into all others."""
        self.changes += 1
        self.fine.insert(map_points, T_world_lidar)
        few = source.astype(np.float32)
        for level in self.coarser:
            level.insert(few, T_world_lidar)

    def clear(self) -> None:
        """Remove all voxels; the arrays keep their size."""
        self.changes += 1
        for level in self.levels:
            level.clear()

    def state(self) -> State:
        """The voxels of all levels, for a checkpoint."""
        return {"levels": [level.state() for level in self.levels]}

    def restore(self, state: State) -> None:
        """Replace all voxels by those of `state`."""
        self.changes += 1
        for level, level_state in zip(self.levels, state["levels"], strict=True):
            level.restore(level_state)


class MapScans(Stateful, ABC):
    """Enters registered scans into the local map, and takes out those that no longer belong there."""

    @abstractmethod
    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Enter the prepared points of a scan, LiDAR frame, at its pose (4, 4)."""


class AllScans(MapScans):
    """Every scan stays until the sensor has left it behind."""

    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Add the scan to the map."""
        target.insert(points.map_points, points.source, T_world_lidar)


class LastScan(MapScans):
    """The last scan alone: scan-to-scan registration.

    takes_source : its source points; of the first scan all points (Girolimetto, listings 4.3 and 4.5)
    """

    def __init__(self, *, takes_source: bool = False) -> None:
        self.takes_source = takes_source

    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Replace the map by the scan."""
        is_few = self.takes_source and len(target) > 0
        target.clear()
        target.insert(points.source.astype(np.float32) if is_few else points.map_points, points.source, T_world_lidar)


class LastKeyframes(MapScans):
    """The last `count` keyframes, a new one where the sensor has moved `move`, m, or turned `turn`, rad, since the newest."""

    STATE = ("keyframes",)

    def __init__(self, count: int, move: float, turn: float) -> None:
        self.count, self.move, self.turn = count, move, turn
        self.keyframes: list[tuple[Any, Floats]] = []

    def enter(self, target: Any, cloud: Any, T_world_lidar: Floats) -> None:
        """Insert `cloud` (points, LiDAR frame) into `target` as keyframe when it moved or turned enough since the last one.

        When more than `count` are kept, the oldest is dropped and the map is built anew.
        """
        if self.keyframes:
            step = se3.relative(self.keyframes[-1][1], T_world_lidar)
            if np.linalg.norm(step[:3, 3]) < self.move and float(so3.angle(step[:3, :3])) < self.turn:
                return
        self.keyframes.append((cloud, T_world_lidar.copy()))
        if len(self.keyframes) <= self.count:
            self.insert(target, cloud, T_world_lidar)
            return
        del self.keyframes[0]
        target.clear()
        for keyframe_cloud, pose in self.keyframes:
            self.insert(target, keyframe_cloud, pose)

    def insert(self, target: Any, cloud: Any, T_world_lidar: Floats) -> None:
        """Add the points of one keyframe to the map."""
        target.insert(cloud.map_points, cloud.source, T_world_lidar)
