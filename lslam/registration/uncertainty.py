"""From the uncertainty of one registration to that of a pose in the world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import noise
from lslam.registration.solver import RegistrationResult
from lslam.registration.sweep_doubt import SweepDoubt
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan_result import ScanResult
from lslam.types.state import Stateful

Floats = NDArray[np.float64]

# The first sweep is deskewed by the velocity at its end, off by a T: twice as far as the later ones (`sweep_doubt`), squared.
FIRST = 4.0
# What the two scans after it say of how the motion changes is said of the first one, too: rattling lasts no longer.
BEGINNING = 2


class PoseUncertainty(Stateful):
    """Accumulates the drift of scan-to-map odometry.

    A registration's covariance is relative to the local map, whose own error grows only as the map is renewed: after
    the sensor has moved by its lever arm (the rms distance of the matched points) the map stands on new scans, and one
    more independent registration error has entered it. In between, registrations against the same map share its
    error. So per scan the map's covariance grows by (step / lever arm) times the registration's, and a rotation error
    moves all later positions. A sensor that stands still does not drift.

    A map that begins is the mean of its scans: of the error of the k-th one part in k stays in all that follow. On a map of
    hardly anything the first few err most, and later ones, which agree with each other, do not show it.

    From scan to scan there is no such map: every registration's error enters in full.

    The doubt about the motion within a sweep is another in every scan, so that on a map of many it averages out: each scan
    makes as much of the map as is renewed with it, and so much of its error stays. That of the first scan, at whose start the
    world begins, is in all others.

    map_age : how many scans ago, on the mean, the points of the map were taken on which the next scan is registered
    """

    STATE = ("_map", "_position", "_start", "_begun", "_sweep", "_scans", "map_age")

    def __init__(self, *, is_scan_to_scan: bool = False) -> None:
        self.is_scan_to_scan = is_scan_to_scan
        self._map = np.zeros((6, 6))
        self._position: Floats | None = None
        # Where the world begins, until it is known how wrong the first sweep was.
        self._start: Floats | None = None
        # Times the doubt about a sweep, of the first scan and those entered with it until then.
        self._begun = FIRST
        self._sweep = SweepDoubt()
        self._scans = 0
        self.map_age = 1.0

    def stamped(self, result: ScanResult, located: RegistrationResult, prior: MotionPrior) -> ScanResult:
        """The result of a scan that `prior` deskewed, with the covariances of its pose in the world and on the map."""
        sweep = self._sweep.observe(prior, result.stamp_ns, located.T_world_lidar, result.status == "ok")
        own = None if located.covariance is None else located.covariance + sweep
        return replace(result, covariance=self.add(located, sweep), registration_covariance=own)

    def add(self, result: RegistrationResult, sweep: Floats | None = None) -> Floats | None:
        """(6, 6) covariance of the pose, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2.

        sweep : (6, 6) of it that comes from the motion within the sweep, none when absent
        A failed registration adds its own doubt to its own pose only: the next good one is tied to the map again.
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
        if result.ok:
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
        """So much of a scan's doubt about its sweep (6, 6) stays in the map."""
        if self._start is None:
            self._map += share * sweep
        else:
            self._begun += share
