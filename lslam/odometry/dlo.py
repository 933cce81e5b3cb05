"""Method `dlo`: direct LiDAR odometry, scan to scan and then to a submap of keyframes (Chen et al. 2022)."""

from __future__ import annotations

from dataclasses import replace

from lslam.core.config.config import Config
from lslam.core.config.odometry import NO_RECOVERY
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import StageClock
from lslam.odometry.icp import Icp, registration_of
from lslam.registration.preprocessing.deskew import deskew
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult


def create(config: Config) -> Dlo:
    """Create the method from the configuration; but for the search of the first steps its recovery is the second registration."""
    return Dlo(registration_of(config, "gicp", NO_RECOVERY, target="submap"), config.recovery.start_search)


class Dlo(Icp):
    """Two registrations: against the last scan from the motion prior, then against the submap from the first result."""

    STATE = (*Icp.STATE, "pairwise")

    def __init__(self, registration: Registration, start_search: bool) -> None:
        super().__init__(registration)
        c = registration.config.model_copy(update={"target": "scan"})
        search_alone = NO_RECOVERY.model_copy(update={"start_search": start_search})
        self.pairwise = Registration(c, registration.preprocess, search_alone)

    def register(
        self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False
    ) -> RegistrationResult:
        """Register the scan, deskewed by the prior, on the last scan and then on the submap; the result is that on the submap.

        If the first fails, the second begins at the prior. `is_near` as for `Registration.locate`.
        """
        clock = StageClock()
        with clock.stage("deskew"):
            points = self.with_surfaces(deskew(prepared, prior), prepared)
        with clock.stage("scan"):
            step = self.pairwise.locate(points, prior.pose, is_near)
        with clock.stage("map"):
            result = self.registration.locate(points, step.T_world_lidar if step.ok else prior.pose, is_near)
        return replace(result, map_age=self.map_age, stages=clock.seconds)

    def insert(self, stamp_ns: int, prior: MotionPrior, result: RegistrationResult) -> RegistrationResult:
        """Enter the scan as the last one, and as a keyframe when one is due."""
        self.pairwise.update(result)
        return super().insert(stamp_ns, prior, result)

    def restart(self) -> None:
        """No last scan and no keyframes."""
        super().restart()
        self.pairwise = self.pairwise.fresh()
