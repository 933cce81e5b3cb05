"""Which scans become keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.config.backend import KeyframesConfig
from lslam.geometry import se3, so3
from lslam.types.scan_result import ScanResult
from lslam.types.state import Stateful
from lslam.types.trajectory import Keyframe


class KeyframeSelector(Stateful):
    """Takes a registered scan when the sensor has travelled `distance`, or turned by `angle_deg`, since the last taken.

    The first registered scan of each segment is one. Scans that were bridged or skipped never are: their poses are unknown.
    """

    STATE = ("_count", "_travelled", "_here", "_last", "_segment")

    def __init__(self, config: KeyframesConfig) -> None:
        self._distance, self._angle = config.distance, float(np.deg2rad(config.angle_deg))
        self._count = 0
        self._travelled = 0.0
        self._here: NDArray[np.float64] | None = None
        self._last: NDArray[np.float64] | None = None
        self._segment = 0

    def consider(self, scan: int, result: ScanResult) -> Keyframe | None:
        """The keyframe that scan number `scan` of the run becomes, or None; every scan of the run, in order."""
        pose = result.T_world_lidar
        if self._here is not None:
            self._travelled += float(np.linalg.norm(pose[:3, 3] - self._here[:3, 3]))
        self._here = pose
        if result.status != "ok" or not (result.segment != self._segment or self._is_due(pose)):
            return None
        self._last, self._segment = pose, result.segment
        self._count += 1
        return Keyframe(self._count - 1, scan, result.stamp_ns, pose, result.covariance, self._travelled)

    def _is_due(self, pose: NDArray[np.float64]) -> bool:
        if self._last is None:
            return True
        step = se3.relative(self._last, pose)
        is_far = float(np.linalg.norm(step[:3, 3])) >= self._distance
        return is_far or float(so3.angle(step[:3, :3])) >= self._angle
