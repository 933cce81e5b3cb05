"""Odometry as constraints between keyframes, and optimised keyframes as poses of all scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.drift import drift_covariance
from lslam.backend.graph.factors import PLANAR
from lslam.core.arrays import Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.constraint import Constraint
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe

# m and rad; least sigmas of a step when a method states no covariance, and those of one into another frame.
LEAST_M, LEAST_RAD = 1e-3, 1e-4
FREE_M, FREE_RAD = 1e3, np.pi
# Sigmas of a perfect fit and of a bad one, and how soon they grow with the fitness score (hdl_graph_slam).
FITNESS_SIGMA_M, FITNESS_SIGMA_RAD, FITNESS_GAIN = (0.1, 5.0), (0.05, 0.2), 20.0
# m2 and rad2, of every constraint by `graph.information = "identity"`.
IDENTITY = np.eye(6)


def odometry_constraints(
    keyframes: Sequence[Keyframe],
    results: Sequence[ScanResult],
    config: GraphConfig,
    fitness: Sequence[float] | None = None,
) -> list[Constraint]:
    """Constraints from each keyframe to the next, with the growth of odometry's covariance between them.

    A scan's covariance is that of the local map and that of its registration on it; only the former accumulates
    (`odometry.uncertainty`). Methods without covariances get the drift of `config`.
    fitness : (K-1,) fitness score of each keyframe against the one before, m2, for `graph.information = fitness`, else None
    """
    constraints = []
    for k, (before, after) in enumerate(pairwise(keyframes)):
        a, b = results[before.scan], results[after.scan]
        T = se3.relative(a.T_world_lidar, b.T_world_lidar)
        if config.information == "identity" and a.frame == b.frame:
            covariance = IDENTITY
        elif fitness is not None:
            covariance = fitness_covariance(fitness[k], config)
        else:
            grown = growth(a, b, after.distance - before.distance, config)
            covariance = noise.rotate(grown, a.T_world_lidar[:3, :3].T)
        covariance = in_plane(covariance) if config.planar else covariance
        constraints.append(Constraint(before.number, after.number, T, covariance, "odometry"))
    return constraints


def in_plane(covariance: Floats) -> Floats:
    """The covariance (6, 6) of an odometry step for a planar graph: height, roll and pitch get tiny, uncorrelated variances.

    So they stay as odometry measured them.
    """
    flat = np.diag(np.repeat([LEAST_M**2, LEAST_RAD**2], 3))
    flat[np.ix_(PLANAR, PLANAR)] = covariance[np.ix_(PLANAR, PLANAR)]
    return flat


def fitness_score(points: NDArray[np.float32], other: NDArray[np.float32], T: Floats) -> float:
    """Mean squared distance, m2, of the points (N, 3) of one keyframe to the nearest of another's (M, 3), at T (4, 4) from it.

    PCL's `getFitnessScore`, which hdl_graph_slam takes of its keyframes; infinite without points.
    """
    from scipy.spatial import cKDTree

    if not len(points) or not len(other):
        return float("inf")
    away, _ = cKDTree(other).query(se3.apply(T, points.astype(np.float64)))
    return float(np.mean(np.square(away)))


def fitness_covariance(score: float, config: GraphConfig) -> Floats:
    """(6, 6) covariance of a registration from its fitness score, m2, as hdl_graph_slam has it.

    The sigma is the first of `FITNESS_SIGMA_M` and of `FITNESS_SIGMA_RAD` at score 0, and the second from `fitness_limit` on.
    """
    limit = config.fitness_limit
    share = (1 - np.exp(-FITNESS_GAIN * min(score, limit))) / (1 - np.exp(-FITNESS_GAIN * limit))
    (near_m, far_m), (near_rad, far_rad) = (np.square(s) for s in (FITNESS_SIGMA_M, FITNESS_SIGMA_RAD))
    return np.diag(np.repeat([near_m + (far_m - near_m) * share, near_rad + (far_rad - near_rad) * share], 3))


def growth(a: ScanResult, b: ScanResult, way: float, config: GraphConfig) -> Floats:
    """(6, 6) growth of odometry's covariance, world axes, from scan `a` to scan `b`; way : distance travelled between, m.

    Very large where the two lie in different segments; the drift of `config` for methods without covariances.
    """
    if a.frame != b.frame:
        return np.diag(np.repeat([FREE_M**2, FREE_RAD**2], 3))
    of_a, of_b = _of_map(a), _of_map(b)
    if of_a is None or of_b is None:
        turn = np.deg2rad(config.drift_deg_per_100m) / 100 * way + LEAST_RAD
        sigma = 0.01 * config.drift_percent * way + LEAST_M
        return np.diag(np.repeat([sigma**2, turn**2], 3))
    return positive(of_b - noise.transport(of_a, b.T_world_lidar[:3, 3] - a.T_world_lidar[:3, 3]))


def correct_scans(
    results: Sequence[ScanResult],
    keyframes: Sequence[Keyframe],
    poses: Floats,
    covariances: Floats,
    drift: float,
    config: GraphConfig,
) -> list[ScanResult]:
    """All scans corrected by the optimised keyframes `poses` (K, 4, 4), with covariances.

    Between two keyframes the correction is interpolated on SE(3) over time.
    covariances : (K, 6, 6) of the keyframes in the world; drift : `Solution.drift`
    """
    moved = np.stack([r.T_world_lidar for r in results])
    final, owners = _bent(results, keyframes, moved, poses)
    out = []
    for result, T, before, k in zip(results, final, moved, owners.tolist(), strict=True):
        keyframe = results[keyframes[k].scan]
        S = _covariance(result, keyframe, T, before, poses[k], covariances[k], drift, config)
        out.append(replace(result, T_world_lidar=T, covariance=S, points_covariance=None))
    return out


def bend_scans(results: Sequence[ScanResult], keyframes: Sequence[Keyframe], poses: Floats) -> list[ScanResult]:
    """All scans corrected by the keyframes `poses` (K, 4, 4) as in `correct_scans`, with their own covariances."""
    final, _ = _bent(results, keyframes, np.stack([r.T_world_lidar for r in results]), poses)
    return [replace(result, T_world_lidar=T) for result, T in zip(results, final, strict=True)]


def _bent(
    results: Sequence[ScanResult], keyframes: Sequence[Keyframe], odometry: Floats, poses: Floats
) -> tuple[Floats, NDArray[np.intp]]:
    """(N, 4, 4) corrected poses of all scans, `odometry` by odometry, and the keyframe nearest in time, (N,)."""
    scans = np.array([k.scan for k in keyframes])
    stamps = np.array([k.stamp_ns for k in keyframes], np.int64)
    left = np.clip(np.searchsorted(scans, np.arange(len(results)), side="right") - 1, 0, max(len(scans) - 2, 0))
    right = np.minimum(left + 1, len(scans) - 1)
    from_left = poses[left] @ se3.relative(odometry[scans[left]], odometry)
    from_right = poses[right] @ se3.relative(odometry[scans[right]], odometry)
    span = np.maximum((stamps[right] - stamps[left]).astype(np.float64), 1.0)
    own = np.array([r.stamp_ns for r in results], np.int64)
    share = np.clip((own - stamps[left]).astype(np.float64) / span, 0.0, 1.0)
    twist = se3.log(se3.relative(from_left, from_right))
    final = se3.normalise(from_left @ se3.exp(share[:, None] * twist))
    return final, np.where(share < 0.5, left, right)


def positive(covariance: Floats) -> Floats:
    """The nearest positive semidefinite matrix (6, 6): a difference of two covariances may have negative eigenvalues."""
    scaled = np.array([1.0, 1, 1, 10, 10, 10])
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) * np.outer(scaled, scaled))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scaled, scaled))


def _covariance(
    result: ScanResult,
    keyframe: ScanResult,
    final: Floats,
    odometry: Floats,
    pose: Floats,
    covariance: Floats,
    drift: float,
    config: GraphConfig,
) -> Floats:
    """Covariance (6, 6) of a scan's pose: its keyframe's, the growth of odometry's between them, and its own registration's.

    final, odometry : poses (4, 4) of the scan after and before the graph
    pose, covariance : of the keyframe after the graph; drift : factor on the covariance of odometry's drift
    """
    step = final[:3, 3] - pose[:3, 3]
    first, last = (keyframe, result) if keyframe.stamp_ns <= result.stamp_ns else (result, keyframe)
    way = float(np.linalg.norm(step))
    grown = growth(first, last, way, config) + drift * drift_covariance(way, config)
    if result.registration_covariance is not None:
        grown = grown + result.registration_covariance
    turned = noise.rotate(grown, so3.normalise(final[:3, :3] @ odometry[:3, :3].T))
    return np.asarray(noise.transport(covariance, step) + turned)


def _of_map(result: ScanResult) -> Floats | None:
    """Covariance (6, 6) of the pose by the local map's error alone, without that of the scan's registration; None if unknown."""
    if result.covariance is None:
        return None
    if result.registration_covariance is None:
        return result.covariance
    return np.asarray(result.covariance - result.registration_covariance)
