"""Recovery policies of features: where these are few, degenerate, or contradicted by all points of the scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.config.odometry import RecoveryConfig
from lslam.odometry.feature_solver import remap_solution
from lslam.odometry.feature_target import MIN_FEATURES
from lslam.registration.attempt import RECOVER_M, Attempt, Policy
from lslam.registration.policies import policies_of
from lslam.registration.result import RegistrationResult

# Planar points of one normal that constrain a direction well enough, as many as LOAM asks for a plane.
ENOUGH_POINTS = 5


class LessPlanar:
    """Less planar points in place of features that are too few or leave a direction unobserved.

    Only a map constrains more than a scan's features: there less planar points may observe a degenerate direction.
    """

    name = "less planar points"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Acts on results that fail, have few inliers, or are degenerate on a map."""
        target, are_few = attempt.target, result.inliers < MIN_FEATURES
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
    """The motion prior along degenerate directions."""

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Acts on degenerate results."""
        if not (result.ok and len(result.degenerate)):
            return result
        # The first step's prior is a guess, which the search has replaced.
        start = attempt.start if attempt.history.inserted <= 1 else None
        expected = attempt.T_prior if start is None else start.T_world_lidar
        return attempt.judge(remap_solution(result, expected))


class AllPointsInstead:
    """`icp` on all points of the scan, where they contradict the features or constrain a poorly constrained pose."""

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Acts at the start, on results far from their prior, and on poorly constrained ones."""
        points, c = attempt.target.all_points, attempt.config
        if points is None:
            return result
        start = attempt.start if attempt.is_young else None
        is_far = not result.ok or result.prior_error[0] > RECOVER_M
        if c.start_reach > 0 and (attempt.is_young or is_far):
            with attempt.clock.stage("start" if attempt.history.starting else "recover"):
                result = points.confirm(attempt, attempt.T_prior if start is None else start.T_world_lidar, result)
        if attempt.target.map is not None and not is_well_constrained(result, c.sigma):
            with attempt.clock.stage("all-points"):
                result = points.instead(attempt, result, start)
        return result


def is_well_constrained(result: RegistrationResult, sigma: float) -> bool:
    """Whether the position's largest variance is below that of `ENOUGH_POINTS` points of one normal, of `sigma`, m."""
    if not result.ok or result.covariance is None:
        return False
    return float(np.linalg.eigvalsh(result.covariance[:3, :3])[-1]) < sigma**2 / ENOUGH_POINTS


def feature_policies(config: RecoveryConfig) -> tuple[Policy, ...]:
    """Those that a configuration switches on, in the order in which they are tried."""
    own = [LessPlanar()] if config.less_planar else []
    last = [AllPointsInstead()] if config.fallback == "all-points" else []
    return policies_of(config, of_features=(*own, SolutionRemapping(), *last))
