"""Method `open3d-gicp`: generalised ICP of Open3D, scan to scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.extras import importing_open3d
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.base import AligningMethod
from lslam.registration.preprocessing.prepare import clean_points
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

# Centroids of this grid, covariances of this many neighbours, correspondences within this distance, m.
LEAF_M = 0.3
COVARIANCE_POINTS = 20
MATCH_REACH_M = 1.0


@dataclass
class Reference:
    """The last scan that was registered: what the next one is aligned with."""

    cloud: Any
    T_world_lidar: Floats


def create(config: Config) -> Open3dGicp:
    """Create the baseline; its range gate follows `preprocess`."""
    return Open3dGicp(config.preprocess, config.registration)


class Open3dGicp(AligningMethod):
    """Open3D's generalised ICP (Segal 2009) with its own defaults. It has no map, so its drift adds up scan by scan."""

    def __init__(self, preprocess: PreprocessConfig, limits: RegistrationConfig) -> None:
        with importing_open3d():
            import open3d
        self._package: Any = open3d
        self._preprocess, self.limits = preprocess, limits
        self._last: Reference | None = None

    def prepare(self, scan: Scan) -> Any:
        """Open3D's point cloud: gated, down-sampled, with a covariance per point unless there are too few to register."""
        points = clean_points(scan.points, self._preprocess).astype(np.float64)
        package = self._package
        cloud = package.geometry.PointCloud(package.utility.Vector3dVector(points)).voxel_down_sample(LEAF_M)
        if len(cloud.points) >= MIN_SOURCE_POINTS:
            cloud.estimate_covariances(package.geometry.KDTreeSearchParamKNN(COVARIANCE_POINTS))
        return cloud

    def enter(self, prepared: Any, result: ScanResult) -> None:
        """Make a registered scan the one that the next is aligned with."""
        if result.status == "ok":
            self._last = Reference(prepared, result.T_world_lidar)

    def align(self, prepared: Any, T_prior: Floats) -> RegistrationResult:
        """Align the cloud with the last registered scan by Open3D; the prior itself without one."""
        count = len(prepared.points)
        if self._last is None or count < MIN_SOURCE_POINTS:
            return RegistrationResult(T_prior, source_points=count, inliers=count)
        registration = self._package.pipelines.registration
        alignment = registration.registration_generalized_icp(
            prepared,
            self._last.cloud,
            MATCH_REACH_M,
            se3.relative(self._last.T_world_lidar, T_prior),
            registration.TransformationEstimationForGeneralizedICP(),
        )
        pose = self._last.T_world_lidar @ np.asarray(alignment.transformation, np.float64)
        inliers = len(alignment.correspondence_set)
        return RegistrationResult(pose, source_points=count, inliers=inliers, rmse=float(alignment.inlier_rmse))
