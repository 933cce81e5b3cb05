"""Method `lio-sam`: tightly coupled LiDAR and IMU by smoothing (Shan et al. 2020); here what registers the scans.

The smoother is the motion model (`lslam.inertial.smoothing`, `lslam.graph.inertial_smoother`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.config.config import Config
from lslam.config.recovery import RecoveryConfig
from lslam.odometry.base import Registered
from lslam.odometry.feature_map import FeatureKeyframes
from lslam.odometry.icp import Icp
from lslam.odometry.loam import Loam, LoamVariant
from lslam.registration.registration import Registration
from lslam.registration.solver import RegistrationResult
from lslam.registration.uncertainty import PoseUncertainty
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan_result import ScanResult

SCAN_TO_MAP = LoamVariant(None, with_map=True)
# The smoother is what bridges a scan: nothing else is tried.
NONE = RecoveryConfig(coarse_to_fine=False, start_search=False, less_planar=False, fallback="none")


def create(config: Config) -> LioSam | LioSamOfPoints:
    """The method on features or on all points, with no recovery beside the smoother."""
    own = config.lio_sam
    if own.features == "loam":
        return LioSam(config, SCAN_TO_MAP)
    section = config.registration.model_copy(
        update={
            "residual": "plane", "target": "keyframe", "keyframes": own.keyframes, "keyframe_m": own.keyframe_m,
            "keyframe_deg": own.keyframe_deg,
        }
    )  # fmt: skip
    return LioSamOfPoints(Registration(section, config.preprocess))


class SmoothedUncertainty(PoseUncertainty):
    """As of scan-to-map odometry, and beside it the covariance by the points alone.

    A state of the smoother shares the IMU with those before: taken as independent, and beside the IMU in a pose graph, its
    covariance would count that again and again.
    """

    STATE: ClassVar[tuple[str, ...]] = (*PoseUncertainty.STATE, "points")

    def __init__(self) -> None:
        super().__init__()
        self.points = PoseUncertainty()

    def alone(self, result: ScanResult, found: Registered, prior: MotionPrior) -> ScanResult:
        """The `result` with `points_covariance`, that of the local map; `found` is what the smoother decided."""
        located: RegistrationResult = found.detail[1]
        entered = located.decided(found.result)
        if found.result.status == "ok":
            entered = entered.moved(entered.T_world_lidar, located.covariance)
        by_points = self.points.stamped(found.result, entered, prior)
        if by_points.covariance is None or by_points.registration_covariance is None:
            return result
        return replace(result, points_covariance=by_points.covariance - by_points.registration_covariance)


class LioSam(Loam):
    """Edges and planar points on the feature map of the newest keyframes."""

    deskew = "features, by the newest state of the smoother"
    _uncertainty: SmoothedUncertainty

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan into the feature map where the smoother puts it."""
        return self._uncertainty.alone(super().update(prior, found), found, prior)

    @property
    def recovery(self) -> RecoveryConfig:
        """Nothing."""
        return NONE

    def _fresh_keyframes(self) -> FeatureKeyframes:
        own = self.config.lio_sam
        return FeatureKeyframes(own.keyframes, own.keyframe_m, float(np.deg2rad(own.keyframe_deg)))

    def _fresh_uncertainty(self) -> SmoothedUncertainty:
        return SmoothedUncertainty()


class LioSamOfPoints(Icp):
    """All points on the local map of the newest keyframes."""

    deskew = "by the newest state of the smoother"
    _uncertainty: SmoothedUncertainty

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan into the local map where the smoother puts it."""
        return self._uncertainty.alone(super().update(prior, found), found, prior)

    def _fresh_uncertainty(self) -> SmoothedUncertainty:
        return SmoothedUncertainty()
