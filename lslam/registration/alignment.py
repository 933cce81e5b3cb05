"""Points on Gaussian voxels: the terms of their residual, and the ways a scan is laid on a map.

From nearly the right place, or from metres off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.kernels.gauss_newton import linearise_prior
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import LocalMap
from lslam.registration.optimiser import (
    COARSE_KERNEL_M,
    EVERYWHERE,
    KERNEL_MIN_M,
    START_ITERATIONS,
    Annealing,
    Correspondences,
    Limits,
    Problem,
    Term,
    optimise,
)
from lslam.registration.preprocessing.ground import Z
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import PLANE, ResidualKind
from lslam.registration.result import RegistrationResult


def solve(
    levels: Sequence[GaussianMap],
    points: PreparedPoints,
    T_prior: Floats,
    annealing: Annealing,
    c: RegistrationConfig,
    *,
    residual: ResidualKind = PLANE,
    directions: Floats = EVERYWHERE,
) -> RegistrationResult:
    """Align the source points with maps by annealed Gauss-Newton, starting at `T_prior` (4, 4); c : noise and limits.

    Points without a match in one of the maps, the finest first, are matched in the next. `directions` as in `Limits`.
    """
    matches = Correspondences(len(points.source))
    terms = voxel_terms(residual, residual.points(points, c.sigma), levels, matches, c.sigma)
    limits = Limits(c.weak_share, by_surfaces=residual.by_surfaces, directions=directions)
    return optimise(Problem(terms, T_prior, annealing, limits, matches))


def prior_term(T_prior: Floats, information: Floats) -> Term:
    """The pose (4, 4) as a measurement, of information (6, 6), world axes, 1/m2 and 1/rad2."""
    R, t = (np.ascontiguousarray(part, np.float64) for part in (T_prior[:3, :3], T_prior[:3, 3]))
    return Term(linearise_prior, (), (R, t, information), ())


def voxel_terms(
    kind: ResidualKind,
    points: tuple[Any, ...],
    levels: Sequence[GaussianMap],
    matches: Correspondences,
    sigma: float,
) -> list[Term]:
    """The residual of the points on each of the maps, the finest first, which share their matches.

    points : arrays that the residual takes of them; sigma : m, noise of a point

    The mean of a voxel beyond the second size constrains nothing.
    """
    last, linearise, usual = len(levels) - 1, kind.linearise, levels[:2][-1].size
    return [
        Term(
            linearise,
            points,
            kind.voxels(level),
            (
                level.size,
                float(sigma) ** 2,
                part_of_usual(level.size, usual),
                float(kind.non_planar_weight) if k < 2 else 0.0,
                kind.axial_weight,
                0 < k == last,
            ),
            matches.search(level),
        )
        for k, level in enumerate(levels)
    ]


def part_of_usual(size: float, usual: float) -> float:
    """Weight, at most 1, of planes in voxels of edge `size`, m, that are larger than `usual`, m.

    A surface bends within a large voxel, so that its points err together.
    """
    return min(usual / size, 1.0)


class MapAlignment:
    """Aligns scans with one map by one residual; acceptance of the result is elsewhere (`acceptance`)."""

    def __init__(self, target: LocalMap, config: RegistrationConfig, residual: ResidualKind = PLANE) -> None:
        self.map, self.config, self.kind = target, config, residual
        # Of the last refinement, and when in the life of the map it was.
        self._matches, self._changes = Correspondences(0), 0

    def problem(
        self,
        points: PreparedPoints,
        start: Floats,
        width: float,
        steps: int,
        coarser: Sequence[GaussianMap] = (),
        directions: Floats = EVERYWHERE,
        information: Floats | None = None,
    ) -> Problem:
        """The problem of aligning the points with the fine map from `start` (4, 4), the kernel narrowing from `width`, m.

        coarser : maps for the points without a match in the fine one, finest first; none: all coarser levels
        directions : (6, 6) projector on the directions that are aligned, world axes; no rows: all
        information : (6, 6) of the start as a prior, world axes, 1/m2 and 1/rad2; None: it is only a start
        """
        c, coarser = self.config, coarser or self.map.coarser
        coarser = coarser if self.kind.is_wide else coarser[:1]
        # The larger the planes, the farther their surface may be from them.
        end = coarser[0].size / self.map.coarser[0].size * KERNEL_MIN_M
        width, end = (max(width, end), end) if c.inlier_distance is None else (c.inlier_distance,) * 2
        matches = self._recall(len(points.source))
        arrays, levels = self.kind.points(points, c.sigma), (self.map.fine, *coarser)
        terms = voxel_terms(self.kind, arrays, levels, matches, c.sigma)
        if information is not None:
            terms.append(prior_term(start, information))
        limits = Limits(c.weak_share, by_surfaces=self.kind.by_surfaces, directions=directions)
        farthest = np.inf if c.inlier_distance is None else c.inlier_distance
        return Problem(terms, start, Annealing(width, steps, end), limits, matches, farthest, c.inlier_ratio)

    def _recall(self, count: int) -> Correspondences:
        """Correspondences of the last `count` points, for reuse while the map is unchanged; else empty ones.

        A scan is aligned twice, deskewed anew, and its points move little between.
        """
        if self._changes != self.map.changes or len(self._matches) != count:
            self._matches, self._changes = Correspondences(count), self.map.changes
        return self._matches

    def coarse_to_fine(self, points: PreparedPoints, T_prior: Floats, width: float = np.inf) -> RegistrationResult:
        """Align with coarse planes and from there with the fine map: from a start metres off instead of decimetres.

        Planes whatever the residual: other residuals pull points to the rings of earlier scans, and on flat ground these agree
        with any speed that the map was once made with. Points whose fine voxel has no plane yet keep their coarse one.
        width : m, of the kernel at the start, where the prior is known better than `COARSE_KERNEL_M`
        """
        c = self.config
        coarser = self.coarse_maps(points, T_prior)
        coarse = solve(coarser[:1], points, T_prior, Annealing.slow(min(width, COARSE_KERNEL_M)), c)
        start = coarse.T_world_lidar if coarse.ok else T_prior
        fine = optimise(self.problem(points, start, c.kernel_max, START_ITERATIONS, coarser))
        return replace(fine, iterations=coarse.iterations + fine.iterations)

    def coarse_maps(self, points: PreparedPoints, T_prior: Floats) -> tuple[GaussianMap, ...]:
        """The coarser levels of the map, finest first, beginning where enough points have a plane at `T_prior` (4, 4).

        From thirty metres above the ground the rings of one scan lie metres apart.
        """
        c, coarser = self.config, self.map.coarser
        for k, level in enumerate(coarser):
            if solve((level,), points, T_prior, Annealing.once(COARSE_KERNEL_M), c).overlap >= c.min_overlap:
                return coarser[k:]
        return coarser[-1:]


def upright_directions(T_prior: Floats, up: Floats = Z) -> Floats:
    """(6, 6) projector on height, roll and pitch at a pose (4, 4) of a sensor in whose frame `up` (3,) is up, world axes."""
    vertical = T_prior[:3, :3] @ up
    along = np.outer(vertical, vertical)
    projector = np.zeros((6, 6))
    projector[:3, :3], projector[3:, 3:] = along, np.eye(3) - along
    return projector
