"""From the uncertainty of one registration to that of a pose in the world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import so3
from lslam.registration.solver import RegistrationResult
from lslam.types.state import Stateful

Floats = NDArray[np.float64]


class PoseUncertainty(Stateful):
    """Accumulates the drift of scan-to-map odometry.

    A registration's covariance is relative to the local map, whose own error grows only as the map is renewed: after
    the sensor has moved by its lever arm (the rms distance of the matched points) the map stands on new scans, and one
    more independent registration error has entered it. In between, registrations against the same map share its
    error. So per scan the map's covariance grows by (step / lever arm) times the registration's, and a rotation error
    moves all later positions. A sensor that stands still does not drift.

    From scan to scan there is no such map: every registration's error enters in full.
    """

    STATE = ("_map", "_position")

    def __init__(self, *, is_scan_to_scan: bool = False) -> None:
        self.is_scan_to_scan = is_scan_to_scan
        self._map = np.zeros((6, 6))
        self._position: Floats | None = None

    def add(self, result: RegistrationResult) -> Floats | None:
        """(6, 6) covariance of the pose, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2.

        A failed registration adds its own doubt to its own pose only: the next good one is tied to the map again.
        """
        if result.covariance is None:
            return None
        position = result.T_world_lidar[:3, 3]
        step = np.zeros(3) if self._position is None else position - self._position
        self._position = position.copy()
        transport = np.eye(6)
        transport[:3, 3:] = -so3.hat(step)
        self._map = transport @ self._map @ transport.T
        if result.ok:
            renewed = float(np.linalg.norm(step)) / max(result.lever_arm, 1.0)
            self._map += (1.0 if self.is_scan_to_scan else renewed) * result.covariance
        return np.asarray(self._map + result.covariance)
