"""Method `small-gicp`: GICP of the small_gicp package (Koide 2024) on a local map of keyframes."""

from __future__ import annotations

from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.extras import importing, install_hint
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.base import AligningMethod
from lslam.registration.preprocessing.prepare import clean_points
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

# The recipe: the package's own centroids and covariances, correspondences within a metre, and a map of the last ten
# keyframes, a new one every 2 m or 15 deg.
LEAF_M = 0.3
MATCH_REACH_M = 1.0
MAP_KEYFRAMES = 10
STEP_M, STEP_DEG = 2.0, 15.0


def create(config: Config) -> SmallGicp:
    """Create the baseline; its range gate follows `preprocess`, its number of threads `input.threads`."""
    return SmallGicp(config.preprocess, config.registration, config.input.workers)


class SmallGicp(AligningMethod):
    """GICP, scan to keyframe map, by the package small_gicp; with several threads its sums may differ in the last digits."""

    def __init__(self, preprocess: PreprocessConfig, limits: RegistrationConfig, threads: int = 2) -> None:
        """Import the package. Raises InputError with the command to install it if it is missing."""
        with importing("small_gicp", install_hint("small-gicp")):
            import small_gicp
        self._package: Any = small_gicp
        self._preprocess, self.limits, self._threads = preprocess, limits, threads
        self._clouds: list[Floats] = []
        self._target: tuple[Any, Any] | None = None
        self._T_world_keyframe = np.eye(4)

    def prepare(self, scan: Scan) -> Any:
        """The package's point cloud: gated, down-sampled, with a covariance per point; None without usable points."""
        points = clean_points(scan.points, self._preprocess)
        return self._with_covariances(points.astype(np.float64))[0] if len(points) >= MIN_SOURCE_POINTS else None

    def enter(self, prepared: Any, result: ScanResult) -> None:
        """Make the scan a keyframe of the local map when the sensor has moved far enough."""
        if result.status == "ok" and self._has_moved_on(result.T_world_lidar):
            self._insert(np.asarray(prepared.points())[:, :3], result.T_world_lidar)

    def align(self, prepared: Any, T_prior: Floats) -> RegistrationResult:
        """Align prepared points with the map by small_gicp; the prior itself without a map or with too few points."""
        count = 0 if prepared is None else prepared.size()
        if self._target is None or count < MIN_SOURCE_POINTS:
            return RegistrationResult(T_prior, source_points=count, inliers=count)
        target, tree = self._target
        alignment = self._package.align(
            target, prepared, tree, T_prior, max_correspondence_distance=MATCH_REACH_M, num_threads=self._threads
        )
        pose = np.asarray(alignment.T_target_source, np.float64)
        return RegistrationResult(
            pose,
            source_points=count,
            inliers=int(alignment.num_inliers),
            converged=bool(alignment.converged),
            iterations=int(alignment.iterations),
        )

    def _has_moved_on(self, pose: Floats) -> bool:
        """Whether the pose (4, 4) is far enough from the last keyframe for another, or there is no map."""
        move, turn = se3.magnitude(se3.relative(self._T_world_keyframe, pose))
        return self._target is None or move > STEP_M or float(np.rad2deg(turn)) > STEP_DEG

    def _insert(self, points: Floats, pose: Floats) -> None:
        """Add points (N, 3), m, LiDAR frame, at a pose (4, 4) to the map as a keyframe; the oldest one leaves a full map."""
        self._clouds.append(se3.apply(pose, points))
        del self._clouds[:-MAP_KEYFRAMES]
        self._target = self._with_covariances(np.concatenate(self._clouds))
        self._T_world_keyframe = pose.copy()

    def _with_covariances(self, points: Floats) -> tuple[Any, Any]:
        """The package's point cloud with covariances of points (N, 3), and its search tree."""
        cloud, tree = self._package.preprocess_points(points, downsampling_resolution=LEAF_M, num_threads=self._threads)
        return cloud, tree
