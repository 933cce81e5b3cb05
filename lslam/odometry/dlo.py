"""Method `dlo`: direct LiDAR odometry, scan to scan and then to a submap of keyframes (Chen et al. 2022)."""

from __future__ import annotations

import time
from dataclasses import replace

from lslam.config.config import Config
from lslam.odometry.base import Registered
from lslam.odometry.icp import Icp
from lslam.odometry.scan_outcome import of_registration
from lslam.preprocessing.deskew import deskew
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


def create(config: Config) -> Dlo:
    """The method as the configuration wants it, with no recovery beside the two registrations."""
    section = config.registration.model_copy(update={"residual": "gicp", "target": "submap"})
    return Dlo(Registration(section, config.preprocess))


class Dlo(Icp):
    """Two registrations: against the last scan from the motion prior, then against the submap from what that found."""

    STATE = (*Icp.STATE, "pairwise")

    def __init__(self, registration: Registration) -> None:
        super().__init__(registration)
        self.pairwise = self._fresh_pairwise()

    def _fresh_pairwise(self) -> Registration:
        section = self.registration.config.model_copy(update={"target": "scan"})
        return Registration(section, self.registration.preprocess)

    def _align(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False) -> Registered:
        began = time.perf_counter()
        points = self.registration.covered(deskew(prepared, prior))
        deskewed = time.perf_counter()
        step = self.pairwise.locate(points, prior.pose, is_near)
        paired = time.perf_counter()
        start = step.T_world_lidar if step.ok else prior.pose
        located = self.registration.locate(points, start, is_near)
        done = time.perf_counter()
        stages = {"deskew": deskewed - began, "scan": paired - deskewed, "map": done - paired}
        return Registered(of_registration(scan, located, self._uncertainty.map_age, stages), (points, located))

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan as the last one, and as a keyframe when one is due."""
        result = super().update(prior, found)
        began = time.perf_counter()
        points, located = found.detail
        self.pairwise.update(points, located.decided(found.result))
        stages = {**result.stages, "update": result.stages["update"] + time.perf_counter() - began}
        return replace(result, stages=stages)

    def restart(self) -> None:
        """No last scan and no keyframes."""
        super().restart()
        self.pairwise = self._fresh_pairwise()
