"""The result of a registration: pose, covariance and the facts of convergence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.kernels import linearisation as at
from lslam.core.types.imu import MotionState
from lslam.core.types.motion_prior import MotionPrior


@dataclass(frozen=True)
class RegistrationResult:
    """The result of registering one scan.

    T_world_lidar : (4, 4); covariance : (6, 6) of t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2
    ok : False when the pose is the motion prior because registration failed, `reason` says why and is empty otherwise
    is_rejected : the pose is not the registration's, since the IMU or the laws of motion contradict that: the scan enters
        the map there, and adaptive thresholds do not learn from it
    pose_source : the recovery policy or the fallback that found the pose; empty: the registration itself
    is_stationary : the sensor is at rest, as its last poses say
    inliers : source points within the final kernel
    matched : points that found a voxel; overlap : matched / source
    rmse : weighted distance to the planes, m; degenerate : (K, 6) unobserved unit directions (rotation scaled by lever arm)
    prior_error : correction of the motion prior, (m, rad)
    feature_result : the result of the method's features, if this one, of all points, replaces it
    points : what was registered, deskewed; detail : whatever else the method's own `update` needs
    sweep : the motion within the sweep, of a method that estimates it itself; None: the prior's, which the pose refines
    map_age : as `ScanResult.map_age`
    inertial : the state of the IMU by a tightly coupled method's own estimator, for the motion model
    stages : seconds per stage
    """

    T_world_lidar: Floats
    ok: bool = True
    reason: str = ""
    covariance: Floats | None = None
    converged: bool = True
    iterations: int = 0
    source_points: int = 0
    matched: int = 0
    inliers: int = 0
    rmse: float = 0.0
    degenerate: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    prior_error: tuple[float, float] = (0.0, 0.0)
    lever_arm: float = 1.0
    is_rejected: bool = False
    is_stationary: bool = False
    pose_source: str = ""
    feature_result: RegistrationResult | None = None
    points: Any = None
    detail: Any = None
    sweep: MotionPrior | None = None
    map_age: float = 1.0
    inertial: MotionState | None = None
    stages: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        pose: Floats,
        H: Floats,
        facts: Floats,
        T_start: Floats,
        *,
        step: Floats,
        weak: Floats,
        source_points: int,
        iterations: int,
        converged: bool,
    ) -> RegistrationResult:
        """The result of an iteration from `T_start` (4, 4) to `pose` (4, 4); a failed one at the start if `pose` is not finite.

        H, facts : (6, 6), and sums of the points (`core.kernels.linearisation`), of the last linearisation; step : (6,) its step
        weak : (K, 6) unobserved directions
        """
        f = facts.tolist()
        is_finite = bool(np.isfinite(pose).all() and np.isfinite(step).all())
        # Root mean square, m, by information.
        lever = math.sqrt(max(f[at.LEVER] / max(f[at.INFORMATION], 1e-300), 1e-6))
        has_covariance = is_finite and int(f[at.MATCHED]) >= len(step)
        return cls(
            pose if is_finite else T_start,
            ok=is_finite,
            reason="" if is_finite else "the solution is not finite",
            covariance=_covariance(H, weak, f[at.INFORMATION], lever) if has_covariance else None,
            converged=converged,
            iterations=iterations,
            source_points=source_points,
            matched=int(f[at.MATCHED]),
            inliers=int(f[at.INLIERS]),
            rmse=math.sqrt(f[at.SQUARED] / max(f[at.ROBUST], 1e-12)),
            degenerate=weak,
            lever_arm=lever,
        )

    @property
    def is_accepted(self) -> bool:
        """Whether the pose is a registration's that nothing contradicts."""
        return self.ok and not self.is_rejected

    def with_pose(self, T_world_lidar: Floats, covariance: Floats | None) -> RegistrationResult:
        """The result with another pose (4, 4) and covariance."""
        return replace(self, T_world_lidar=T_world_lidar, covariance=covariance)

    def reject(self, reason: str, T_world_lidar: Floats, covariance: Floats | None) -> RegistrationResult:
        """The result with another pose and covariance, rejected for the `reason`: something contradicts the registration."""
        moved = self.with_pose(T_world_lidar, covariance)
        return replace(moved, is_rejected=True, reason=reason, converged=False)

    @property
    def overlap(self) -> float:
        """Share of the source points that found a voxel."""
        return self.matched / max(self.source_points, 1)

    @property
    def inlier_share(self) -> float:
        """Share of the matched points within the final kernel."""
        return self.inliers / max(self.matched, 1)

    @property
    def agreement(self) -> float:
        """Share of the source points within the final kernel."""
        return self.inliers / max(self.source_points, 1)


def _covariance(H: Floats, weak: Floats, information: float, lever: float) -> Floats:
    """Covariance (6, 6) by the inverse of H, with a sigma of at most one metre along degenerate directions, `weak` (D, 6).

    lever : m, scales rotations to lengths; information : of all points, a floor of the eigenvalues is 1e-9 of it
    """
    scale = np.array([1.0, 1.0, 1.0, 1 / lever, 1 / lever, 1 / lever])
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    values = np.maximum(values, 1e-9 * max(information, 1e-9))
    if len(weak):
        along = ((weak @ vectors) ** 2).sum(0) > 0.5
        values = np.where(along, np.minimum(values, 1.0), values)
    C = (vectors / values) @ vectors.T
    return np.asarray(C * np.outer(scale, scale))
