"""One scan against one map: pose, covariance and the facts of convergence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import MotionState
from lslam.core.types.motion_prior import MotionPrior
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.kernels import prior_residual
from lslam.registration.optimiser import (
    EVERYWHERE,
    LEAST_MATCHED,
    Correspondences,
    Limits,
    OptimiserResult,
    Term,
    optimise,
)
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import PLANE, ResidualKind
from lslam.registration.robust import Annealing

# Planar points of one normal that constrain a direction well enough, as many as LOAM asks for a plane.
ENOUGH = 5


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
    replaced : the result of the method's features, in whose place this one stands
    points : what was registered, deskewed; detail : whatever else the method's own `update` needs
    sweep : the motion within the sweep, of a method that estimates it itself; None: the prior's, which the pose refines
    map_age : as `ScanResult.map_age`
    inertial : the state of the IMU that a smoother of its own found, for the motion model
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
    replaced: RegistrationResult | None = None
    points: Any = None
    detail: Any = None
    sweep: MotionPrior | None = None
    map_age: float = 1.0
    inertial: MotionState | None = None
    stages: dict[str, float] = field(default_factory=dict)

    @property
    def is_accepted(self) -> bool:
        """Whether the pose is a registration's that nothing contradicts."""
        return self.ok and not self.is_rejected

    def moved(self, T_world_lidar: Floats, covariance: Floats | None) -> RegistrationResult:
        """The same registration at another pose."""
        return replace(self, T_world_lidar=T_world_lidar, covariance=covariance)

    def rejected(self, reason: str, T_world_lidar: Floats, covariance: Floats | None) -> RegistrationResult:
        """The scan at another pose, since something contradicts the registration."""
        moved = self.moved(T_world_lidar, covariance)
        return replace(moved, is_rejected=True, reason=reason, converged=False)

    @property
    def overlap(self) -> float:
        """Share of the source points that found a voxel."""
        return self.matched / max(self.source_points, 1)

    @property
    def inlier_share(self) -> float:
        """Share of the matched points within the final kernel."""
        return self.inliers / max(self.matched, 1)

    def is_well_constrained(self, sigma: float) -> bool:
        """Whether the position's largest variance is below that of `ENOUGH` points of one normal, of `sigma`, m."""
        if not self.ok or self.covariance is None:
            return False
        return float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]) < sigma**2 / ENOUGH

    @property
    def agreement(self) -> float:
        """Share of the source points within the final kernel."""
        return self.inliers / max(self.source_points, 1)


def solve(
    levels: Sequence[GaussianMap], points: PreparedPoints, T_prior: Floats, annealing: Annealing, c: RegistrationConfig, *,
    residual: ResidualKind = PLANE, allowed: Floats = EVERYWHERE,
) -> RegistrationResult:  # fmt: skip
    """Align the source points with maps by annealed Gauss-Newton, starting at `T_prior` (4, 4), as `c` weighs them.

    Points without a plane or a blob in one of the maps, the finest first, are matched in the next. `allowed` as in `Limits`.
    """
    matches = Correspondences(len(points.source))
    terms = voxel_terms(residual, residual.points(points, c.sigma), levels, matches, c.sigma, c.blob_weight)
    limits = Limits(c.weak_share, by_surfaces=residual.by_surfaces, allowed=allowed)
    return result_of(optimise(terms, T_prior, annealing, limits, matches), T_prior, len(points.source))


def prior_term(T_prior: Floats, information: Floats) -> Term:
    """The pose (4, 4) as a measurement, of information (6, 6), world axes, 1/m2 and 1/rad2."""
    R, t = (np.ascontiguousarray(part, np.float64) for part in (T_prior[:3, :3], T_prior[:3, 3]))
    return Term(prior_residual.linearise, (), (R, t, information), ())


def voxel_terms(
    kind: ResidualKind, points: tuple[Any, ...], levels: Sequence[GaussianMap], matches: Correspondences, sigma: float,
    blob_weight: float,
) -> list[Term]:  # fmt: skip
    """The residual of the points on each of the maps, the finest first, which share their matches.

    points : arrays that the residual takes of them; sigma : m, noise of a point; blob_weight : of voxels that are no plane

    The mean of a voxel beyond the second size constrains nothing.
    """
    last, linearise, usual = len(levels) - 1, kind.linearise, levels[:2][-1].size
    return [
        Term(
            linearise, points, kind.voxels(level),
            (level.size, float(sigma) ** 2, part_of_usual(level.size, usual), float(blob_weight) if k < 2 else 0.0, kind.along,
             0 < k == last),
            matches.search(level),
        )
        for k, level in enumerate(levels)
    ]  # fmt: skip


def part_of_usual(size: float, usual: float) -> float:
    """Weight of planes in voxels that are larger than usual, m: what bends within them makes their points err together."""
    return min(usual / size, 1.0)


def result_of(optimum: OptimiserResult, T_prior: Floats, source_points: int) -> RegistrationResult:
    """The optimiser's result as a registration's, or the prior (4, 4) where it is not finite."""
    finite = bool(np.isfinite(optimum.pose).all() and np.isfinite(optimum.step).all())
    is_known = finite and optimum.matched >= LEAST_MATCHED
    return RegistrationResult(
        T_world_lidar=optimum.pose if finite else T_prior,
        ok=finite,
        reason="" if finite else "the solution is not finite",
        covariance=_covariance(optimum) if is_known else None,
        converged=optimum.converged,
        iterations=optimum.iterations,
        source_points=source_points,
        matched=optimum.matched,
        inliers=optimum.inliers,
        rmse=optimum.rmse,
        degenerate=optimum.weak,
        lever_arm=optimum.lever_arm,
    )


def _covariance(optimum: OptimiserResult) -> Floats:
    """Inverse of the information, with a sigma of one metre along degenerate directions."""
    lever = optimum.lever_arm
    scale = np.array([1.0, 1.0, 1.0, 1 / lever, 1 / lever, 1 / lever])
    A = optimum.H * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(A)
    values = np.maximum(values, 1e-9 * max(optimum.information, 1e-9))
    if len(optimum.weak):
        along = ((optimum.weak @ vectors) ** 2).sum(0) > 0.5
        values = np.where(along, np.minimum(values, 1.0), values)
    C = (vectors / values) @ vectors.T
    return np.asarray(C * np.outer(scale, scale))
