"""Propagation of covariances: from that of one registration to that of a pose in the world."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from lslam.core.geometry import noise
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.state import Stateful
from lslam.odometry.deskew_uncertainty import DeskewUncertainty
from lslam.registration.solver import RegistrationResult

# Factor on the first sweep's variance: its velocity is that at its end, off by a T, twice the error of later ones.
FIRST = 4.0
# Scans after it from which the first sweep's covariance is estimated.
BEGINNING = 2


class PoseUncertainty(Stateful):
    """Accumulates the covariance of scan-to-map odometry.

    A registration's covariance is relative to the local map, whose own error grows only as the map is renewed: after
    the sensor has moved by its lever arm (the rms distance of the matched points) the map consists of new scans, and one
    more independent registration error has entered it. In between, registrations against the same map share its
    error. So per scan the map's covariance grows by (step / lever arm) times the registration's, and a rotation error
    moves all later positions. A sensor at rest does not drift: its scans enter at one pose, and leave the map's error as it is.

    A young map is the mean of its scans: one part in k of the error of the k-th stays in all that follow. The first few err by
    more than their covariances say; `frontend.look_back` registers the first again, to which all are relative.

    Scan-to-scan odometry has no such map: every registration's error enters in full.

    Deskewing errors are independent between scans and average out on the map: a scan contributes the share of the map that is
    renewed with it. That of the first scan, whose start is the world's origin, is common to all others.

    map_age : mean age, in scans, of the points of the map on which the next scan is registered
    """

    STATE: ClassVar[tuple[str, ...]] = ("_map", "_position", "_start", "_begun", "_sweep", "_scans", "map_age")

    def __init__(self, *, is_scan_to_scan: bool = False) -> None:
        self.is_scan_to_scan = is_scan_to_scan
        self._map = np.zeros((6, 6))
        self._position: Floats | None = None
        # The world's origin, until the first sweep's covariance is estimated.
        self._start: Floats | None = None
        # Factor on the deskewing covariance, of the first scan and those entered with it until then.
        self._begun = FIRST
        self._sweep = DeskewUncertainty()
        self._scans = 0
        self.map_age = 1.0

    def covariances(
        self, result: RegistrationResult, stamp_ns: int, prior: MotionPrior
    ) -> tuple[Floats | None, Floats | None]:
        """(6, 6) of the pose in the world, and on the local map, of a scan that `prior` deskewed."""
        sweep = self._sweep.observe(prior, stamp_ns, result.T_world_lidar, result.is_accepted)
        own = None if result.covariance is None else result.covariance + sweep
        return self.add(result, sweep), own

    def add(self, result: RegistrationResult, sweep: Floats | None = None) -> Floats | None:
        """(6, 6) covariance of the pose, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2.

        sweep : (6, 6) of it that comes from the motion within the sweep, none when absent
        A failed registration affects the covariance of its own pose only: the next good one is relative to the map again.
        """
        if result.covariance is None:
            return None
        sweep = np.zeros((6, 6)) if sweep is None else sweep
        own = result.covariance + sweep
        position = result.T_world_lidar[:3, 3]
        if self._position is None:
            self._position = self._start = position.copy()
        step = position - self._position
        self._position = position.copy()
        self._map = noise.transported(self._map, step)
        if result.is_stationary:
            self._scans += 1
            self.map_age += 1
        elif result.ok:
            renewed = 1.0 if self.is_scan_to_scan else float(np.linalg.norm(step)) / max(result.lever_arm, 1.0)
            self._scans += 1
            self._map += max(renewed, 1 / self._scans**2) * result.covariance
            if self._scans > 1:
                self._enter(max(min(renewed, 1.0), 1 / self._scans) ** 2, sweep)
            share = min(max(renewed, 1 / self._scans), 1.0)
            self.map_age = 1 + (1 - share) * self.map_age
        if self._start is None:
            return np.asarray(self._map + own)
        begun = noise.transported(self._begun * sweep, position - self._start)
        if self._sweep.scans >= BEGINNING:
            self._map, self._start = self._map + begun, None
            return np.asarray(self._map + own)
        return np.asarray(self._map + begun + own)

    def _enter(self, share: float, sweep: Floats) -> None:
        """Add a share of a scan's deskewing covariance (6, 6) to the map's."""
        if self._start is None:
            self._map += share * sweep
        else:
            self._begun += share
