"""Displacements of buildings estimated from walls along a fixed trajectory: the second of two levels.

Del Tufo, section 3.4: mapping never harms localisation. A building's displacement is x, y, yaw about its middle; every match
observes some directions of it, and a weak prior of the map has it displaced by the common shift of all buildings. So the
problem is linear, and an unobserved direction follows the shift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph import factors
from lslam.backend.graph.marginals import marginal_blocks, marginals
from lslam.backend.graph.pose_graph import check_graph
from lslam.backend.graph.problem import PlanarPrior, PoseGraph
from lslam.backend.graph.solve import (
    GROWTH,
    ROUNDS,
    OutlierCandidate,
    are_binary,
    gnc_solve,
    join_factors,
    truncated_weights,
)
from lslam.core.arrays import Bools, Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se2, se3
from lslam.core.geometry.noise import quantile
from lslam.core.stopping import checking
from lslam.core.types.building import BuildingMatch

PROBABILITY = 0.999  # chi-square quantile of an inlier match
SUPPORT = 2  # other matches that must agree
# Shares of information below which a direction is unobserved, and from which another match observes it as well.
FREE, ALIKE = 1e-9, 0.05
FIRM, LOOSE = 1e-4, 1e4  # m and rad; sigmas of what is anchored, and of what has no prior


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
    inliers: Bools


def solve_buildings(
    middles: Floats,
    matches: Sequence[BuildingMatch],
    poses: Mapping[int, Floats],
    map_prior: MapPrior,
) -> BuildingSolution:
    """Displacements of the buildings with `middles` (B, 2), m, from `matches`, with each keyframe at `poses` (3,) of the map.

    Outlier matches are rejected by graduated non-convexity with truncated least squares (`graph.solve`); the map's prior is no
    outlier candidate. Matches of one building share the map's error, so the covariances are those of one match of mean
    information, while the displacements use all of them.
    """
    owners, measurements, weights = _as_arrays(middles, matches, poses)
    limits = np.array([quantile(PROBABILITY, max(m.rank, 1)) for m in matches])
    trust = np.ones(len(matches))
    solution = _linear(len(middles), owners, measurements, weights, map_prior)
    ratio = _squared_residuals(solution, owners, measurements, weights) / limits
    mu = 1.0 / (2.0 * float(ratio.max(initial=1.0)) - 1.0)
    for _ in checking(range(ROUNDS if (ratio > 1).any() else 0)):
        trust = truncated_weights(ratio, mu)
        solution = _linear(len(middles), owners, measurements, trust[:, None, None] * weights, map_prior)
        ratio = _squared_residuals(solution, owners, measurements, weights) / limits
        if are_binary(trust):
            break
        mu *= GROWTH
    inliers = ratio <= 1
    if not inliers.all():
        solution = _linear(len(middles), owners, measurements, inliers[:, None, None] * weights, map_prior)
    counts = np.bincount(owners[inliers], minlength=len(middles))
    shared = np.where(inliers, 1.0 / np.maximum(counts[owners], 1), 0.0)
    _, covariances, _ = _linear(len(middles), owners, measurements, shared[:, None, None] * weights, map_prior)
    return BuildingSolution(solution[0], covariances, solution[2], inliers)


def agreeing(middles: Floats, matches: Sequence[BuildingMatch], poses: Mapping[int, Floats]) -> Bools:
    """(M,) true where at least `SUPPORT` other matches of the same building agree that observe the same directions.

    One keyframe may match a hedge or the neighbour's wall; along a direction that no other match observes, it could not be
    rejected as an outlier.
    """
    owners, measured, weights = _as_arrays(middles, matches, poses)
    agrees = np.zeros(len(matches), bool)
    for k, match in enumerate(checking(matches)):
        values, axes = np.linalg.eigh(weights[k])
        own = axes[:, values > FREE * values[-1]]
        others = np.flatnonzero((owners == match.building) & (np.arange(len(matches)) != k))
        away = measured[others] - measured[k]
        away[:, 2] = se2.wrap(away[:, 2])
        is_near = np.einsum("mi,ij,mj->m", away, weights[k], away) <= quantile(PROBABILITY, max(match.rank, 1))
        shared = np.einsum("ia,mij,ja->ma", own, weights[others], own)
        knows = (shared >= ALIKE * np.einsum("ia,ij,ja->a", own, weights[k], own)).all(axis=1)
        agrees[k] = (is_near & knows).sum() >= SUPPORT
    return agrees


def _as_arrays(
    middles: Floats, matches: Sequence[BuildingMatch], poses: Mapping[int, Floats]
) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Building (M,), displacement (M, 3) and its information (M, 3, 3) of each match, in the axes of the map."""
    measured = [m.displacement(poses[m.keyframe], middles[m.building]) for m in matches]
    turns = [se2.to_se3(np.append(np.zeros(2), poses[m.keyframe][2]))[:3, :3] for m in matches]
    weights = [turn @ m.information @ turn.T for turn, m in zip(turns, matches, strict=True)]
    owners = np.array([m.building for m in matches], np.intp)
    return owners, np.array(measured).reshape(-1, 3), np.array(weights).reshape(-1, 3, 3)


