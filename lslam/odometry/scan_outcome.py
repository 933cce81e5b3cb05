"""The record of a scan, from its registration or from that of a package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.registration.acceptance import Acceptance, failed
from lslam.registration.solver import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS


def recorded(scan: Scan, found: RegistrationResult, covariance: Floats | None, own: Floats | None) -> ScanResult:
    """The result of a scan from its registration.

    covariance : (6, 6) of the pose in the world; own : likewise, relative to the local map
    """
    return ScanResult(
        index=scan.index, stamp_ns=scan.stamp_ns, T_world_lidar=found.T_world_lidar,
        status="ok" if found.is_accepted else "bridged", reason=found.reason, covariance=covariance,
        registration_covariance=own, map_age=found.map_age, converged=found.converged, iterations=found.iterations,
        source_points=found.source_points, inliers=found.inliers, rmse=found.rmse, overlap=found.overlap,
        is_stationary=found.is_stationary, posed_by=found.pose_source,
        degenerate=found.degenerate, prior_error=found.prior_error, stages=found.stages,
    )  # fmt: skip


def judged(
    scan: Scan, found: RegistrationResult, T_prior: Floats, c: RegistrationConfig, stages: dict[str, float]
) -> ScanResult:
    """The result of a scan that a package aligned: `ok`, or `bridged` by the motion prior when it is rejected.

    found : pose, points that were offered, and inliers, those with a partner within reach
    """
    limits = Acceptance(min_overlap=c.min_overlap, max_jump_m=c.max_jump_m, max_jump_deg=c.max_jump_deg)
    count = found.source_points
    if count < MIN_SOURCE_POINTS:
        result = failed(T_prior, count, f"{count} usable points, {MIN_SOURCE_POINTS} needed")
    elif not np.isfinite(found.T_world_lidar).all():
        result = failed(T_prior, count, "the solution is not finite")
    else:
        pose = se3.normalise(found.T_world_lidar)
        result = limits.accepted(replace(found, T_world_lidar=pose, matched=found.inliers), T_prior)
    return recorded(scan, replace(result, stages=stages), None, None)
