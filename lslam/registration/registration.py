"""Scan-to-map registration on arrays: the engine of `icp`, usable by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.config.registration import RegistrationConfig, Residual
from lslam.errors import InputError
from lslam.geometry import se3, so3
from lslam.preprocessing.beams import ring_gap
from lslam.preprocessing.prepare import PreparedPoints, prepare_points, thin
from lslam.registration.alignment import MapAlignment
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.motion import ConstantVelocity
from lslam.registration.recent_scans import RecentScans
from lslam.registration.residuals import NEEDS_COVARIANCE, residual_named
from lslam.registration.robust import AdaptiveThreshold, UsualAgreement
from lslam.registration.solver import RegistrationResult
from lslam.registration.source_covariance import source_covariance
from lslam.registration.start_search import (
    CLEARLY,
    SEARCH_SHARE,
    START_STEP,
    StandingPoints,
    distinct,
    is_at_rest,
    is_much_more,
    start_offsets,
)
from lslam.registration.target import make_target
from lslam.types.state import Stateful

MIN_SOURCE_POINTS = 30
# The kernel opens so many times its end width around a pose that is nearly right.
NEAR_KERNEL = 2.0
# Sigma; what stands lies elsewhere when it lies farther off than this.
APART = 3.0

# Between scans that come without stamps, ns: most sensors turn ten times a second.
SCAN_NS = 100_000_000

# Point to point: of the voxel size, because a voxel's mean stands for one point of its surface, its plane for all.
POINT_VOXEL = 0.625
# A few points at the edge of sight are not worth a second map.
SPARSE_SHARE = 0.1
# Times the steps: a point is drawn to where its match is, not to where the surfaces meet, and the score of a normal
# distribution has no pull on points a few sigma away, so that those near by turn the sensor a little with each step.
SLOWLY: dict[Residual, int] = {"point": 3, "ndt": 3}

# Half a metre and two degrees: what a pose that no scan supports may be wrong by, one sigma.
DOUBT = np.diag([0.25] * 3 + [np.deg2rad(2.0) ** 2] * 3)


class Registration(Stateful):
    """Registers scans one after the other against a local map that it keeps.

    >>> import numpy as np
    >>> from lslam import Registration
    >>> registration = Registration()
    >>> result = registration.register(np.random.default_rng(0).uniform(-20, 20, (5000, 3)))
    >>> result.T_world_lidar.shape
    (4, 4)
    """

    STATE = ("map", "target", "threshold", "agreement", "_motion", "_index", "_starting", "_inserted", "_recent",
             "_ring_gap")  # fmt: skip

    def __init__(self, config: RegistrationConfig | None = None, preprocess: PreprocessConfig | None = None) -> None:
        self.config = config or RegistrationConfig()
        self.preprocess = preprocess or PreprocessConfig()
        self.residual: Residual = self.config.residual or "plane"
        residual_named(self.residual)
        self.target = make_target(self.config.target, self.config.keyframes)
        self.map = GaussianMap(
            self.config.voxel_size * (POINT_VOXEL if self.residual == "point" else 1.0),
            min_points=self.config.min_points,
            planarity=self.config.planarity,
            count_cap=self.config.count_cap,
            reach=1.2 * self.preprocess.range_max,
        )
        self._alignment = MapAlignment(self.map, self.config, self.residual)
        self.threshold = AdaptiveThreshold(self.config.kernel_min, self.config.kernel_max)
        self.agreement = UsualAgreement(self.config.min_agreement)
        self._motion = ConstantVelocity()
        self._index = 0
        self._starting = self.config.start_scans
        self._inserted = 0
        # Angle between rings, rad, for point to point; 0 where unknown.
        self._ring_gap = 0.0
        self._recent = RecentScans(self.config.start_scans, self.preprocess)

    def register(self, points: NDArray[Any], prior: NDArray[np.float64] | None = None) -> RegistrationResult:
        """Pose of points (N, 3), m, LiDAR frame; without `prior` (4, 4) the velocity is taken as constant."""
        return self.align(prepare_points(points, self.preprocess, self._index), prior)

    def align(self, points: PreparedPoints, prior: NDArray[np.float64] | None = None) -> RegistrationResult:
        """As `register`, for points that are prepared already; aligns, judges, then updates the map.

        Raises InputError for a prior that is no finite (4, 4).
        """
        T_prior = self._motion.predict(self._index * SCAN_NS) if prior is None else np.asarray(prior, np.float64)
        if T_prior.shape != (4, 4) or not np.isfinite(T_prior).all():
            raise InputError(f"the motion prior has shape {T_prior.shape}: a finite (4, 4) pose is needed")
        result = self.locate(points, T_prior)
        self.update(points, result)
        return result

    def locate(self, points: PreparedPoints, T_prior: NDArray[np.float64], is_near: bool = False) -> RegistrationResult:
        """Align with the map as it is; the result says whether to believe it.

        is_near : the prior is nearly right: nothing is sought away from it
        """
        if len(points.source) < MIN_SOURCE_POINTS:
            return _failed(
                T_prior, len(points.source), f"{len(points.source)} usable points, {MIN_SOURCE_POINTS} needed"
            )
        if len(self.map) == 0:
            return RegistrationResult(T_prior, covariance=np.diag([1e-12] * 6), source_points=len(points.source))
        if self.residual in NEEDS_COVARIANCE and points.covariance is None:
            found = source_covariance(points.source, points.map_points, self.config.sigma**2)
            points = replace(points, covariance=found)
        if self.residual == "point":
            points = replace(points, gaps=self._gaps(points))
        if self._starting > 0 and not is_near:
            return self._start(points, T_prior)
        c = self.config
        # One scan alone puts single rings into fine voxels; several fill them.
        are_few = c.target == "scan" or self._starting > 0
        coarse_map = self.map.coarsen(c.coarse_factor) if are_few else None
        steps = c.max_iterations * SLOWLY.get(self.residual, 1)
        width = NEAR_KERNEL * c.kernel_min if is_near else self.threshold.width
        fine = self._judge(self._alignment.refine(points, T_prior, width, steps, coarse_map), T_prior)
        if is_near:
            return fine
        move, turn = fine.prior_error
        is_small = move < c.recover_m and turn < np.deg2rad(c.recover_deg)
        # A prior that is wrong by more than the kernel reaches can be held by the sensor's own rings, hardly corrected.
        if fine.ok and is_small and not self.agreement.is_less(self._agreement(fine)):
            return self._steadied(points, T_prior, fine)
        coarse = self._judge(self._alignment.coarse_to_fine(points, T_prior), T_prior)
        coarse = replace(coarse, iterations=coarse.iterations + fine.iterations)
        is_better = coarse.ok and coarse.inliers > fine.inliers
        if fine.ok and is_small:
            # What hides part of the map, as a crowd does, hides it from both.
            is_better = is_better and not self.agreement.is_less(self._agreement(coarse))
        best = coarse if not fine.ok or is_better else fine
        is_far = not best.ok or best.prior_error[0] >= c.recover_m
        best = self.held(points, T_prior, best) if is_far and c.start_reach > 0 else best
        return self._steadied(points, T_prior, best)

    def update(self, points: PreparedPoints, result: RegistrationResult) -> None:
        """Enter the scan into the map unless its registration failed; learn from it unless it was denied."""
        if result.ok:
            first = len(self.map) == 0
            self.target.enter(self.map, points.map_points, result.T_world_lidar)
            self._inserted += 1
            self._recent.enter(points.map_points, result.T_world_lidar)
            if not first and not result.is_denied:
                self._starting = max(self._starting - 1, 0)
                self.agreement.observe(self._agreement(result))
                move, turn = result.prior_error
                self.threshold.observe(move + turn * result.lever_arm)
        else:
            self._starting = max(self._starting, 1)
            self.threshold.widen()
            self.agreement.relax()
        self._motion.correct(self._index * SCAN_NS, result.T_world_lidar)
        self._index += 1

    def held(
        self, points: PreparedPoints, T_prior: NDArray[np.float64], found: RegistrationResult, *, is_lost: bool = False
    ) -> RegistrationResult:
        """What was found, unless much more of what stands on the ground agrees elsewhere.

        The few rings of a sparse sensor make planes on the road that move with it, and most of its points lie there.
        is_lost : whether the sensor may be anywhere within `start_reach`, which a failed registration says too
        """
        standing, seen = self._recent.standing(), self._recent.seen_in(points.map_points)
        starts = [T_prior]
        if is_lost:
            found = self._search(points, T_prior, found, standing, seen)
        if is_lost or not found.ok:
            starts.append(standing.likeliest(seen, T_prior, self.config.start_reach))

        def share(result: RegistrationResult) -> float:
            return standing.share(seen, result.T_world_lidar)

        stood = max((standing.align(seen, start) for start in starts), key=share)
        place = stood.T_world_lidar
        is_drawn = found.ok and is_at_rest(place, self._recent.scans[-1][1])
        if is_drawn or not is_much_more(share(stood), share(found), len(seen.source)):
            return found
        width = NEAR_KERNEL * self.config.kernel_min
        near = self._alignment.refine(
            points, place, width, self.config.start_iterations, self._alignment.coarse_map(points, place)
        )
        judged = self._judge(near, place)
        if not judged.ok and not found.ok:
            return found
        if not judged.ok or is_much_more(share(stood), share(judged), len(seen.source)):
            place = standing.place_on_ground(place, near.T_world_lidar, points.map_points)
            judged = near.moved(place, stood.covariance)
        return replace(
            judged, iterations=found.iterations + near.iterations, prior_error=correction(T_prior, judged.T_world_lidar)
        )

    def _steadied(
        self, points: PreparedPoints, T_prior: NDArray[np.float64], found: RegistrationResult
    ) -> RegistrationResult:
        """What was found, where planes hold the place well; else with a say of what stands on the ground.

        Few rings make planes that slide with the sensor, by decimetres from scan to scan and without a sign of it. What stands
        is asked about the direction that planes hold worst, by the variances of both; where it lies clearly elsewhere, it is
        believed.
        """
        doubt = found.covariance
        if self.config.start_reach == 0 or not found.ok or doubt is None or found.holds_place(self.config.sigma):
            return found
        # Along bare walls, which nothing observes, the sensor's own rings agree best where nothing moved.
        if len(found.degenerate):
            return found
        standing, seen = self._recent.standing(), self._recent.seen_in(points.map_points)

        def share(result: RegistrationResult) -> float:
            return standing.share(seen, result.T_world_lidar)

        stood = max((standing.align(seen, start) for start in (found.T_world_lidar, T_prior)), key=share)
        if stood.covariance is None or share(stood) <= share(found):
            return found
        off, theirs = (stood.T_world_lidar - found.T_world_lidar)[:3, 3], stood.covariance[:3, :3]
        if off[:2] @ np.linalg.solve(theirs[:2, :2], off[:2]) > APART**2:
            place = standing.place_on_ground(stood.T_world_lidar, found.T_world_lidar, points.map_points)
            found = found.moved(place, stood.covariance)
        else:
            values, axes = np.linalg.eigh(doubt[:3, :3])
            loosest = axes[:, -1]
            part = values[-1] / (values[-1] + loosest @ theirs @ loosest)
            place = found.T_world_lidar.copy()
            place[:3, 3] += part * (loosest @ off) * loosest
            found = found.moved(place, doubt)
        return replace(found, prior_error=correction(T_prior, place))

    @property
    def _is_begun(self) -> bool:
        """Whether so few scans are in the map that what stands on the ground is asked too."""
        return self.config.start_reach > 0 and self._inserted <= self.config.start_scans

    def _start(self, points: PreparedPoints, T_prior: NDArray[np.float64]) -> RegistrationResult:
        """Coarse to fine; while the map is made of a few scans, what stands on the ground has the last word."""
        found = self._judge(self._alignment.coarse_to_fine(points, T_prior), T_prior)
        return self.held(points, T_prior, found, is_lost=self._inserted == 1) if self._is_begun else found

    def _search(
        self, points: PreparedPoints, T_prior: NDArray[np.float64], best: RegistrationResult,
        standing: StandingPoints, seen: PreparedPoints,
    ) -> RegistrationResult:  # fmt: skip
        """The best of several starts: nothing is known yet of how fast the sensor moves.

        Posts and crash barriers repeat every few metres, so the nearest agreement may be a false one; what stands on the
        ground tells. A few points on the coarse map show which starts are worth a whole registration.
        """
        coarse_map, few = self._alignment.coarse_map(points, T_prior), thin(points, SEARCH_SHARE)
        slow = self._alignment.slowly(2 * START_STEP)
        tried = [
            self._alignment.on_planes(coarse_map, few, T_prior @ se3.make(np.eye(3), offset), slow)
            for offset in start_offsets(self.config.start_reach, START_STEP)
        ]
        # Where nothing stands, as in hills, what matches the ground is all that tells.
        tried.sort(key=lambda found: (-standing.share(seen, found.T_world_lidar), -found.inliers))
        for promising in distinct(tried, best.T_world_lidar):
            start = promising.T_world_lidar
            # Once more as wide as from an unknown start, what was found right could be drawn to the false place again.
            found = self._judge(self._alignment.coarse_to_fine(points, start, 2 * START_STEP), start)
            share, known = (standing.share(seen, result.T_world_lidar) for result in (found, best))
            # A failed one has the prior's pose: where less stands than there, nothing is found.
            if found.ok and (share > CLEARLY * known if best.ok else share >= known):
                best = replace(found, prior_error=correction(T_prior, found.T_world_lidar))
        return best

    def _gaps(self, points: PreparedPoints) -> NDArray[np.float64] | None:
        """(S,) m, between the rings at each source point, or None where they are seldom farther apart than a voxel.

        The angle between rings is learnt while the map is young.
        """
        if self._inserted <= self.config.start_scans:
            self._ring_gap = ring_gap(points.map_points)
        gaps: NDArray[np.float64] = self._ring_gap * np.linalg.norm(points.source, axis=1)
        return gaps if (gaps > self.map.size).mean() > SPARSE_SHARE else None

    def _agreement(self, result: RegistrationResult) -> float:
        """Share of the points on the map's surfaces; those of a single scan are coarse ones where its rings lie apart."""
        coarse_too = result.inliers / max(result.source_points, 1)
        return coarse_too if self.config.target == "scan" else result.agreement

    def _judge(self, result: RegistrationResult, T_prior: NDArray[np.float64]) -> RegistrationResult:
        """The result with its correction of the prior, or a failed one that keeps the prior and says why."""
        c = self.config
        move, turn = correction(T_prior, result.T_world_lidar)
        reason = result.reason
        # One scan of a sparse sensor makes few planes: what matches them may be right and yet a small share.
        is_filled = self._inserted > c.start_scans and c.target != "scan"
        needed = c.min_overlap if is_filled else c.start_overlap
        if not reason and result.overlap < needed:
            reason = f"only {result.overlap:.0%} of the points overlap the map"
        elif not reason and result.inlier_share < c.min_inliers:
            reason = f"only {result.inlier_share:.0%} of the matches agree"
        elif not reason and self.agreement.is_collapse(self._agreement(result)):
            reason = f"only {self._agreement(result):.0%} of the points agree with the map, lately {self.agreement.usual:.0%} did"
        elif not reason and (move > c.max_jump_m or turn > np.deg2rad(c.max_jump_deg)):
            reason = f"impossible jump of {move:.1f} m and {np.rad2deg(turn):.0f} deg"
        if reason:
            return replace(_failed(T_prior, result.source_points, reason), iterations=result.iterations)
        return replace(result, prior_error=(move, turn))


def correction(T_prior: NDArray[np.float64], pose: NDArray[np.float64]) -> tuple[float, float]:
    """How far (m, rad) the pose is from what was expected."""
    delta = se3.relative(T_prior, pose)
    return float(np.linalg.norm(delta[:3, 3])), float(so3.angle(delta[:3, :3]))


def _failed(T_prior: NDArray[np.float64], source_points: int, reason: str) -> RegistrationResult:
    """The motion prior, in doubt."""
    return RegistrationResult(
        T_prior.copy(), ok=False, reason=reason, covariance=DOUBT.copy(), converged=False, source_points=source_points
    )
