"""Features on the scan before, on a feature map, or on one after the other: LOAM's target."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.odometry.feature_map import (
    FeatureKeyframes,
    FeatureMap,
    FeatureScan,
    feature_scan,
    surface_size,
    thin_planes,
    to_arrays,
)
from lslam.odometry.feature_policies import AllPoints
from lslam.odometry.feature_solver import (
    NONE,
    FeatureNoise,
    ScanStep,
    remap_solution,
    solve_on_map,
    solve_on_scan,
)
from lslam.registration.attempt import RECOVER_M, Attempt, Target
from lslam.registration.history import History
from lslam.registration.optimiser import (
    COARSE_KERNEL_M,
    START_ITERATIONS,
    Annealing,
)
from lslam.registration.preprocessing.features import Features
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

# m; of an edge across itself: it lies anywhere between two beams, and silhouettes move.
EDGE_SIGMA_M = 0.15


@dataclass(frozen=True)
class LoamVariant:
    """The parts of a method of the family.

    scan_step : registers a scan on the one before; None leaves that out
    with_map : whether the pose is found, or refined, on a feature map
    with_less_planes : whether the map is matched with centroids of the less planar points in place of the planar ones
    inlier_ratio : share of the correspondences with the map, the nearest, that have a say
    keyframes : number, m and rad of the keyframes that the feature map is made of; None: of all scans
    """

    scan_step: ScanStep | None
    with_map: bool
    with_less_planes: bool = False
    inlier_ratio: float = 1.0
    keyframes: tuple[int, float, float] | None = None


class FeatureTarget(Target):
    """The target of LOAM: the last scan's features, the feature map, and, if the configuration falls back on it, all points."""

    source = "features"
    times_steps = 1
    STATE = ("map", "scan", "all_points", "_keyframes")

    def __init__(self, config: Config, variant: LoamVariant) -> None:
        self.config, self.loam, self.variant, self._whole = config.registration, config.loam, variant, config
        self.map = self._new_map(1 << 16) if variant.with_map else None
        self.scan: FeatureScan | None = None
        size = self._plane_size(self.config.voxel_size)
        # All points find the motion of the first scans, which too few features, or beams that repeat, leave open.
        self._first_points = AllPoints(config, size) if config.recovery.start_search else None
        self.all_points = AllPoints(config, size) if config.recovery.fallback == "all-points" else None
        self._keyframes = None if variant.keyframes is None else FeatureKeyframes(*variant.keyframes)

    def fresh(self) -> FeatureTarget:
        """A new target without features, with the same settings."""
        return FeatureTarget(self._whole, self.variant)

    def __len__(self) -> int:
        return 0 if self.scan is None else len(self.scan.features.less_planes) + len(self.scan.features.less_edges)

    def begins_by_points(self, attempt: Attempt) -> bool:
        """Whether all points of the scan say where it begins: on a young map, where the start search is on."""
        return self._first_points is not None and attempt.is_young

    def count(self, points: Features) -> int:
        """Number of edges and planar points."""
        return len(points.edges) + len(points.planes)

    def refusal(self, points: Features) -> str:
        """The reason not to register a scan: it has too few features; else empty."""
        if len(points.less_planes) + len(points.less_edges) >= MIN_SOURCE_POINTS:
            return ""
        return f"only {len(points.edges)} edges and {len(points.planes)} planar points"

    def noise(self, history: History) -> FeatureNoise:
        """The noise of features; the recent error of the motion prior sets below which information a direction is degenerate.

        The prior counts at most as one planar point: a sensor on a straight way need not stay on it.
        """
        c, least = self.config, self.config.sigma**2
        return FeatureNoise(EDGE_SIGMA_M, c.sigma, c.weak_share, least / max(history.threshold.mean_square, least))

    def align(
        self, attempt: Attempt, T_start: Floats, annealing: Annealing, information: Floats | None = None
    ) -> RegistrationResult:
        """Align with the scan before and, from there, with the feature map, from `T_start` (4, 4).

        The pose does not move along degenerate directions. `information` (6, 6) of the start joins the features of the map.
        """
        if attempt.is_near:
            annealing = replace(annealing, steps=START_ITERATIONS)
        elif attempt.history.starting > 0:
            annealing = replace(annealing, start=self.config.kernel_max)
        return self._align(attempt, T_start, annealing, information)

    def _align(
        self, attempt: Attempt, T_start: Floats, annealing: Annealing, information: Floats | None = None
    ) -> RegistrationResult:
        """As `align`, with the kernel widths and steps of `annealing`."""
        assert self.scan is not None
        features, noise, iterations = attempt.points, self.noise(attempt.history), 0
        result = RegistrationResult(T_start, ok=False)
        if self.variant.scan_step is not None:
            align = partial(solve_on_scan, self.scan, annealing, noise, self.loam.matching == "one-to-many")
            result = attempt.judge(self.variant.scan_step(align, features, T_start, attempt.clock))
            iterations = result.iterations
        if self.map is not None:
            start = result.T_world_lidar if result.ok else T_start
            with attempt.clock.stage("map"):
                points, scatter = (
                    thin_planes(features) if self.variant.with_less_planes else (features.planes.points, None)
                )
                result = solve_on_map(
                    self.map,
                    features.edges.points,
                    points,
                    start,
                    annealing,
                    noise,
                    scatter=scatter,
                    inlier_ratio=self.variant.inlier_ratio,
                    information=information,
                )
            result = replace(result, iterations=iterations + result.iterations)
        is_remapped = attempt.is_near and len(result.degenerate) > 0
        return remap_solution(result, attempt.T_prior) if is_remapped else result

    def capture(self, attempt: Attempt) -> RegistrationResult:
        """Align from a prior that may be metres off, and check the result.

        Points are registered first, then features as by `align`.
        """
        with attempt.clock.stage("start" if attempt.history.starting else "recover"):
            start = attempt.start = self._start(attempt)
        result = self.align(attempt, start.T_world_lidar, attempt.annealing)
        if not (start.ok and self.begins_by_points(attempt)):
            return attempt.judge(result)
        # Of a first step, which may be of any length, all points know more than the prior.
        judged = attempt.judge(result, start.T_world_lidar)
        if not judged.ok or judged.prior_error[0] > RECOVER_M:
            near = Annealing(RECOVER_M, START_ITERATIONS)
            judged = attempt.judge(self._align(attempt, start.T_world_lidar, near), start.T_world_lidar)
        return attempt.credit(judged, judged.pose_source)

    def on_planes(self, attempt: Attempt, T_start: Floats) -> RegistrationResult:
        """Align edges and centroids of less planar points with fine and coarse planes of the map, and check the result."""
        c, noise = self.config, self.noise(attempt.history)
        points, scatter = thin_planes(attempt.points)
        annealing = Annealing(c.kernel_max, START_ITERATIONS)
        edges = attempt.points.edges.points
        return attempt.judge(solve_on_map(self._planes(), edges, points, T_start, annealing, noise, scatter=scatter))

    def enter(self, result: RegistrationResult) -> None:
        """Insert the registered features into the map; they become the last scan for the next registration."""
        features, T_world_lidar = to_arrays(result.points), result.T_world_lidar
        if self.map is not None and self._keyframes is not None:
            self._keyframes.enter(self.map, features, T_world_lidar)
        elif self.map is not None:
            self.map.insert(features, T_world_lidar)
        if self.all_points is not None:
            self.all_points.enter(result)
        self.scan = feature_scan(features, T_world_lidar, self.loam.grid_step)

    def cloud(self, points: Features) -> NDArray[np.float32]:
        """All points (N, 3) of a scan, m, LiDAR frame."""
        return points.cloud

    def _start(self, attempt: Attempt) -> RegistrationResult:
        """An initial guess for a prior that may be metres off: by all points on a young map, else by less planar ones.

        Less planar points are registered on coarse planes.
        """
        if self._first_points is not None and attempt.is_young:
            return self._first_points.locate(attempt)
        points, scatter = thin_planes(attempt.points)
        target, noise, slow = self._planes(), self.noise(attempt.history), Annealing.slow(COARSE_KERNEL_M)
        coarse = target.planes.coarser[:1]
        return attempt.judge(
            solve_on_map(target, NONE, points, attempt.T_prior, slow, noise, scatter=scatter, levels=coarse)
        )

    def _planes(self) -> FeatureMap:
        """The feature map; without one, a map of the last scan alone."""
        if self.map is not None and len(self.map):
            return self.map
        assert self.scan is not None
        alone = self._new_map(1 << 14)
        alone.insert(self.scan.features, self.scan.T_world_lidar)
        return alone

    def _new_map(self, capacity: int) -> FeatureMap:
        """An empty feature map with room for `capacity` voxels."""
        size = self.loam.feature_map_voxel
        return FeatureMap(size, self._plane_size(size), 1.2 * self._whole.preprocess.range_max, capacity)

    def _plane_size(self, size: float) -> float:
        """Edge, m, of a voxel of planar points, where one of edges has `size`, m."""
        return surface_size(size, self.loam.grid_step)
