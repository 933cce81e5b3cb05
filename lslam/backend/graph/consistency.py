"""Consistency of loop closures with each other and with odometry, before optimisation.

Two true loop closures make a cycle with the odometry between their ends (Mangelson et al. 2018, pairwise consistent
measurements). Each is tested against its nearest neighbours, between which odometry drifts least; one that most of them
contradict is rejected, the most contradicted first, and the others are tested without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.problem import PoseGraph
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile, squared_distances
from lslam.core.stopping import check_stop
from lslam.core.types.arrays import Floats
from lslam.core.types.constraint import Constraint

# Neighbours that each loop closure is tested against, and the share that must agree.
COMPARED_LOOPS, SHARE = 16, 0.5
# m and rad, error of a loop closure beyond its covariance: its scans are deskewed and downsampled.
SLACK_M, SLACK_RAD = 0.03, np.deg2rad(0.1)
# Positions sampled on the way between two keyframes.
SAMPLES = 16


@dataclass(frozen=True)
class Drift:
    """Conservative model of odometry's drift over any part of a trajectory: proportional to the way.

    positions : (K, 3); distances : (K,) m travelled; percent : one sigma of translation; rad_per_m : of rotation
    """

    positions: Floats
    distances: Floats
    percent: float
    rad_per_m: float

    def covariance(self, a: NDArray[Any], b: NDArray[Any]) -> Floats:
        """(P, 6, 6) of the pose of keyframes `b` (P,) seen from `a` (P,), isotropic; a turn moves what lies ahead of it."""
        way = np.abs(self.distances[b] - self.distances[a])
        steps = np.linspace(0, 1, SAMPLES)
        between = np.round(a[:, None] + steps * (b - a)[:, None]).astype(np.intp)
        ahead = np.linalg.norm(self.positions[between] - self.positions[b][:, None], axis=-1).mean(1)
        turn = self.rad_per_m * way
        sigma = 0.01 * self.percent * way + turn * ahead
        return _isotropic(sigma, turn)


def drift_of(graph: PoseGraph, config: GraphConfig) -> Drift:
    """The drift that the configuration allows the graph's odometry."""
    return Drift(
        graph.poses[:, :3, 3], graph.distances, config.drift_percent, np.deg2rad(config.drift_deg_per_100m) / 100
    )


def judge_loops(graph: PoseGraph, config: GraphConfig) -> list[str]:
    """Per loop closure why it is rejected, empty where it is accepted."""
    reasons = [""] * len(graph.loops)
    if not graph.loops:
        return reasons
    ends = Ends(graph.loops)
    drift = drift_of(graph, config)
    limit = quantile(RIGHT_PROBABILITY, 6)
    twists, covariances = _against_odometry(graph, ends, drift)
    errors = squared_distances(twists, covariances)
    near = errors <= limit
    for i in np.flatnonzero(~near).tolist():
        off = float(np.linalg.norm(twists[i, :3]))
        reasons[i] = f"{off:.1f} m from where odometry is, {np.sqrt(errors[i] / limit):.1f} times what it may drift"
    near_loops = np.flatnonzero(near)
    if len(near_loops) > 1:
        for i, share in _voted_out(graph, ends.select(near_loops), drift, limit):
            reasons[near_loops[i]] = f"only {share:.0%} of the loops around it agree with it"
    return reasons


class Ends:
    """Loop closures as arrays: ends `a` and `b` (L,), poses `T` (L, 4, 4), covariances (L, 6, 6) of twists on the left."""

    def __init__(self, loops: Any) -> None:
        items: list[Constraint] = list(loops)
        self.a = np.array([c.a for c in items], np.intp)
        self.b = np.array([c.b for c in items], np.intp)
        self.T = np.stack([c.T_a_b for c in items])
        self.covariances = as_twists(np.stack([c.covariance for c in items]), self.T)

    def select(self, index: NDArray[Any]) -> Ends:
        """Some of them."""
        part = object.__new__(Ends)
        part.a, part.b, part.T, part.covariances = self.a[index], self.b[index], self.T[index], self.covariances[index]
        return part


def as_twists(covariance: Floats, T: Floats) -> Floats:
    """Covariances of t' = t + d[:3], R' = exp(d[3:]) R as those of exp(xi) T."""
    return noise.transport(covariance, -T[..., :3, 3])


