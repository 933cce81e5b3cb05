"""Recovery policies of features: where these are few, degenerate, or contradicted by `icp` on all points of the scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.odometry import RecoveryConfig
from lslam.core.types.state import Stateful
from lslam.odometry.feature_map import MIN_LINE_POINTS
from lslam.odometry.feature_solver import remap_solution
from lslam.registration.attempt import RECOVER_M, Attempt, Policy
from lslam.registration.history import History
from lslam.registration.policies import AtRest, CoarseToFine, best_by_non_ground
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

# In `pose_source`.
ALL_POINTS = "all-points"
# Well constrained scans in a row, two seconds at 10 Hz, after which the map of all points is dropped.
CONSTRAINED_SCANS = 20


class AllPoints(Stateful):
    """Map of all points, in voxels of `voxel_size`, m, with its `icp`; only kept while features are poorly constrained."""

    STATE = ("_icp", "_fed")

    def __init__(self, config: Config, voxel_size: float) -> None:
        plain = {
            "residual": None,
            "target": "map",
            "inlier_distance": None,
            "inlier_ratio": 1.0,
            "voxel_size": voxel_size,
        }
        self._config, self._preprocess = config.registration.model_copy(update=plain), config.preprocess
        # `icp` by default settings, updated from the first poorly constrained scan on.
        self._icp = Registration(self._config, self._preprocess)
        self._fed = CONSTRAINED_SCANS

    def locate(self, attempt: Attempt) -> RegistrationResult:
        """The scan's points registered by `icp` on those of the scans that were registered last."""
        icp = self._of_recent(attempt.history)
        return icp.locate(prepare_points(attempt.points.cloud, icp.preprocess), attempt.T_prior)

    def confirm(self, attempt: Attempt, T_start: Floats, result: RegistrationResult) -> RegistrationResult:
        """The result by features, or that of `icp` from `T_start` where many more non-ground points are inliers by that.

        Few rings constrain features badly along a road.
        """
        icp = self._of_recent(attempt.history)
        points = prepare_points(attempt.points.cloud, icp.preprocess)
        better = best_by_non_ground(icp.attempt(points, T_start), result)
        return result if better is result else attempt.credit(better, ALL_POINTS)

    def instead(
        self, attempt: Attempt, by_features: RegistrationResult, own: RegistrationResult | None
    ) -> RegistrationResult:
        """The pose by `icp` on a map of all points, unless it fails; directions degenerate by features stay flagged.

        Few rings at speed give so few features that one outlier displaces the pose by metres.
        own : the result of `icp` on that map, if it was computed already
        """
        if self._fed >= CONSTRAINED_SCANS:
            self._icp = self._of_recent(attempt.history)
        self._fed = 0
        if own is None:
            points = prepare_points(attempt.points.cloud, self._icp.preprocess)
            own = self._icp.locate(points, attempt.T_prior)
        if not own.ok:
            return by_features
        degenerate = own.degenerate if len(own.degenerate) else by_features.degenerate
        return replace(
            own, degenerate=degenerate, pose_source=ALL_POINTS, feature_result=by_features, points=None, detail=own
        )

    def enter(self, result: RegistrationResult) -> None:
        """Insert a registered scan into the map of all points while that is used (`CONSTRAINED_SCANS` scans after each use)."""
        if self._fed >= CONSTRAINED_SCANS:
            return
        self._fed += 1
        own = result.detail if result.feature_result is not None else None
        if own is None:
            points = prepare_points(result.points.cloud, self._icp.preprocess)
            own, is_rejected = RegistrationResult(result.T_world_lidar, points=points), True
        else:
            is_rejected = result.is_rejected
        self._icp.update(replace(own, T_world_lidar=result.T_world_lidar, is_rejected=is_rejected))

    def _of_recent(self, history: History) -> Registration:
        """A registration `icp` whose map has all points of the scans that were registered last."""
        icp = Registration(self._config, self._preprocess)
        for points, T_world_lidar in history.recent:
            icp.update(RegistrationResult(T_world_lidar, points=prepare_points(points, icp.preprocess)))
        return icp


class LessPlanar:
    """Less planar points in place of features that are too few or leave a direction unobserved.

    Only a map constrains more than a scan's features: there less planar points may observe a degenerate direction.
    """

    name = "less planar points"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Register less planar points if the result fails, has few inliers, or is degenerate on a map; else return `result`."""
        target, are_few = attempt.target, result.inliers < MIN_SOURCE_POINTS
        is_degenerate = len(result.degenerate) > 0 and target.map is not None
        if result.ok and not are_few and not is_degenerate:
            return result
        with attempt.clock.stage("stand-in"):
            # With all points on a young map these are registered already, and preferred.
            if target.all_points is not None and attempt.is_young and attempt.start is not None:
                other = attempt.start
            else:
                start = attempt.T_prior if attempt.start is None else attempt.start.T_world_lidar
                other = target.on_planes(attempt, result.T_world_lidar if result.ok else start)
        # The other must observe a degenerate direction; with too few features it may not add one.
        if not other.ok or (result.ok and len(other.degenerate) > len(result.degenerate) - (not are_few)):
            return result
        return replace(other, pose_source=self.name)


class SolutionRemapping:
    """Replaces the pose along degenerate directions by the motion prior (solution remapping, Zhang 2016)."""

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """The result with its degenerate directions remapped, checked again; other results as they are."""
        if not (result.ok and len(result.degenerate)):
            return result
        # The first step's prior is a guess, which the search has replaced.
        start = attempt.start if attempt.history.inserted <= 1 else None
        expected = attempt.T_prior if start is None else start.T_world_lidar
        return attempt.judge(remap_solution(result, expected))


class AllPointsInstead:
    """`icp` on all points of the scan, where they contradict the features or constrain a poorly constrained pose."""

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Replace the result by `icp` on all points where these contradict the features, or where the features constrain little.

        The first is tested at the start and far from the prior.
        """
        points, c = attempt.target.all_points, attempt.config
        if points is None:
            return result
        start = attempt.start if attempt.is_young else None
        is_far = not result.ok or result.prior_error[0] > RECOVER_M
        if c.start_reach > 0 and (attempt.is_young or is_far):
            with attempt.clock.stage("start" if attempt.history.starting else "recover"):
                result = points.confirm(attempt, attempt.T_prior if start is None else start.T_world_lidar, result)
        if attempt.target.map is not None and not holds_position(result, c.sigma):
            with attempt.clock.stage("all-points"):
                result = points.instead(attempt, result, start)
        return result


def holds_position(result: RegistrationResult, sigma: float) -> bool:
    """Whether the position's largest variance is below that of `MIN_LINE_POINTS` points of one normal, of `sigma`, m."""
    if not result.ok or result.covariance is None:
        return False
    return float(np.linalg.eigvalsh(result.covariance[:3, :3])[-1]) < sigma**2 / MIN_LINE_POINTS


def feature_policies(config: RecoveryConfig) -> tuple[Policy, ...]:
    """Policies of features that are switched on, in the order in which they are tried."""
    switches: tuple[tuple[bool, Policy], ...] = (
        (config.coarse_to_fine, CoarseToFine(of_features=True)),
        (config.less_planar, LessPlanar()),
        (True, SolutionRemapping()),
        (config.fallback == "all-points", AllPointsInstead()),
        (config.at_rest, AtRest()),
    )
    return tuple(policy for is_on, policy in switches if is_on)
