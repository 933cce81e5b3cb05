"""Points on the local map of Gaussian voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.kernels.residuals import TILT_FACTOR
from lslam.registration.alignment import MapAlignment
from lslam.registration.attempt import Attempt, Target
from lslam.registration.gaussian_map import FLOOR_M2, source_covariance
from lslam.registration.keyframe_submap import KeyframeSubmap
from lslam.registration.local_map import AllScans, LastKeyframes, LastScan, LocalMap, MapScans
from lslam.registration.optimiser import KERNEL_MIN_M, Annealing, optimise
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.preprocessing.rings import ring_gap
from lslam.registration.residuals import find_residual
from lslam.registration.result import RegistrationResult

# Fewer points or features, ten per degree of freedom, are insignificant.
MIN_SOURCE_POINTS = 60
# Share of points with a ring spacing above a voxel from which on the coarse level is searched, too.
SPARSE_SHARE = 0.1


class VoxelTarget(MapAlignment, Target):
    """The local map, the choice of the scans that it is made of, and the residual that the configuration names."""

    source = "points"
    STATE = ("map", "scans", "_ring_gap")

    def __init__(self, config: RegistrationConfig, preprocess: PreprocessConfig) -> None:
        residual, scans = find_residual(config.residual or "plane"), make_map_scans(config)
        # The poses of several scans err by the floor; residuals multiply a tilt.
        scan_variance = 0.0 if isinstance(scans, LastScan) else FLOOR_M2 / TILT_FACTOR
        size, reach = config.voxel_size * residual.voxel_share, 1.2 * preprocess.range_max
        # rad, for point to point; None until the first scan has shown it.
        self._ring_gap = None if preprocess.ring_gap_deg is None else preprocess.ring_gap
        local_map = LocalMap(size, reach=reach, scan_variance=scan_variance, ring_gap=preprocess.ring_gap)
        super().__init__(local_map, config, residual)
        self.times_steps = residual.times_steps
        self.preprocess, self.scans = preprocess, scans

    def fresh(self) -> VoxelTarget:
        """A new target with an empty map and the same settings."""
        return VoxelTarget(self.config, self.preprocess)

    def __len__(self) -> int:
        return len(self.map)

    def count(self, points: PreparedPoints) -> int:
        """Number of source points."""
        return len(points.source)

    def refusal(self, points: PreparedPoints) -> str:
        """The reason not to register a scan: it has too few points; else empty."""
        count = len(points.source)
        return "" if count >= MIN_SOURCE_POINTS else f"{count} usable points, {MIN_SOURCE_POINTS} needed"

    def ready(self, points: PreparedPoints) -> PreparedPoints:
        """The points with covariances, or with gaps between rings, where the residual needs them."""
        points = self.with_covariance(points)
        return replace(points, gaps=self._gaps(points)) if self.kind.needs_gaps else points

    def with_covariance(self, points: PreparedPoints) -> PreparedPoints:
        """The points with the covariance of the surface at each, where the residual needs it."""
        if not self.kind.needs_covariance or points.covariance is not None:
            return points
        c = self.config
        around = points.source.astype(np.float32) if c.target == "sample" else points.map_points
        covariance = source_covariance(points.source, around, c.sigma**2, c.neighbourhood)
        return replace(points, covariance=covariance)

    def align(
        self, attempt: Attempt, T_start: Floats, annealing: Annealing, information: Floats | None = None
    ) -> RegistrationResult:
        """Align with the map from `T_start` (4, 4); `information` (6, 6) of it as a prior, None: only a start."""
        return optimise(
            self.problem(attempt.points, T_start, annealing.start, annealing.steps, information=information)
        )

    def capture(self, attempt: Attempt) -> RegistrationResult:
        """Align from a prior that may be metres off, coarse to fine, and check the result."""
        return attempt.judge(self.coarse_to_fine(attempt.points, attempt.T_prior))

    def warm_up(self) -> None:
        """Compile or load the residual's kernel alone, on the map as it is, which may be empty."""
        points = PreparedPoints(np.zeros((1, 3), np.float32), np.zeros((1, 3)), np.zeros((1, 6)), 1)
        covariance = np.zeros((1, 6)) if self.kind.needs_covariance else None
        gaps = np.zeros(1) if self.kind.needs_gaps else None
        points = replace(points, covariance=covariance, gaps=gaps)
        optimise(self.problem(points, np.eye(4), KERNEL_MIN_M, 1))

    def enter(self, result: RegistrationResult) -> None:
        """Insert a scan at its pose."""
        self.scans.enter(self.map, result.points, result.T_world_lidar)

    def cloud(self, points: PreparedPoints) -> NDArray[np.float32]:
        """The points (M, 3) that the map is made of, m, LiDAR frame."""
        return points.map_points

    def _gaps(self, points: PreparedPoints) -> Floats | None:
        """(S,) m between rings at each source point; None where nearly all are smaller than a voxel."""
        if self._ring_gap is None:
            self._ring_gap = ring_gap(points.map_points)
        gaps: Floats = self._ring_gap * np.linalg.norm(points.source, axis=1)
        return gaps if (gaps > self.map.fine.size).mean() > SPARSE_SHARE else None


def make_map_scans(config: RegistrationConfig) -> MapScans:
    """The rule, named by `config.target`, of which scans make the local map: all, the last ones, or keyframes."""
    if config.target == "submap":
        return KeyframeSubmap()
    if config.target == "keyframe":
        return LastKeyframes(config.keyframes, config.keyframe_m, float(np.deg2rad(config.keyframe_deg)))
    if config.target in ("scan", "sample"):
        return LastScan(takes_source=config.target == "sample")
    return AllScans()