def _against_odometry(graph: PoseGraph, ends: Ends, drift: Drift) -> tuple[Floats, Floats]:
    """(L, 6) residuals of the loop closures against odometry, in the axes of a, and their covariances."""
    odometry = se3.relative(graph.poses[ends.a], graph.poses[ends.b])
    turn = ends.T[:, :3, :3] @ np.swapaxes(odometry[:, :3, :3], -1, -2)
    twists = np.concatenate([ends.T[:, :3, 3] - odometry[:, :3, 3], so3.log(turn)], axis=1)
    own = noise.transport(ends.covariances, ends.T[:, :3, 3])
    return twists, drift.covariance(ends.a, ends.b) + own + _slack(len(ends.a))


def _voted_out(graph: PoseGraph, ends: Ends, drift: Drift, limit: float) -> list[tuple[int, float]]:
    """Loop closures that most of their neighbours contradict, with the share that agrees."""
    from scipy.spatial import cKDTree

    where = np.column_stack([drift.distances[ends.a], drift.distances[ends.b]])
    k = min(COMPARED_LOOPS, len(where) - 1)
    _, neighbours = cKDTree(where).query(where, k + 1, p=1)
    others = np.array([row[row != i][:k] for i, row in enumerate(np.asarray(neighbours))])
    first = np.repeat(np.arange(len(where)), k)
    errors, sharpness = _cycle_errors(graph, ends, drift, first, others.ravel())
    agrees = (errors <= limit).reshape(others.shape)
    # Far neighbours agree with anything, as odometry drifts far between: votes are weighted.
    votes = sharpness.reshape(others.shape)
    alive = np.ones(len(where), bool)
    outliers: list[tuple[int, float]] = []
    while True:
        check_stop()
        alive_votes = np.where(alive[others], votes, 0.0)
        total = alive_votes.sum(1)
        share = np.where(total > 0, (agrees * alive_votes).sum(1) / np.where(total > 0, total, 1.0), 1.0)
        share[~alive] = 1.0
        worst = float(share.min())
        if worst >= SHARE:
            return outliers
        out = np.flatnonzero(share == worst)
        outliers += [(int(i), worst) for i in out]
        alive[out] = False


def _cycle_errors(
    graph: PoseGraph, ends: Ends, drift: Drift, i: NDArray[Any], j: NDArray[Any]
) -> tuple[Floats, Floats]:
    """(P,) squared Mahalanobis distances from the identity of a_i -> b_i -> b_j -> a_j -> a_i.

    Beside them the sharpness of each test: the inverse variance, 1/m2, of drift on the way.
    """
    ahead = se3.relative(graph.poses[ends.b[i]], graph.poses[ends.b[j]])
    home = se3.relative(graph.poses[ends.a[j]], graph.poses[ends.a[i]])
    to_bi, to_bj = ends.T[i], ends.T[i] @ ahead
    to_aj = to_bj @ se3.inverse(ends.T[j])
    by_b, by_a = drift.covariance(ends.b[i], ends.b[j]), drift.covariance(ends.a[j], ends.a[i])
    S = ends.covariances[i] + _carried(by_b, ahead, to_bi)
    S += moved(ends.covariances[j], to_aj) + _carried(by_a, home, to_aj)
    sharpness = 1.0 / (SLACK_M**2 + by_b[:, 0, 0] + by_a[:, 0, 0])
    return squared_distances(se3.log(to_aj @ home), S + _slack(len(i))), sharpness


def _carried(covariance: Floats, T: Floats, to: Floats) -> Floats:
    return moved(as_twists(covariance, T), to)


def moved(covariance: Floats, to: Floats) -> Floats:
    """Covariances of twists before `to` (..., 4, 4) as those of twists after it."""
    A = se3.adjoint(to)
    return np.asarray(A @ covariance @ np.swapaxes(A, -1, -2))


def _slack(count: int) -> Floats:
    return _isotropic(np.full(count, SLACK_M), np.full(count, SLACK_RAD))


def _isotropic(sigma_m: Floats, sigma_rad: Floats) -> Floats:
    S = np.zeros((len(sigma_m), 6, 6))
    S[:, range(3), range(3)] = sigma_m[:, None] ** 2
    S[:, range(3, 6), range(3, 6)] = sigma_rad[:, None] ** 2
    return S
