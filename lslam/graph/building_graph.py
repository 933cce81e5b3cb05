"""Displacements of buildings estimated from walls along a fixed trajectory: the second of two levels.

Del Tufo, section 3.4: mapping never harms localisation. A building's displacement is x, y, yaw about its middle; every match
observes some directions of it, and a weak prior of the map has it displaced by the common shift of all buildings. So the
problem is linear, and an unobserved direction follows the shift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se2
from lslam.graph.chi_square import quantile
from lslam.graph.gnc import truncated_weights
from lslam.stopping import checking
from lslam.types.building import BuildingMatch

Floats = NDArray[np.float64]

GROWTH, ROUNDS = 2.0, 30  # of graduated non-convexity, as in `graph.gnc`
PROBABILITY = 0.999  # chi-square quantile of an inlier match
SUPPORT = 2  # other matches that must agree
# Shares of information below which a direction is unobserved, and from which another match observes it as well.
FREE, ALIKE = 1e-9, 0.05


@dataclass(frozen=True)
class MapPrior:
    """The prior of a map's errors.

    shift : (2,) m, real minus map, its common shift, and its shift_sigma (2,), m
    sigma : (3,) m, m, rad; of a building's displacement beside that
    """

    shift: Floats
    shift_sigma: Floats
    sigma: Floats


@dataclass(frozen=True)
class BuildingSolution:
    """Estimated displacements of buildings.

    displacements : (B, 3) x, y (m), yaw (rad) about each middle, real minus map; covariances : (B, 3, 3)
    shift : (2,) m, common to all; inliers : (M,) bool per match
    """

    displacements: Floats
    covariances: Floats
    shift: Floats
    inliers: NDArray[np.bool_]


def solve_buildings(
    middles: NDArray[np.float64],
    matches: Sequence[BuildingMatch],
    poses: Mapping[int, Floats],
    map_prior: MapPrior,
) -> BuildingSolution:
    """Displacements of the buildings with `middles` (B, 2), m, from `matches`, with each keyframe at `poses` (3,) of the map.

    Outlier matches are rejected by graduated non-convexity with truncated least squares (`graph.gnc`); the map's prior is no
    outlier candidate. Matches of one building share the map's error, so the covariances are those of one match of mean
    information, while the displacements use all of them.
    """
    owners = np.array([m.building for m in matches], np.intp)
    measured = np.array([m.displacement(poses[m.keyframe], middles[m.building]) for m in matches]).reshape(-1, 3)
    weights = np.array([_in_map(m.information, poses[m.keyframe][2]) for m in matches]).reshape(-1, 3, 3)
    limits = np.array([quantile(PROBABILITY, max(m.rank, 1)) for m in matches])
    trust = np.ones(len(matches))
    solution = _linear(len(middles), owners, measured, weights, map_prior)
    ratio = _squared(solution, owners, measured, weights) / limits
    mu = 1.0 / (2.0 * float(ratio.max(initial=1.0)) - 1.0)
    for _ in checking(range(ROUNDS if (ratio > 1).any() else 0)):
        trust = truncated_weights(ratio, mu)
        solution = _linear(len(middles), owners, measured, trust[:, None, None] * weights, map_prior)
        ratio = _squared(solution, owners, measured, weights) / limits
        if bool(np.all((trust < 1e-3) | (trust > 0.999))):
            break
        mu *= GROWTH
    inliers = ratio <= 1
    if not inliers.all():
        solution = _linear(len(middles), owners, measured, inliers[:, None, None] * weights, map_prior)
    counts = np.bincount(owners[inliers], minlength=len(middles))
    shared = np.where(inliers, 1.0 / np.maximum(counts[owners], 1), 0.0)
    _, covariances, _ = _linear(len(middles), owners, measured, shared[:, None, None] * weights, map_prior)
    return BuildingSolution(solution[0], covariances, solution[2], inliers)


def agreeing(
    middles: NDArray[np.float64], matches: Sequence[BuildingMatch], poses: Mapping[int, Floats]
) -> NDArray[np.bool_]:
    """(M,) true where `SUPPORT` other matches of the same building, which observe the same directions, agree.

    One keyframe may match a hedge or the neighbour's wall; along a direction that no other match observes, it could not be
    rejected as an outlier.
    """
    measured = np.array([m.displacement(poses[m.keyframe], middles[m.building]) for m in matches]).reshape(-1, 3)
    weights = np.array([_in_map(m.information, poses[m.keyframe][2]) for m in matches]).reshape(-1, 3, 3)
    owners = np.array([m.building for m in matches], np.intp)
    found = np.zeros(len(matches), bool)
    for k, match in enumerate(checking(matches)):
        values, axes = np.linalg.eigh(weights[k])
        own = axes[:, values > FREE * values[-1]]
        others = np.flatnonzero((owners == match.building) & (np.arange(len(matches)) != k))
        away = measured[others] - measured[k]
        away[:, 2] = se2.wrapped(away[:, 2])
        is_near = np.einsum("mi,ij,mj->m", away, weights[k], away) <= quantile(PROBABILITY, max(match.rank, 1))
        seen = np.einsum("ia,mij,ja->ma", own, weights[others], own)
        knows = (seen >= ALIKE * np.einsum("ia,ij,ja->a", own, weights[k], own)).all(axis=1)
        found[k] = (is_near & knows).sum() >= SUPPORT
    return found


def _in_map(information: Floats, yaw: float) -> Floats:
    """Information in the level axes of a keyframe with heading `yaw`, in those of the map."""
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(yaw)
    return turn @ information @ turn.T


def _linear(
    count: int, owners: NDArray[np.intp], measured: Floats, weights: Floats, map_prior: MapPrior
) -> tuple[Floats, Floats, Floats]:
    """Displacements, covariances and shift by least squares; each building is eliminated, the shift is what is left."""
    own = np.diag(1.0 / map_prior.sigma**2)
    normal, pull = np.tile(own, (count, 1, 1)), np.zeros((count, 3))
    np.add.at(normal, owners, weights)
    np.add.at(pull, owners, (weights @ measured[:, :, None])[:, :, 0])
    covariances = np.linalg.inv(normal)
    # d_i = C_i (pull_i + own (shift, 0)), so each building informs the shift by its matches alone.
    through = own[:2, :2]
    common = np.diag(1.0 / map_prior.shift_sigma**2)
    seen = through @ (np.linalg.inv(through) - covariances[:, :2, :2]) @ through
    told = (through @ (covariances @ pull[:, :, None])[:, :2])[:, :, 0]
    spread = np.linalg.inv(common + seen.sum(axis=0))
    shift = spread @ (common @ map_prior.shift + told.sum(axis=0))
    found = (covariances @ (pull + own[:, :2] @ shift)[:, :, None])[:, :, 0]
    by_shift = covariances @ own[:, :2]
    return found, covariances + by_shift @ spread @ np.swapaxes(by_shift, -1, -2), shift


def _squared(
    solution: tuple[Floats, Floats, Floats], owners: NDArray[np.intp], measured: Floats, weights: Floats
) -> Floats:
    """(M,) whitened squared residuals of the matches."""
    away = measured - solution[0][owners]
    away[:, 2] = se2.wrapped(away[:, 2])
    return np.asarray(np.einsum("mi,mij,mj->m", away, weights, away))
