"""The scans that a local map is made of: all near by, the last keyframes, or the last scan alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.state import Stateful
from lslam.registration.local_map import LocalMap
from lslam.registration.preprocessing.prepare import PreparedPoints


class MapScans(Stateful, ABC):
    """Enters registered scans into the local map, and takes out those that no longer belong there."""

    @abstractmethod
    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Enter the prepared points of a scan, LiDAR frame, at its pose (4, 4)."""


class AllScans(MapScans):
    """Every scan stays until the sensor has left it behind."""

    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Add to the map."""
        target.insert(points.map_points, points.source, T_world_lidar)


class LastScan(MapScans):
    """The last scan alone: scan-to-scan registration."""

    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Replace the map."""
        target.clear()
        target.insert(points.map_points, points.source, T_world_lidar)


class LastKeyframes(MapScans):
    """The last `count` keyframes, a new one where the sensor has moved `move`, m, or turned `turn`, rad, since the newest."""

    STATE = ("keyframes",)

    def __init__(self, count: int, move: float, turn: float) -> None:
        self.count, self.move, self.turn = count, move, turn
        self.keyframes: list[tuple[Any, Floats]] = []

    def enter(self, target: Any, cloud: Any, T_world_lidar: Floats) -> None:
        """Add a keyframe when it is due; the map is built anew when an old one leaves."""
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
        for kept, pose in self.keyframes:
            self.insert(target, kept, pose)

    def insert(self, target: Any, cloud: Any, T_world_lidar: Floats) -> None:
        """Add what a map of this kind takes of a scan."""
        target.insert(cloud.map_points, cloud.source, T_world_lidar)


def make_map_scans(config: RegistrationConfig) -> MapScans:
    """The choice that `config.target` names. Raises UsageError for a submap, which only methods make."""
    if config.target == "submap":
        raise UsageError("registration.target = submap is for methods: lslam run --method dlo")
    if config.target == "keyframe":
        return LastKeyframes(config.keyframes, config.keyframe_m, float(np.deg2rad(config.keyframe_deg)))
    return LastScan() if config.target == "scan" else AllScans()
