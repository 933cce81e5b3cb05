"""Scan results from registrations, which have acceptance tests, and from external aligners, which get one here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.registration import RegistrationConfig
from lslam.geometry import se3, so3
from lslam.registration.registration import MIN_SOURCE_POINTS
from lslam.registration.solver import RegistrationResult
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


def of_registration(scan: Scan, found: RegistrationResult, map_age: float, stages: dict[str, float]) -> ScanResult:
    """The result of a scan from its registration.

    map_age : as `PoseUncertainty`; stages : seconds of each
    """
    return ScanResult(
        index=scan.index,
        stamp_ns=scan.stamp_ns,
        T_world_lidar=found.T_world_lidar,
        status="ok" if found.ok else "bridged",
        reason=found.reason,
        posed_by=found.posed_by,
        registration_covariance=found.covariance,
        map_age=map_age,
        converged=found.converged,
        iterations=found.iterations,
        source_points=found.source_points,
        inliers=found.inliers,
        rmse=found.rmse,
        overlap=found.overlap,
        degenerate=found.degenerate,
        prior_error=found.prior_error,
        stages=stages,
    )


@dataclass(frozen=True)
class AlignerResult:
    """The result of an external aligner.

    T_world_lidar : (4, 4); source_points : points that were offered; inliers : those with a partner within reach
    rmse : distance of the inliers to their partners, m
    """

    T_world_lidar: NDArray[np.float64]
    source_points: int
    inliers: int
    converged: bool = True
    iterations: int = 0
    rmse: float = 0.0


def judged(
    scan: Scan, found: AlignerResult, T_prior: NDArray[np.float64], limits: RegistrationConfig, stages: dict[str, float]
) -> ScanResult:
    """The result of a scan: `ok`, or `bridged` by the motion prior when the alignment is rejected."""
    share = found.inliers / max(found.source_points, 1)
    move = turn = 0.0
    reason = ""
    if found.source_points < MIN_SOURCE_POINTS:
        reason = f"{found.source_points} usable points, {MIN_SOURCE_POINTS} needed"
    elif not np.isfinite(found.T_world_lidar).all():
        reason = "the solution is not finite"
    elif share < limits.start_overlap:
        reason = f"only {share:.0%} of the points have a partner"
    else:
        delta = se3.relative(T_prior, found.T_world_lidar)
        move, turn = float(np.linalg.norm(delta[:3, 3])), float(so3.angle(delta[:3, :3]))
        if move > limits.max_jump_m or turn > np.deg2rad(limits.max_jump_deg):
            reason = f"impossible jump of {move:.1f} m and {np.rad2deg(turn):.0f} deg"
    return ScanResult(
        index=scan.index,
        stamp_ns=scan.stamp_ns,
        T_world_lidar=T_prior.copy() if reason else se3.normalise(found.T_world_lidar),
        status="bridged" if reason else "ok",
        reason=reason,
        converged=found.converged and not reason,
        iterations=found.iterations,
        source_points=found.source_points,
        inliers=0 if reason else found.inliers,
        rmse=0.0 if reason else found.rmse,
        overlap=0.0 if reason else share,
        prior_error=(0.0, 0.0) if reason else (move, turn),
        stages=stages,
    )
