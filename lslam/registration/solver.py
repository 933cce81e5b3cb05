"""Points on Gaussian voxels: the terms of their residual, and one alignment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.types.arrays import Floats
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.kernels import prior_residual
from lslam.registration.optimiser import EVERYWHERE, Correspondences, Limits, Term, optimise
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import PLANE, ResidualKind
from lslam.registration.result import RegistrationResult
from lslam.registration.robust import Annealing


def solve(
    levels: Sequence[GaussianMap],
    points: PreparedPoints,
    T_prior: Floats,
    annealing: Annealing,
    c: RegistrationConfig,
    *,
    residual: ResidualKind = PLANE,
    allowed: Floats = EVERYWHERE,
) -> RegistrationResult:
    """Align the source points with maps by annealed Gauss-Newton, starting at `T_prior` (4, 4), as `c` weighs them.

    Points without a plane or a blob in one of the maps, the finest first, are matched in the next. `allowed` as in `Limits`.
    """
    matches = Correspondences(len(points.source))
    terms = voxel_terms(residual, residual.points(points, c.sigma), levels, matches, c.sigma, c.blob_weight)
    limits = Limits(c.weak_share, by_surfaces=residual.by_surfaces, allowed=allowed)
    return optimise(terms, T_prior, annealing, limits, matches)


def prior_term(T_prior: Floats, information: Floats) -> Term:
    """The pose (4, 4) as a measurement, of information (6, 6), world axes, 1/m2 and 1/rad2."""
    R, t = (np.ascontiguousarray(part, np.float64) for part in (T_prior[:3, :3], T_prior[:3, 3]))
    return Term(prior_residual.linearise, (), (R, t, information), ())


def voxel_terms(
    kind: ResidualKind,
    points: tuple[Any, ...],
    levels: Sequence[GaussianMap],
    matches: Correspondences,
    sigma: float,
    blob_weight: float,
) -> list[Term]:
    """The residual of the points on each of the maps, the finest first, which share their matches.

    points : arrays that the residual takes of them; sigma : m, noise of a point; blob_weight : of voxels that are no plane

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
                float(blob_weight) if k < 2 else 0.0,
                kind.along,
                0 < k == last,
            ),
            matches.search(level),
        )
        for k, level in enumerate(levels)
    ]


def part_of_usual(size: float, usual: float) -> float:
    """Weight of planes in voxels that are larger than usual, m: what bends within them makes their points err together."""
    return min(usual / size, 1.0)
