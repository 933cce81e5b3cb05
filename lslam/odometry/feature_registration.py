"""Registration of features, scan after scan: the engine of `loam-odom`, `loam`, `floam` and `lego-loam`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.loam import LoamConfig
from lslam.config.recovery import RecoveryConfig
from lslam.config.registration import RegistrationConfig
from lslam.geometry import se3
from lslam.odometry.all_points import AllPoints
from lslam.odometry.feature_map import FeatureKeyframes, FeatureMap, thinned
from lslam.odometry.feature_scan import FeatureScan, feature_scan, surface_size
from lslam.odometry.feature_solver import NONE, FeatureNoise, remap_solution, solve_on_map
from lslam.odometry.feature_steps import ScanStep
from lslam.preprocessing.features import Features
from lslam.recovery.start_search import MUCH, START_STEP, start_offsets
from lslam.registration.acceptance import Wording, accepted, failed
from lslam.registration.registration import NEAR_KERNEL
from lslam.registration.robust import AdaptiveThreshold, Annealing, UsualAgreement
from lslam.registration.solver import RegistrationResult
from lslam.types.stage_clock import StageClock
from lslam.types.state import Stateful

Floats = NDArray[np.float64]

# Fewer inliers, ten per degree of freedom, are insignificant.
MIN_FEATURES = 60
# A failed scan is no target; after this many in a row the last good one is too far behind.
PATIENCE = 3
WORDING = Wording("of the features have a counterpart", "of the features agree")
# In `posed_by`.
LESS_PLANAR = "less planar points"


class FeatureRegistration(Stateful):
    """Registers features on the scan before, on a feature map, or on one after the other: `locate`, then `update`.

    Parameters
    ----------
    scan_step : how a scan is registered on the one before; None leaves that out
    with_map : whether the pose is found, or refined, on the feature map
    with_less_planes : whether the map is matched with centroids of the less planar points in place of the planar points
    reach : m, how far from the sensor the map is kept
    keyframes : decides which scans are in the feature map; None enters all, until the sensor has left them behind
    recovery : what is tried where features are not enough; `start_search` is by edges, or by all points with that fallback
    inlier_ratio : share of the correspondences with the feature map, the nearest, that have a say
    """

    STATE = (
        "map", "target", "threshold", "agreement", "_starting", "_inserted", "_failures", "_all", "_keyframes",
    )  # fmt: skip

    def __init__(
        self, config: RegistrationConfig, loam: LoamConfig, *, scan_step: ScanStep | None, with_map: bool,
        with_less_planes: bool = False, reach: float = 120.0, recovery: RecoveryConfig | None = None,
        keyframes: FeatureKeyframes | None = None, inlier_ratio: float = 1.0,
    ) -> None:  # fmt: skip
        self.config, self.loam, self.recovery = config, loam, recovery or RecoveryConfig()
        self._step, self._with_less_planes, self._reach = scan_step, with_less_planes, reach
        self._inlier_ratio = inlier_ratio
        self.map: FeatureMap | None = self._new_map(1 << 16) if with_map else None
        self.target: FeatureScan | None = None
        self._usual = FeatureNoise(loam.edge_sigma, config.sigma, config.weak_share)
        self.threshold = AdaptiveThreshold(config.kernel_min, config.kernel_max)
        self.agreement = UsualAgreement(config.min_agreement)
        self._starting = config.start_scans
        self._inserted = 0
        self._failures = 0
        size = surface_size(config.voxel_size, loam.grid_step)
        self._keyframes = keyframes
        self._all = AllPoints(config, size) if self.recovery.fallback == "all-points" else None

    @property
    def noise(self) -> FeatureNoise:
        """With the recent variance of the motion prior as threshold of degeneracy.

        The prior counts at most as one planar point: a sensor on a straight way need not stay on it.
        """
        return replace(self._usual, least=self.config.sigma**2 / max(self.threshold.mean_square, self.config.sigma**2))

    def locate(
        self, features: Features, T_prior: Floats, clock: StageClock, is_near: bool = False
    ) -> RegistrationResult:
        """Align with the target; the result says whether it is accepted, and whether a fallback posed it.

        is_near : the prior is nearly right: no search, and solution remapping onto it
        """
        count = len(features.edges) + len(features.planes)
        if len(features.less_planes) + len(features.less_edges) < MIN_FEATURES:
            return failed(T_prior, count, f"only {len(features.edges)} edges and {len(features.planes)} planar points")
        if self.target is None:
            return RegistrationResult(T_prior, covariance=np.diag([1e-12] * 6), source_points=count)
        if is_near:
            result = self._attempt(features, T_prior, T_prior, clock, self._near)
            return self._remapped(result, T_prior, T_prior) if result.ok else result
        if self._starting > 0 and self.recovery.coarse_to_fine:
            with clock.stage("start"):
                start = self._capture(features, T_prior)
            result = self._attempt(features, start.T_world_lidar, T_prior, clock, self._quick)
        else:
            start = RegistrationResult(T_prior)
            result = self._attempt(features, T_prior, T_prior, clock, self._quick)
            move, turn = result.prior_error
            is_off = not result.ok or move > self.config.recover_m or turn > np.deg2rad(self.config.recover_deg)
            if is_off and self.recovery.coarse_to_fine:
                with clock.stage("recover"):
                    start = self._capture(features, T_prior)
                again = self._attempt(features, start.T_world_lidar, T_prior, clock, self._quick)
                if again.ok and (not result.ok or again.inliers > result.inliers):
                    result = again
        # Only a map constrains more than a scan's features: there less planar points may observe a degenerate direction.
        is_open = len(result.degenerate) > 0 and self.map is not None
        if self.recovery.less_planar and (not result.ok or result.inliers < MIN_FEATURES or is_open):
            with clock.stage("stand-in"):
                result = self._fallback(features, start, T_prior, result)
        if result.ok:
            # The first step's prior is a guess, which the search has replaced.
            expected = T_prior if self._inserted > 1 else start.T_world_lidar
            result = self._remapped(result, expected, T_prior)
        return result if self._all is None else self._held(self._all, features, start, T_prior, result, clock)

    def _held(
        self, points: AllPoints, features: Features, start: RegistrationResult, T_prior: Floats,
        result: RegistrationResult, clock: StageClock,
    ) -> RegistrationResult:  # fmt: skip
        """The features' result, unless all points contradict it or constrain a poorly constrained pose."""
        is_far = not result.ok or result.prior_error[0] > self.config.recover_m
        is_young = self._young is not None
        if self.config.start_reach > 0 and (is_young or is_far):
            with clock.stage("start" if self._starting else "recover"):
                T_start = start.T_world_lidar if is_young else T_prior
                result = points.held(features, T_start, T_prior, result)
        if self.map is not None and not self._is_well_constrained(result):
            with clock.stage("all-points"):
                result = points.fallback(features, T_prior, result, start if is_young else None)
        return result

    def _is_well_constrained(self, result: RegistrationResult) -> bool:
        """Whether the features constrain the position as well as `ENOUGH` planar points of one normal."""
        return result.is_well_constrained(self.config.sigma)

    def _remapped(self, result: RegistrationResult, expected: Floats, T_prior: Floats) -> RegistrationResult:
        """The result remapped onto `expected` (4, 4) along its degenerate directions."""
        if not len(result.degenerate):
            return result
        return self._judge(remap_solution(result, expected), T_prior)

    def update(self, features: Features, result: RegistrationResult) -> None:
        """Insert the scan into map and target unless its registration failed; adapt thresholds unless it was denied."""
        if result.ok:
            self._inserted += 1
            if self.map is not None and self._keyframes is not None:
                self._keyframes.enter(self.map, features, result.T_world_lidar)
            elif self.map is not None:
                self.map.insert(features, result.T_world_lidar)
            if self._all is not None:
                self._all.update(features, result)
            if self.target is not None and not result.is_denied:
                self._starting = max(self._starting - 1, 0)
                # All points agree less with their map than features do with theirs.
                own = result if self._all is None else self._all.by_features(features, result)
                if own.ok:
                    self.agreement.observe(own.agreement)
                move, turn = result.prior_error
                self.threshold.observe(move + turn * result.lever_arm)
            self._failures = 0
        else:
            self._failures += 1
            self._starting = max(self._starting, 1)
            self.threshold.widen()
            self.agreement.relax()
        # Before anything was registered there is nothing to lie far behind: the first good scan is the first.
        if result.ok or (self._inserted > 0 and self._failures >= PATIENCE):
            self.target = feature_scan(features, result.T_world_lidar, self.loam.grid_step)

    @property
    def _quick(self) -> Annealing:
        """From the recent error of the motion prior."""
        c, is_starting = self.config, self._starting > 0
        width, steps = (c.kernel_max, c.start_iterations) if is_starting else (self.threshold.width, c.max_iterations)
        return Annealing(width, c.kernel_min, c.kernel_decay, steps)

    @property
    def _near(self) -> Annealing:
        """Around a prior that is nearly right."""
        c = self.config
        return Annealing(NEAR_KERNEL * c.kernel_min, c.kernel_min, c.kernel_decay, c.start_iterations)

    def _attempt(
        self, features: Features, T_start: Floats, T_prior: Floats, clock: StageClock, quick: Annealing
    ) -> RegistrationResult:
        """The method's own stages, judged."""
        result, iterations = RegistrationResult(T_start, ok=False), 0
        assert self.target is not None
        if self._step is not None:
            result = self._step(
                self.target, features, T_start, quick, self.noise, self.loam.matching == "one-to-many", clock
            )
            result = self._judge(result, T_prior)
            iterations = result.iterations
        if self.map is not None:
            start = result.T_world_lidar if result.ok else T_start
            with clock.stage("map"):
                points, scatter = thinned(features) if self._with_less_planes else (features.planes.points, None)
                result = solve_on_map(
                    self.map, features.edges.points, points, start, quick, self.noise, scatter=scatter,
                    inlier_ratio=self._inlier_ratio,
                )  # fmt: skip
            result = self._judge(result, T_prior)
        return replace(result, iterations=result.iterations + (iterations if self.map is not None else 0))

    @property
    def _young(self) -> AllPoints | None:
        """All points of the scans, while these are so few that all points are asked for the pose, as `icp` asks them."""
        is_young = self.config.start_reach > 0 and self._inserted <= self.config.start_scans
        return self._all if is_young else None

    def _capture(self, features: Features, T_prior: Floats) -> RegistrationResult:
        """A start that is metres nearer, where the prior may be metres off: less planar points on coarse planes."""
        c = self.config
        if self._young is not None:
            return self._young.locate(features, T_prior)
        points, scatter = thinned(features)
        target = self._planes()

        def on_coarse(start: Floats, width: float) -> RegistrationResult:
            slow = Annealing(width, c.kernel_min, c.coarse_decay, c.start_iterations)
            return solve_on_map(
                target, NONE, points, start, slow, self.noise, scatter=scatter, levels=target.planes.coarser[:1]
            )

        found = self._judge(on_coarse(T_prior, c.coarse_kernel), T_prior)
        if self._inserted > 1 or not self.recovery.start_search:
            return found
        # Planes slide along a road; edges repeat nowhere at once. Few of them decide nothing: two sigma of what is counted.
        offsets = [se3.make(np.eye(3), offset) for offset in start_offsets(c.start_reach, START_STEP)]
        tried = [self._judge(on_coarse(T_prior @ T, 2 * START_STEP), T_prior) for T in offsets]
        agree = [self._edges_at(target, features, result) for result in tried]
        most, known = max(agree, default=0), max(self._edges_at(target, features, found), 0)
        is_more = most > MUCH * known and most - known > 2 * np.sqrt(most + known)
        return tried[int(np.argmax(agree))] if is_more else found

    def _edges_at(self, target: FeatureMap, features: Features, result: RegistrationResult) -> int:
        """How many of the less sharp edges lie on edges of the map; -1 where the registration failed."""
        if not result.ok:
            return -1
        width = self.config.kernel_max / 2
        once = Annealing(width, width, 0.5, 1)
        pose = result.T_world_lidar
        return solve_on_map(target, features.less_edges.points, NONE, pose, once, self.noise).inliers

    def _fallback(
        self, features: Features, start: RegistrationResult, T_prior: Floats, starved: RegistrationResult
    ) -> RegistrationResult:
        """Fallback to less planar points where features are too few or degenerate.

        With the fallback of all points and a young map these are registered already, and preferred.
        """
        T_start = starved.T_world_lidar if starved.ok else start.T_world_lidar
        result = start if self._young is not None else self._on_planes(features, T_start, T_prior)
        are_few = starved.inliers < MIN_FEATURES
        # The fallback must observe a degenerate direction; with too few features it may not add one.
        if not result.ok or (starved.ok and len(result.degenerate) > len(starved.degenerate) - (not are_few)):
            return starved
        return replace(result, posed_by=LESS_PLANAR)

    def _on_planes(self, features: Features, T_start: Floats, T_prior: Floats) -> RegistrationResult:
        """Edges, and centroids of the less planar points, on fine and coarse planes."""
        c = self.config
        points, scatter = thinned(features)
        quick = Annealing(c.kernel_max, c.kernel_min, c.kernel_decay, c.start_iterations)
        result = solve_on_map(
            self._planes(), features.edges.points, points, T_start, quick, self.noise, scatter=scatter
        )
        return self._judge(result, T_prior)

    def _planes(self) -> FeatureMap:
        """The feature map, or one made of the target scan alone."""
        if self.map is not None and len(self.map):
            return self.map
        assert self.target is not None
        alone = self._new_map(1 << 14)
        alone.insert(self.target.features, self.target.T_world_lidar)
        return alone

    def _new_map(self, capacity: int) -> FeatureMap:
        c = self.config
        return FeatureMap(
            self.loam.feature_map_voxel, plane_size=self._plane_size(), coarse_factor=c.coarse_factor,
            min_points=c.min_points, planarity=c.planarity, count_cap=c.count_cap, reach=self._reach, capacity=capacity,
        )  # fmt: skip

    def _plane_size(self) -> float:
        return surface_size(self.loam.feature_map_voxel, self.loam.grid_step)

    def _judge(self, result: RegistrationResult, T_prior: Floats) -> RegistrationResult:
        """The result with its correction of the prior, or a failed one that keeps the prior and says why."""
        c = self.config
        return accepted(
            result, T_prior, c, self.agreement, c.start_overlap if self._starting else c.min_overlap, WORDING
        )
