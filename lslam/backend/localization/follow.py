"""Scans registered one after the other on a map that does not change, with odometry as the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lslam.backend.graph.drift import drift_covariance
from lslam.backend.graph.odometry_constraints import growth
from lslam.backend.localization.prior_map import MAP_MIN_INLIERS, MAP_MIN_OVERLAP, LocalView
from lslam.core.config.config import Config
from lslam.core.geometry import noise, se3, so3
from lslam.core.geometry.noise import quantile
from lslam.core.types.arrays import Floats
from lslam.core.types.constraint import FixStatus, MapFix
from lslam.core.types.scan import LEVER_M
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.registration.acceptance import Acceptance, correction
from lslam.registration.alignment import MapAlignment
from lslam.registration.attempt import NEAR_KERNEL_FACTOR
from lslam.registration.history import UsualAgreement
from lslam.registration.optimiser import COARSE_KERNEL_M, KERNEL_MIN_M, optimise
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

# Sigmas that the kernel spans, and the chance that the innovation of a scan that the map holds lies beyond its gate.
SIGMAS, CHANCE = 3.0, 1e-4
# Finds the pose (4, 4) of a scan of that position anew within a radius, m, of the prior; None where it does not.
Search = Callable[[int, Floats, float], Floats | None]


class MapFollower(Stateful):
    """An error-state Kalman filter over SE(3): odometry predicts, registration on the map corrects.

    The prior's information enters the normal equations, so that the map corrects where its surfaces constrain a pose and odometry
    decides along directions that they leave open. What the map corrects never changes the map.

    T, P : pose (4, 4) in level axes of the map and its covariance (6, 6), of the scan seen last, as independent steps add up
    way : m since the map last held a scan, over which odometry drifts steadily
    R_level_odometry : (3, 3) axes of odometry's world in those of the map
    """

    STATE = ("T", "P", "way", "usual")

    def __init__(self, view: LocalView, T: Floats, P: Floats, config: Config, search: Search | None = None) -> None:
        self.view, self.T, self.P, self.config, self.search = view, T, P, config, search
        self.way = 0.0
        self.usual = UsualAgreement(config.registration.min_agreement)
        self._gate = quantile(1.0 - CHANCE, 6)
        c = config.loops
        # What maps and registrations err by in common from scan to scan.
        self._floor = np.diag([c.sigma_m**2] * 3 + [np.deg2rad(c.sigma_deg) ** 2] * 3)

    def predict(self, before: ScanResult, result: ScanResult) -> None:
        """Odometry's motion from one scan to the next."""
        step = se3.relative(before.T_world_lidar, result.T_world_lidar)
        T = se3.normalise(self.T @ step)
        way = float(np.linalg.norm(step[:3, 3]))
        grown = noise.rotate(growth(before, result, way, self.config.graph), T[:3, :3] @ result.T_world_lidar[:3, :3].T)
        self.P = noise.transport(self.P, T[:3, 3] - self.T[:3, 3]) + grown + drift_covariance(way, self.config.graph)
        self.T = T
        self.way += way

    @property
    def covariance(self) -> Floats:
        """(6, 6) of the pose, with the drift that does not average out: in proportion to the way, its turn to the way squared."""
        c = self.config.loops
        turn = np.deg2rad(c.drift_deg) / 100 * self.way
        move = 0.01 * c.drift_percent * self.way + 0.5 * turn * self.way
        return self.P + np.diag(np.repeat([move**2, turn**2], 3))

    def correct(self, position: int, points: PreparedPoints | None) -> MapFix:
        """The scan of that position of the run on the map; its points deskewed, None when there are none."""
        if points is None or len(points.source) < MIN_SOURCE_POINTS:
            return self._carried("unread", "no usable points")
        alignment = self.view.at(self.T[:3, 3])
        result = self._align(alignment, points, self.T)
        status, reason = self._judge(result)
        if reason and self.search is not None and self._spread() > COARSE_KERNEL_M:
            T = self.search(position, self.T, self._spread())
            if T is not None:
                result = self._align(self.view.at(T[:3, 3]), points, T)
                status, reason = self._judge(result)
        move, turn = correction(self.T, result.T_world_lidar)
        if reason:
            if status == "changed":
                self.usual.relax()
            return self._carried(status, reason, result)
        assert result.covariance is not None
        self.usual.observe(result.inlier_share)
        self.T, self.P, self.way = result.T_world_lidar, result.covariance + self._floor, 0.0
        return MapFix(self.T, self.P, "held", result.overlap, result.inlier_share, (move, turn))

    def _align(self, alignment: MapAlignment, points: PreparedPoints, start: Floats) -> RegistrationResult:
        """Registration from the prior with its information, the kernel as wide as the prior is uncertain.

        A prior wider than the widest kernel says next to nothing, and is the initial guess only.
        """
        c = self.config.registration
        width = max(self._spread(), NEAR_KERNEL_FACTOR * KERNEL_MIN_M)
        if start is self.T and width <= c.kernel_max:
            information = np.asarray(np.linalg.inv(self.covariance), np.float64)
            return optimise(*alignment.problem(points, start, width, c.max_iterations, information=information))
        if start is self.T:
            start = alignment.coarse_to_fine(points, start, width).T_world_lidar
        return optimise(*alignment.problem(points, start, c.kernel_max, c.max_iterations))

    def _judge(self, result: RegistrationResult) -> tuple[FixStatus, str]:
        """What the map says of a scan, and why not more."""
        limits = Acceptance(
            MAP_MIN_OVERLAP, MAP_MIN_INLIERS, needs_covariance=True, usual=self.usual, is_usual_of_matches=True
        )
        rejection = limits.rejection(result)
        if rejection is not None:
            return "beyond" if rejection.test in ("solution", "overlap") else "changed", rejection.reason
        d = se3_difference(self.T, result.T_world_lidar)
        # A scan that fits as well as those before has found its place, and odometry is worse than its covariance.
        is_outlier = float(d @ np.linalg.solve(self.covariance + self._floor, d)) > self._gate
        if is_outlier and self.usual.is_less(result.inlier_share):
            move, turn = correction(self.T, result.T_world_lidar)
            return "changed", f"the map would move it by {move:.2f} m and {np.rad2deg(turn):.1f} deg"
        return "held", ""

    def _spread(self) -> float:
        """m, `SIGMAS` standard deviations of a point at `LEVER_M`, where they are largest."""
        P = self.covariance
        position, turn = (float(np.linalg.eigvalsh(part)[-1]) for part in (P[:3, :3], P[3:, 3:]))
        return SIGMAS * float(np.sqrt(position + LEVER_M**2 * turn))

    def _carried(self, status: FixStatus, reason: str, result: RegistrationResult | None = None) -> MapFix:
        overlap, share = (0.0, 0.0) if result is None else (result.overlap, result.inlier_share)
        return MapFix(self.T, self.covariance, status, overlap, share, reason=reason)


def doubted(fixes: list[MapFix]) -> list[MapFix]:
    """The fixes of a run, marked where fewer points agree with the map than two scans of one place differ by."""
    usual = float(np.median([fix.inlier_share for fix in fixes if fix.is_binding] or [0.0]))
    return [replace(f, is_doubtful=f.is_binding and f.inlier_share < UsualAgreement.LESS * usual) for f in fixes]


def se3_difference(T: Floats, other: Floats) -> Floats:
    """(6,) d with t' = t + d[:3] and R' = exp(d[3:]) R from one pose (4, 4) to the other."""
    return np.concatenate([other[:3, 3] - T[:3, 3], so3.log(other[:3, :3] @ T[:3, :3].T)])
