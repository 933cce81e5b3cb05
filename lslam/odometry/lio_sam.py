"""Method `lio-sam`: tightly coupled LiDAR and IMU by smoothing (Shan et al. 2020); here what registers the scans.

The smoother is the motion model (`lslam.odometry.inertial.smoothing`, `lslam.backend.graph.inertial_smoother`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from lslam.core.config.config import Config
from lslam.core.config.odometry import rest_alone
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.base import MapMethod
from lslam.odometry.feature_target import LoamVariant
from lslam.odometry.icp import Icp, registration_of
from lslam.odometry.inertial.smoothing import SmootherMotion
from lslam.odometry.loam import Loam
from lslam.odometry.uncertainty import PoseUncertainty
from lslam.registration.result import RegistrationResult

# The newest keyframes make the local map; a new one where the sensor moved or turned so far (Shan et al. 2020).
KEYFRAMES, KEYFRAME_M, KEYFRAME_DEG = 25, 1.0, 10.0


def create(config: Config) -> LioSam | LioSamOfPoints:
    """Create the method on LOAM features or on all points; its only recovery policy is `at_rest`."""
    if config.lio_sam.features == "loam":
        keyframes = KEYFRAMES, KEYFRAME_M, float(np.deg2rad(KEYFRAME_DEG))
        quiet = config.model_copy(update={"recovery": rest_alone(config.recovery)})
        return LioSam(quiet, LoamVariant(None, with_map=True, keyframes=keyframes))
    keys: dict[str, Any] = {"keyframes": KEYFRAMES, "keyframe_m": KEYFRAME_M, "keyframe_deg": KEYFRAME_DEG}
    return LioSamOfPoints(registration_of(config, recovery=rest_alone(config.recovery), target="keyframe", **keys))


create_motion = SmootherMotion


class SmoothedUncertainty(PoseUncertainty):
    """As of scan-to-map odometry, and beside it the covariance by the points alone.

    A state of the smoother shares the IMU with those before: taken as independent, and beside the IMU in a pose graph, its
    covariance would count that again and again.
    """

    STATE: ClassVar[tuple[str, ...]] = (*PoseUncertainty.STATE, "points")

    def __init__(self) -> None:
        super().__init__()
        self.points = PoseUncertainty()

    def alone(self, record: ScanResult, result: RegistrationResult, stamp_ns: int, prior: MotionPrior) -> ScanResult:
        """The record with `points_covariance` (6, 6), by the points alone; `result` is the smoother's registration."""
        entered = result.with_pose(result.T_world_lidar, result.detail) if result.is_accepted else result
        whole, own = self.points.covariances(entered, stamp_ns, prior)
        return record if whole is None or own is None else replace(record, points_covariance=whole - own)


class SmootherMethod(MapMethod):
    """Scans enter the map where the smoother puts them."""

    _uncertainty: SmoothedUncertainty

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        """Register as the method does, and keep the covariance by the points beside the smoother's."""
        result: RegistrationResult = super().register(scan, prepared, prior, is_near)  # type: ignore[misc]
        return replace(result, detail=result.covariance)

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        """Enter the scan into the map where the smoother puts it."""
        return self._uncertainty.alone(super().update(scan, prior, result), result, scan.stamp_ns, prior)

    def _fresh_uncertainty(self) -> SmoothedUncertainty:
        """The accumulated covariances of a run that begins."""
        return SmoothedUncertainty()


class LioSam(SmootherMethod, Loam):
    """Edges and planar points on the feature map of the newest keyframes."""

    deskew = "features, by the newest state of the smoother"


class LioSamOfPoints(SmootherMethod, Icp):
    """All points on the local map of the newest keyframes."""

    deskew = "by the newest state of the smoother"
