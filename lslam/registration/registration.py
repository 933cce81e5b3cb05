"""Scan-to-map registration on arrays: predict, match and weigh, solve, check, accept or hand over to recovery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.config.registration import RegistrationConfig
from lslam.errors import InputError
from lslam.preprocessing.beams import ring_gap
from lslam.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.acceptance import Wording, accepted, failed
from lslam.registration.alignment import MapAlignment
from lslam.registration.constant_velocity import ConstantVelocity
from lslam.registration.local_map import LocalMap
from lslam.registration.residuals import residual_named
from lslam.registration.robust import AdaptiveThreshold, UsualAgreement
from lslam.registration.solver import RegistrationResult
from lslam.registration.source_covariance import source_covariance
from lslam.registration.target import make_target
from lslam.types.state import Stateful

Floats = NDArray[np.float64]

MIN_SOURCE_POINTS = 30
# The kernel opens so many times its end width around a pose that is nearly right.
NEAR_KERNEL = 2.0
# Between scans that come without stamps, ns: most sensors turn ten times a second.
SCAN_NS = 100_000_000
# Share of points with a ring spacing above a voxel from which on the coarse level is searched, too.
SPARSE_SHARE = 0.1
WORDING = Wording("of the points overlap the map", "of the points agree with the map")


class Recovery(Protocol):
    """What is tried where a registration from the motion prior may not be enough."""

    def recover(
        self, registration: Registration, points: PreparedPoints, T_prior: Floats, found: RegistrationResult
    ) -> RegistrationResult:
        """A better result, `posed_by` this policy, or what was found."""
        ...


class Registration(Stateful):
    """Registers scans one after the other against a local map that it keeps.

    recovery : asked in this order after each registration
    """

    STATE = ("map", "target", "threshold", "agreement", "starting", "inserted", "recent", "_motion", "_index",
             "_ring_gap")  # fmt: skip

    def __init__(
        self, config: RegistrationConfig | None = None, preprocess: PreprocessConfig | None = None,
        recovery: Sequence[Recovery] = (),
    ) -> None:  # fmt: skip
        c = self.config = config or RegistrationConfig()
        self.preprocess = preprocess or PreprocessConfig()
        self.recovery = tuple(recovery)
        self.residual = c.residual or "plane"
        self.kind = residual_named(self.residual)
        self.target = make_target(c)
        # On keyframes far apart a sparse sensor matches few of its points: only a drop of the inlier ratio is informative.
        self._gates = c.model_copy(update={"min_inliers": 0.0}) if c.target == "submap" else c
        self.map = LocalMap(
            c.voxel_size * self.kind.voxel_share, coarse_factor=c.coarse_factor,
            min_points=c.min_points, planarity=c.planarity, count_cap=c.count_cap, reach=1.2 * self.preprocess.range_max,
        )  # fmt: skip
        self.alignment = MapAlignment(self.map, c, self.residual)
        self.threshold = AdaptiveThreshold(c.kernel_min, c.kernel_max)
        self.agreement = UsualAgreement(c.min_agreement)
        # Initialisation scans that remain, scans in the map, and the last of them with their poses.
        self.starting, self.inserted = c.start_scans, 0
        self.recent: tuple[tuple[NDArray[np.float32], Floats], ...] = ()
        self._motion, self._index = ConstantVelocity(), 0
        # Vertical angular resolution, rad, for point to point; 0 where unknown.
        self._ring_gap = 0.0

    def register(self, points: NDArray[Any], prior: Floats | None = None) -> RegistrationResult:
        """Pose of points (N, 3), m, LiDAR frame; without `prior` (4, 4) the velocity is taken as constant."""
        return self.align(prepare_points(points, self.preprocess, self._index), prior)

    def align(self, points: PreparedPoints, prior: Floats | None = None) -> RegistrationResult:
        """As `register`, for points that are prepared already; aligns, judges, then updates the map.

        Raises InputError for a prior that is no finite (4, 4).
        """
        T_prior = self._motion.predict(self._index * SCAN_NS) if prior is None else np.asarray(prior, np.float64)
        if T_prior.shape != (4, 4) or not np.isfinite(T_prior).all():
            raise InputError(f"the motion prior has shape {T_prior.shape}: a finite (4, 4) pose is needed")
        result = self.locate(points, T_prior)
        self.update(points, result)
        return result

    def locate(
        self, points: PreparedPoints, T_prior: Floats, is_near: bool = False, information: Floats | None = None
    ) -> RegistrationResult:
        """Register without updating the map; the result says whether it is accepted.

        is_near : local registration: narrow kernel, no recovery
        information : (6, 6) of the prior, world axes, added to the normal equations; None: the prior is the initial guess only
        """
        count, c = len(points.source), self.config
        if count < MIN_SOURCE_POINTS:
            return failed(T_prior, count, f"{count} usable points, {MIN_SOURCE_POINTS} needed")
        if len(self.map) == 0:
            return RegistrationResult(T_prior, covariance=np.diag([1e-12] * 6), source_points=count)
        points = self.covered(points)
        if self.kind.needs_gaps:
            points = replace(points, gaps=self._gaps(points))
        width, steps = self.threshold.width, c.max_iterations * self.kind.times_steps
        if is_near:
            width = NEAR_KERNEL * c.kernel_min
        elif self.starting > 0:
            steps = c.start_iterations
        result = self.judged(self.alignment.refine(points, T_prior, width, steps, information=information), T_prior)
        for policy in () if is_near else self.recovery:
            result = policy.recover(self, points, T_prior, result)
        return result

    def covered(self, points: PreparedPoints) -> PreparedPoints:
        """The points with the covariance of the surface at each of them, where the residual asks for it."""
        if not self.kind.needs_covariance or points.covariance is not None:
            return points
        c = self.config
        found = source_covariance(points.source, points.map_points, c.sigma**2, c.neighbourhood)
        return replace(points, covariance=found)

    def update(self, points: PreparedPoints, result: RegistrationResult) -> None:
        """Insert the scan into the map unless its registration failed; adapt thresholds unless its pose was overruled."""
        is_first = len(self.map) == 0
        if result.ok:
            self.enter(points, result.T_world_lidar)
        self.observe(result, is_first)

    def enter(self, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Insert a scan into the map at its pose (4, 4)."""
        self.target.enter(self.map, points, T_world_lidar)
        self.inserted += 1
        self.recent = (*self.recent, (points.map_points, T_world_lidar))[-self.config.start_scans :]

    def observe(self, result: RegistrationResult, is_first: bool = False) -> None:
        """Adapt thresholds to a registration, unless its pose was overruled (`is_denied`) or the map was empty."""
        if not result.ok:
            self.starting = max(self.starting, 1)
            self.threshold.widen()
            self.agreement.relax()
        elif not is_first and not result.is_denied:
            self.starting = max(self.starting - 1, 0)
            self.agreement.observe(result.agreement)
            move, turn = result.prior_error
            self.threshold.observe(move + turn * result.lever_arm)
        self._motion.correct(self._index * SCAN_NS, result.T_world_lidar)
        self._index += 1

    def _gaps(self, points: PreparedPoints) -> Floats | None:
        """(S,) m, ring spacing at each source point; the angular resolution is estimated from the first scans."""
        if self.inserted <= self.config.start_scans:
            self._ring_gap = ring_gap(points.map_points)
        gaps: Floats = self._ring_gap * np.linalg.norm(points.source, axis=1)
        return gaps if (gaps > self.map.fine.size).mean() > SPARSE_SHARE else None

    def is_small(self, result: RegistrationResult) -> bool:
        """Whether the correction of the motion prior is within the prediction error that is expected of it."""
        move, turn = result.prior_error
        return move < self.config.recover_m and turn < np.deg2rad(self.config.recover_deg)

    def judged(self, result: RegistrationResult, T_prior: Floats) -> RegistrationResult:
        """The result with its correction of the prior, or a failed one at the prior with the reason."""
        # One scan of a sparse sensor makes few planes: what matches them may be right and yet a small share.
        c, is_filled = self.config, self.inserted > self.config.start_scans and self.config.target != "scan"
        return accepted(
            result, T_prior, self._gates, self.agreement, c.min_overlap if is_filled else c.start_overlap, WORDING
        )
