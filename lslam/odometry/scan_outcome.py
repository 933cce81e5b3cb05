"""The record of a scan, from its registration or from that of a package, and what every method is held to.

Points that a LiDAR can measure go in, poses of a vehicle come out, whoever wrote the method.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.kernels import voxel
from lslam.core.types.scan import FARTHEST_M, Scan
from lslam.core.types.scan_result import FASTEST_M_S, FASTEST_RAD_S, ScanResult
from lslam.registration.acceptance import Acceptance, failure
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS


def to_scan_result(scan: Scan, result: RegistrationResult, covariance: Floats | None, own: Floats | None) -> ScanResult:
    """Result of a scan from its registration.

    covariance, own : (6, 6) of the pose in the world and relative to the local map
    """
    return ScanResult(
        index=scan.index,
        stamp_ns=scan.stamp_ns,
        T_world_lidar=result.T_world_lidar,
        status="ok" if result.is_accepted else "bridged",
        reason=result.reason,
        covariance=covariance,
        registration_covariance=own,
        map_age=result.map_age,
        converged=result.converged,
        iterations=result.iterations,
        source_points=result.source_points,
        inliers=result.inliers,
        rmse=result.rmse,
        overlap=result.overlap,
        is_stationary=result.is_stationary,
        posed_by=result.pose_source,
        degenerate=result.degenerate,
        prior_error=result.prior_error,
        stages=result.stages,
    )


def judge(scan: Scan, alignment: RegistrationResult, T_prior: Floats, c: RegistrationConfig) -> ScanResult:
    """The result of a scan that a package aligned: `ok`, or `bridged` by the motion prior when it is rejected.

    alignment : pose, points that were offered, and inliers, those with a partner within reach
    """
    limits = Acceptance(min_overlap=c.min_overlap, max_jump_m=c.max_jump_m, max_jump_deg=c.max_jump_deg)
    count = alignment.source_points
    if count < MIN_SOURCE_POINTS:
        result = failure(T_prior, count, f"{count} usable points, {MIN_SOURCE_POINTS} needed")
    elif not np.isfinite(alignment.T_world_lidar).all():
        result = failure(T_prior, count, "the solution is not finite")
    else:
        pose = se3.normalise(alignment.T_world_lidar)
        result = limits.judge(replace(alignment, T_world_lidar=pose, matched=alignment.inliers), T_prior)
    return to_scan_result(scan, result, None, None)


# s; over a shorter time a registration may err by as much as the fastest moves.
LEAST_S = 0.1
# Of R^T R: what float32 and rounding leave of a rotation is nearer.
RIGID_TOLERANCE = 1e-3


def measurable(scan: Scan) -> Scan:
    """The scan with the points that are finite and within `FARTHEST_M`; itself where all of them are."""
    if voxel.count_within(np.ascontiguousarray(scan.points, np.float32), FARTHEST_M) == len(scan):
        return scan
    # NaN is not smaller.
    return scan.select(np.asarray((np.abs(scan.points) < FARTHEST_M).all(axis=1)))


def fault(pose: Floats, stamp_ns: int, last: ScanResult | None) -> str:
    """The reason why a pose (4, 4) at `stamp_ns` is invalid or unreachable for a vehicle; empty where it is plausible.

    last : the newest accepted result; reachability counts the time since then, so that a method which jumped once is
        accepted again as soon as it may have got there
    """
    pose = np.asarray(pose)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return "the pose is not finite"
    if not so3.is_rotation(pose[:3, :3], RIGID_TOLERANCE) or not np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)):
        return "the pose is no rigid transform"
    if last is None:
        return ""
    move, turn = se3.magnitude(se3.relative(last.T_world_lidar, pose))
    seconds = (stamp_ns - last.stamp_ns) * 1e-9
    if move <= FASTEST_M_S * max(seconds, LEAST_S) and turn <= FASTEST_RAD_S * max(seconds, LEAST_S):
        return ""
    return f"impossible jump of {move:.4g} m and {np.rad2deg(turn):.0f} deg since scan {last.index}, {seconds:.3g} s before"


def plausible(result: ScanResult, T_prior: Floats, last: ScanResult | None) -> ScanResult:
    """The result, or one `bridged` by the motion prior (4, 4) where its pose has a `fault`."""
    reason = fault(result.T_world_lidar, result.stamp_ns, last) if result.status == "ok" else ""
    if not reason:
        return result
    return replace(
        result,
        T_world_lidar=T_prior.copy(),
        status="bridged",
        reason=reason,
        converged=False,
        inliers=0,
        rmse=0.0,
        overlap=0.0,
        covariance=None,
        registration_covariance=None,
    )