def _linear(
    count: int, owners: NDArray[np.intp], measurements: Floats, weights: Floats, map_prior: MapPrior
) -> tuple[Floats, Floats, Floats]:
    """Displacements (B, 3), covariances (B, 3, 3) and common shift (2,) of B = count buildings by linear least squares.

    owners, measurements, weights : as of `_as_arrays`. The buildings are eliminated first.
    """
    own = np.diag(1.0 / map_prior.sigma**2)
    normal, pull = np.tile(own, (count, 1, 1)), np.zeros((count, 3))
    np.add.at(normal, owners, weights)
    np.add.at(pull, owners, (weights @ measurements[:, :, None])[:, :, 0])
    covariances = np.linalg.inv(normal)
    # d_i = C_i (pull_i + own (shift, 0)), so each building informs the shift by its matches alone.
    through = own[:2, :2]
    common = np.diag(1.0 / map_prior.shift_sigma**2)
    shared = through @ (np.linalg.inv(through) - covariances[:, :2, :2]) @ through
    pulls = (through @ (covariances @ pull[:, :, None])[:, :2])[:, :, 0]
    spread = np.linalg.inv(common + shared.sum(axis=0))
    shift = spread @ (common @ map_prior.shift + pulls.sum(axis=0))
    offsets = (covariances @ (pull + own[:, :2] @ shift)[:, :, None])[:, :, 0]
    by_shift = covariances @ own[:, :2]
    return offsets, covariances + by_shift @ spread @ np.swapaxes(by_shift, -1, -2), shift


def _squared_residuals(
    solution: tuple[Floats, Floats, Floats], owners: NDArray[np.intp], measurements: Floats, weights: Floats
) -> Floats:
    """(M,) whitened squared residuals of the matches; solution : as of `_linear`; others as of `_as_arrays`."""
    away = measurements - solution[0][owners]
    away[:, 2] = se2.wrap(away[:, 2])
    return np.asarray(np.einsum("mi,mij,mj->m", away, weights, away))


@dataclass(frozen=True)
class JointSolution:
    """poses : (K, 4, 4) of all keyframes; covariances : (K, 6, 6) as of `Solution`; buildings : as of `solve_buildings`."""

    poses: Floats
    covariances: Floats
    buildings: BuildingSolution


