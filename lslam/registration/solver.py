"""One scan against one map: pose, covariance and the facts of convergence."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.registration import Residual
from lslam.geometry import se3
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.residuals import NEEDS_COVARIANCE, kernel_of, voxels_of
from lslam.registration.robust import Annealing
from lslam.registration.source_covariance import source_covariance
from lslam.types.scan_result import ScanResult

# A step below these ends the iteration: a tenth of the noise of a point, and what that is at 10 m.
STEP_M, STEP_RAD = 1e-3, 1e-4
# Planar points that face one way hold the place along it well enough, as many as LOAM asks for a plane.
ENOUGH = 5


@dataclass(frozen=True)
class RegistrationResult:
    """What came of registering one scan.

    T_world_lidar : (4, 4); covariance : (6, 6) of t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2
    ok : False when the pose is the motion prior because registration failed, `reason` says why
    is_denied : the pose is not what registration found: the scan enters there, and what was found teaches nothing
    inliers : source points within the final kernel; fine_inliers : those of them in fine voxels
    matched : points that found a voxel; overlap : matched / source
    rmse : weighted distance to the planes, m; degenerate : (K, 6) unobserved unit directions (rotation scaled by lever arm)
    prior_error : correction of the motion prior, (m, rad)
    """

    T_world_lidar: NDArray[np.float64]
    ok: bool = True
    reason: str = ""
    covariance: NDArray[np.float64] | None = None
    converged: bool = True
    iterations: int = 0
    source_points: int = 0
    matched: int = 0
    inliers: int = 0
    fine_inliers: int = 0
    rmse: float = 0.0
    degenerate: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 6)))
    prior_error: tuple[float, float] = (0.0, 0.0)
    lever_arm: float = 1.0
    is_denied: bool = False

    def moved(self, T_world_lidar: NDArray[np.float64], covariance: NDArray[np.float64] | None) -> RegistrationResult:
        """The same registration, where more than the map was asked for the pose."""
        return replace(self, T_world_lidar=T_world_lidar, covariance=covariance)

    def decided(self, result: ScanResult) -> RegistrationResult:
        """The same registration, at the pose of `result`: whoever had a say in it after the registration."""
        moved = self.moved(result.T_world_lidar, result.registration_covariance)
        return replace(moved, is_denied=self.ok and result.status != "ok")

    @property
    def overlap(self) -> float:
        """Share of the source points that found a voxel."""
        return self.matched / max(self.source_points, 1)

    @property
    def inlier_share(self) -> float:
        """Share of the matched points within the final kernel."""
        return self.inliers / max(self.matched, 1)

    def holds_place(self, sigma: float) -> bool:
        """Whether all points together hold the sensor's place as well as `ENOUGH` that face one way, of `sigma`, m, do."""
        if not self.ok or self.covariance is None:
            return False
        return float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]) < sigma**2 / ENOUGH

    @property
    def agreement(self) -> float:
        """Share of the source points within the final kernel of the fine map, with or without a coarse one beside it."""
        return self.fine_inliers / max(self.source_points, 1)


def solve(
    target: GaussianMap, points: PreparedPoints, T_prior: NDArray[np.float64], annealing: Annealing, *, sigma: float,
    blob_weight: float, weak_share: float, coarse: GaussianMap | None = None, residual: Residual = "plane",
    inlier_distance: float = np.inf, inlier_ratio: float = 1.0,
) -> RegistrationResult:  # fmt: skip
    """Align the source points with the map by annealed Gauss-Newton, starting at `T_prior` (4, 4).

    Points without a plane in `target` are matched in `coarse`, when given. Correspondences beyond `inlier_distance`, m,
    are rejected, and all but the nearest `inlier_ratio`.
    """
    second = target if coarse is None else coarse
    R, t = np.ascontiguousarray(T_prior[:3, :3]).copy(), T_prior[:3, 3].copy()
    H, facts, step, iterations, converged, weak_count, weak = kernel_of(residual)(
        points.source, _known_of_source(residual, points, sigma), R, t,
        annealing.start, annealing.end, annealing.decay, annealing.steps,
        STEP_M, STEP_RAD, inlier_distance, inlier_ratio, sigma**2, blob_weight, weak_share,
        target.size, *voxels_of(residual, target), coarse is not None, second.size, *voxels_of(residual, second),
    )  # fmt: skip
    pose = se3.make(R, t)
    finite = bool(np.isfinite(pose).all() and np.isfinite(step).all())
    lever = float(np.sqrt(max(facts[4] / max(facts[0], 1e-300), 1e-6)))
    return RegistrationResult(
        T_world_lidar=pose if finite else T_prior,
        ok=finite,
        reason="" if finite else "the solution is not finite",
        covariance=_covariance(H, facts, weak[:weak_count], lever) if finite and facts[3] >= 6 else None,
        converged=converged,
        iterations=iterations,
        source_points=len(points.source),
        matched=int(facts[3]),
        inliers=int(facts[2]),
        fine_inliers=int(facts[6]),
        rmse=float(np.sqrt(facts[1] / max(facts[5], 1e-12))),
        degenerate=weak[:weak_count].copy(),
        lever_arm=lever,
    )


def _known_of_source(residual: Residual, points: PreparedPoints, sigma: float) -> NDArray[np.float64]:
    """What a residual takes of each source point beside its place: scatter, covariance or the gap between rings."""
    if residual == "point":
        return np.zeros(len(points.source)) if points.gaps is None else points.gaps
    if residual not in NEEDS_COVARIANCE:
        return points.scatter
    known = points.covariance
    return source_covariance(points.source, points.map_points, sigma**2) if known is None else known


def _covariance(
    H: NDArray[np.float64], facts: NDArray[np.float64], weak: NDArray[np.float64], lever: float
) -> NDArray[np.float64]:
    """Inverse of the information, with one metre of doubt along directions the scan does not observe."""
    scale = np.array([1.0, 1.0, 1.0, 1 / lever, 1 / lever, 1 / lever])
    A = H * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(A)
    values = np.maximum(values, 1e-9 * max(float(facts[0]), 1e-9))
    if len(weak):
        along = ((weak @ vectors) ** 2).sum(0) > 0.5
        values = np.where(along, np.minimum(values, 1.0), values)
    C = (vectors / values) @ vectors.T
    return np.asarray(C * np.outer(scale, scale))
