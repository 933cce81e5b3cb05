"""A method that registers scans one after the other on a map of those before, whatever is registered."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import ClassVar

from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.odometry.base import Traits
from lslam.odometry.scan_outcome import recorded
from lslam.odometry.uncertainty import PoseUncertainty
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult


class MapMethod(Traits, Stateful):
    """Adapter from scans and motion priors to `Registration`.

    is_scan_to_scan : whether the map is of the last scan alone
    """

    is_searching = True
    STATE: ClassVar[tuple[str, ...]] = ("registration", "_uncertainty")

    def __init__(self, registration: Registration, *, is_scan_to_scan: bool) -> None:
        self.registration, self._is_scan_to_scan = registration, is_scan_to_scan
        self._uncertainty = self._fresh_uncertainty()

    @property
    def map_age(self) -> float:
        """Mean age, in scans, of the points of the map."""
        return self._uncertainty.map_age

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        """Enter the scan into the map where its result puts it."""
        began = time.perf_counter()
        result = self.insert(scan.stamp_ns, prior, result)
        record = recorded(scan, result, *self._uncertainty.covariances(result, scan.stamp_ns, prior))
        return replace(record, stages={**result.stages, "update": time.perf_counter() - began})

    def insert(self, stamp_ns: int, prior: MotionPrior, result: RegistrationResult) -> RegistrationResult:
        """Enter a scan that was registered from `prior` into the map; the result says whether the sensor is at rest."""
        return self.registration.update(result)

    def information_of(self, prior: MotionPrior) -> Floats | None:
        """(6, 6) information of the prior for the normal equations; None, since it is the initial guess only."""
        return None

    def restart(self) -> None:
        """An empty map."""
        self.registration = self.registration.fresh()
        self._uncertainty = self._fresh_uncertainty()

    def _fresh_uncertainty(self) -> PoseUncertainty:
        return PoseUncertainty(is_scan_to_scan=self._is_scan_to_scan)
