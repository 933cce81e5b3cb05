"""Method `lio-sam`: tightly coupled LiDAR and IMU by smoothing (Shan et al. 2020); here what registers the scans.

The smoother is the motion model (`lslam.inertial.smoothing`, `lslam.graph.inertial_smoother`).
"""

from __future__ import annotations

import numpy as np

from lslam.config.config import Config
from lslam.config.recovery import RecoveryConfig
from lslam.odometry.feature_map import FeatureKeyframes
from lslam.odometry.icp import Icp
from lslam.odometry.loam import Loam, LoamVariant
from lslam.registration.registration import Registration

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


class LioSam(Loam):
    """Edges and planar points on the feature map of the newest keyframes."""

    deskew = "features, by the newest state of the smoother"

    @property
    def recovery(self) -> RecoveryConfig:
        """Nothing."""
        return NONE

    def _fresh_keyframes(self) -> FeatureKeyframes:
        own = self.config.lio_sam
        return FeatureKeyframes(own.keyframes, own.keyframe_m, float(np.deg2rad(own.keyframe_deg)))


class LioSamOfPoints(Icp):
    """All points on the local map of the newest keyframes."""

    deskew = "by the newest state of the smoother"