def optimise_jointly(
    graph: PoseGraph,
    middles: Floats,
    matches: Sequence[BuildingMatch],
    map_prior: MapPrior | None,
    config: GraphConfig,
) -> JointSolution:
    """Poses of keyframes and displacements of the buildings with `middles` (B, 2), m, in one graph.

    graph : in the frame of the map; its loop closures and fixes are inliers; it has no planar priors
    map_prior : None is the baseline: the first building matched is anchored, no match is an outlier candidate

    Raises GraphError when the graph is disconnected, singular or not finite.
    """
    import gtsam

    check_graph(graph)
    seen = list(dict.fromkeys(m.building for m in matches))
    keys = {building: factors.map_key(graph) + 1 + n for n, building in enumerate(seen)}
    certain = factors.between_all(graph.loops) + [factors.position(fix) for fix in graph.fixes]
    values = factors.start_values(graph, graph.poses)
    for building, key in keys.items():
        shift = np.zeros(2) if map_prior is None else map_prior.shift
        pose = se2.to_se3(np.append(middles[building] + shift, 0.0))
        certain.append(_own(key, pose, _sigma(map_prior, building == seen[0])))
        values.insert(key, gtsam.Pose3(pose))
    edges = [partial(factors.planar, _seen_from(m), graph.poses[m.keyframe], keys[m.building]) for m in matches]
    fixed = join_factors(factors.fixed_part(graph), certain)
    candidates = [OutlierCandidate(edge, max(m.rank, 1)) for edge, m in zip(edges, matches, strict=True)]
    solved = gnc_solve(fixed, candidates, values, config if map_prior else config.model_copy(update={"robust": "none"}))
    poses = se3.normalise(factors.poses_of(solved.values, len(graph)))
    places = np.array([solved.values.atPose3(key).matrix() for key in keys.values()]).reshape(-1, 4, 4)
    spread = np.zeros((0, 6, 6))
    if seen:
        spread = noise.from_body(marginal_blocks(solved.factors, solved.values, keys.values()), places)
    buildings = _solution(middles, seen, places, spread, solved.weights >= 0.5, map_prior)
    covariances = marginals(solved.factors, solved.values, poses)
    covariances = covariances if graph.spread is None else covariances + graph.spread
    return JointSolution(poses, covariances, buildings)


def _seen_from(match: BuildingMatch) -> PlanarPrior:
    """The match inverted: pose of the keyframe in the building's axes, with its information there, as a planar prior."""
    pose = se2.inverse(match.pose)
    back = np.zeros((3, 3))
    back[:2, :2] = -se2.rotation(-match.pose[2])
    back[:2, 2] = [pose[1], -pose[0]]
    back[2, 2] = -1.0
    undone = np.linalg.inv(back)
    return PlanarPrior(match.keyframe, pose, undone.T @ match.information @ undone, match.rank)


def _sigma(map_prior: MapPrior | None, is_first: bool) -> Floats:
    """(3,) prior sigmas of a building's displacement: x, y (m), yaw (rad)."""
    if map_prior is None:
        return np.full(3, FIRM if is_first else LOOSE)
    return np.asarray(np.sqrt(map_prior.sigma**2 + np.append(map_prior.shift_sigma, 0.0) ** 2))


def _own(key: int, pose: Floats, sigma: Floats) -> Any:
    """Prior factor of gtsam on a building's pose `key`: at `pose` (4, 4), with sigmas (3,) of x, y (m), yaw (rad)."""
    import gtsam

    spread = np.diag(np.array([*sigma[:2], FIRM, FIRM, FIRM, sigma[2]]) ** 2)
    model = gtsam.noiseModel.Gaussian.Covariance(noise.to_body(spread, pose))
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), model)


def _solution(
    middles: Floats,
    which: list[int],
    places: Floats,
    block_covariances: Floats,
    inliers: Bools,
    map_prior: MapPrior | None,
) -> BuildingSolution:
    """Displacements of all buildings with `middles` (B, 2), m; those without a match follow the mean shift of the others.

    which : matched buildings; places, block_covariances : (W, 4, 4), (W, 6, 6) of their solved poses; inliers : of the matches
    """
    solution = np.zeros((len(middles), 3))
    covariances = np.tile(np.diag(_sigma(map_prior, False) ** 2), (len(middles), 1, 1))
    if which:
        solution[which] = se2.of_se3(places) - np.column_stack([middles[which], np.zeros(len(which))])
        covariances[which] = block_covariances[:, factors.PLANAR][:, :, factors.PLANAR]
    shift = solution[which, :2].mean(axis=0) if which else (np.zeros(2) if map_prior is None else map_prior.shift)
    unseen = np.setdiff1d(np.arange(len(middles)), which)
    solution[unseen, :2] = 0.0 if map_prior is None else shift
    return BuildingSolution(solution, covariances, shift, inliers)
