"""Pose graph optimisation: consistency checks, drift estimation, robust solution, marginals.

Two true loop closures make a cycle with the odometry between their ends (Mangelson et al. 2018, pairwise consistent
measurements). Each is tested against its nearest neighbours, between which odometry drifts least; one that most of them
contradict is rejected, the most contradicted first, and the others are tested without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph import factors
from lslam.backend.graph.drift import drift_factor, with_drift
from lslam.backend.graph.marginals import marginal_blocks, marginals, pose_prior
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.backend.graph.solve import GncResult, OutlierCandidate, gnc_solve, join_factors, solve, solve_incrementally
from lslam.core.arrays import Bools, Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import GraphError
from lslam.core.geometry import noise, se3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile, squared_distances
from lslam.core.stopping import check_stop
from lslam.core.types.constraint import Constraint, LoopStage

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
        """(P, 6, 6) covariances of keyframes `b` (P,) relative to `a` (P,), isotropic, with the lever arm of heading drift."""
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
    """Reason why each loop closure is rejected, empty where it is accepted: odometry or most of its neighbours contradict it."""
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
        """The loop closures at `index`."""
        part = object.__new__(Ends)
        part.a, part.b, part.T, part.covariances = self.a[index], self.b[index], self.T[index], self.covariances[index]
        return part


def as_twists(covariance: Floats, T: Floats) -> Floats:
    """Covariances (..., 6, 6) of poses T, t' = t + d[:3], R' = exp(d[3:]) R, as those of left twists xi: T' = exp(xi) T."""
    return noise.transport(covariance, -T[..., :3, 3])


def _against_odometry(graph: PoseGraph, ends: Ends, drift: Drift) -> tuple[Floats, Floats]:
    """(L, 6) residuals of the loop closures against odometry, in the axes of a, and their covariances."""
    twists = noise.changes(se3.relative(graph.poses[ends.a], graph.poses[ends.b]), ends.T)
    own = noise.transport(ends.covariances, ends.T[:, :3, 3])
    return twists, drift.covariance(ends.a, ends.b) + own + _slack(len(ends.a))


def _voted_out(graph: PoseGraph, ends: Ends, drift: Drift, limit: float) -> list[tuple[int, float]]:
    """Index of each loop closure that most of its neighbours contradict, with the share that agrees, the worst first.

    limit : largest squared Mahalanobis distance of a cycle through two loop closures that agree
    """
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
    """(P,) squared Mahalanobis distances of the cycle a_i -> b_i -> b_j -> a_j -> a_i from the identity.

    i, j : (P,) indices of the two loop closures in `ends`
    The second array (P,) is the inverse variance, 1/m2, of drift in the cycle, which says how strict each test is.
    """
    ahead = se3.relative(graph.poses[ends.b[i]], graph.poses[ends.b[j]])
    home = se3.relative(graph.poses[ends.a[j]], graph.poses[ends.a[i]])
    to_bi, to_bj = ends.T[i], ends.T[i] @ ahead
    to_aj = to_bj @ se3.inverse(ends.T[j])
    by_b, by_a = drift.covariance(ends.b[i], ends.b[j]), drift.covariance(ends.a[j], ends.a[i])
    S = ends.covariances[i] + _propagate(by_b, ahead, to_bi)
    S += transport_twists(ends.covariances[j], to_aj) + _propagate(by_a, home, to_aj)
    sharpness = 1.0 / (SLACK_M**2 + by_b[:, 0, 0] + by_a[:, 0, 0])
    return squared_distances(se3.log(to_aj @ home), S + _slack(len(i))), sharpness


def _propagate(covariance: Floats, T: Floats, to: Floats) -> Floats:
    """Covariances of poses T (..., 4, 4) as those of left twists after composition with `to` (..., 4, 4) from the left."""
    return transport_twists(as_twists(covariance, T), to)


def transport_twists(covariance: Floats, to: Floats) -> Floats:
    """Covariances of left twists of T as those of left twists of `to` T (..., 4, 4), by the adjoint."""
    A = se3.adjoint(to)
    return np.asarray(A @ covariance @ np.swapaxes(A, -1, -2))


def _slack(count: int) -> Floats:
    """(count, 6, 6) small isotropic covariances, for registration errors that a loop closure's own covariance lacks."""
    return _isotropic(np.full(count, SLACK_M), np.full(count, SLACK_RAD))


def _isotropic(sigma_m: Floats, sigma_rad: Floats) -> Floats:
    """(P, 6, 6) diagonal covariances of translation sigmas (P,), m, and rotation sigmas (P,), rad."""
    S = np.zeros((len(sigma_m), 6, 6))
    S[:, range(3), range(3)] = sigma_m[:, None] ** 2
    S[:, range(3, 6), range(3, 6)] = sigma_rad[:, None] ** 2
    return S


def optimise(graph: PoseGraph, config: GraphConfig) -> Solution:
    """Poses and covariances of all keyframes, and which loop closures, fixes and planar priors are inliers.

    Binding ones are applied first, and everything else is judged from the poses that result. Loop closures inconsistent with each
    other or with odometry are rejected; odometry's covariances grow by the drift that the others reveal; then all is solved
    together, with loop closures, fixes and planar priors that are not binding as outlier candidates.

    Raises GraphError when the graph is disconnected, singular or not finite.
    """
    check_graph(graph)
    graph = apply_manual(with_distances(graph), config)
    reasons = judge_loops(graph, config) if config.is_pairwise else [""] * len(graph.loops)
    reasons = ["" if loop.is_binding else reason for loop, reason in zip(graph.loops, reasons, strict=True)]
    stages = [LoopStage.CONSISTENCY if reason else LoopStage.GRAPH for reason in reasons]
    accepted = [i for i, reason in enumerate(reasons) if not reason]
    is_as_given = graph.is_rigid or config.information == "identity"
    drift = 0.0 if is_as_given else max(drift_factor(graph, [graph.loops[i] for i in accepted], config), graph.walk)
    accepted = [i for i in accepted if not graph.loops[i].is_binding]
    loops, fixes = [graph.loops[i] for i in accepted], [fix for fix in graph.fixes if not fix.is_binding]
    graph = replace(graph, odometry=with_drift(graph, drift, config))
    may_tilt = graph.is_anchored and len(graph.ups) > 0
    is_placed = graph.start_sigma is not None or not graph.is_anchored
    fixed = factors.fixed_part(graph, may_tilt)
    candidates = [OutlierCandidate(make, 6) for make in factors.between_makers(loops)]
    candidates += [OutlierCandidate(partial(factors.position, fix), 3) for fix in fixes]
    key = factors.map_key(graph)
    candidates += [
        OutlierCandidate(partial(factors.planar, prior, graph.poses[prior.keyframe], key), prior.rank)
        for prior in graph.map_priors
    ]
    values = factors.start_values(graph, graph.poses)
    if config.optimizer == "isam2":
        everything = join_factors(fixed, [item.make(1.0, None) for item in candidates])
        values = solve_incrementally(everything, values, len(graph))
    solved = gnc_solve(fixed, candidates, values, config)
    poses = se3.normalise(factors.poses_of(solved.values, len(graph)))
    if not np.isfinite(poses).all():
        raise GraphError("the pose graph cannot be optimised: its poses are not finite")
    if may_tilt and not is_placed:
        poses, covariances = _upright(
            graph, poses, [d for d, w in zip(candidates, solved.weights, strict=True) if w >= 0.5]
        )
    else:
        covariances = marginals(solved.factors, solved.values, poses)
    covariances = covariances if graph.spread is None else covariances + graph.spread
    rejections = [
        ""
        if weight >= 0.5
        else f"{np.sqrt(squared / limit):.1f} times as far as it may be from where all others put it"
        for weight, squared, limit in zip(solved.weights, solved.squared_residuals, solved.limits, strict=True)
    ]
    for i, rejection in zip(accepted, rejections, strict=False):
        reasons[i] = reasons[i] or rejection
    prior = None
    if config.refine and is_placed:
        known = zip(candidates[len(loops) :], solved.weights[len(loops) :], strict=True)
        inliers = [candidate.make(1.0, None) for candidate, weight in known if weight >= 0.5]
        prior = pose_prior(
            join_factors(factors.fixed_part(graph, may_tilt, with_lidar=False), inliers), solved.values, len(graph)
        )
    rest = len(loops) + len(fixes)
    fix_inliers = np.ones(len(graph.fixes), np.bool_)
    fix_inliers[[not fix.is_binding for fix in graph.fixes]] = solved.weights[len(loops) : rest] >= 0.5
    shift, shift_sigma = _map_shift(graph, solved)
    return Solution(
        poses=poses,
        covariances=covariances,
        loop_reasons=reasons,
        loop_stages=stages,
        fix_inliers=fix_inliers,
        map_reasons=rejections[rest:],
        shift=shift,
        shift_sigma=shift_sigma,
        drift=drift,
        rounds=solved.rounds,
        error=float(solved.factors.error(solved.values)),
        pose_prior=prior,
    )


def apply_manual(graph: PoseGraph, config: GraphConfig) -> PoseGraph:
    """The graph at the poses that its binding loop closures and fixes alone imply, with the drift that these reveal.

    Other constraints are judged from these poses, not from odometry's. Raises GraphError when it cannot be solved.
    """
    loops, fixes = [loop for loop in graph.loops if loop.is_binding], [fix for fix in graph.fixes if fix.is_binding]
    if not (loops or fixes):
        return graph
    alone = replace(
        graph, loops=loops, fixes=fixes, map_priors=(), fix_noise=None, is_anchored=graph.is_anchored or not fixes
    )
    walk = 0.0 if graph.is_rigid else max(drift_factor(alone, loops, config), graph.walk)
    alone = replace(alone, odometry=with_drift(alone, walk, config))
    values = solve(factors.fixed_part(alone), factors.start_values(alone, alone.poses), config)
    poses = factors.poses_of(values, len(graph))
    if not np.isfinite(poses).all():
        raise GraphError("the pose graph cannot be optimised: its poses are not finite")
    if alone.is_anchored:
        poses = graph.poses[0] @ se3.inverse(poses[0]) @ poses
    return replace(graph, poses=se3.normalise(poses), walk=walk)


def _map_shift(graph: PoseGraph, result: GncResult) -> tuple[Floats, Floats]:
    """(2,) m, common shift of the map, and its sigma; zero and infinity without a map."""
    if not graph.map_priors:
        return np.zeros(2), np.full(2, np.inf)
    key = factors.map_key(graph)
    frame = result.values.atPose3(key).matrix()
    covariance = noise.from_body(marginal_blocks(result.factors, result.values, [key]), frame[None])[0]
    return frame[:2, 3], np.sqrt(np.diag(covariance)[:2])


def _upright(graph: PoseGraph, poses: Floats, inliers: list[OutlierCandidate]) -> tuple[Floats, Floats]:
    """The solution with its first pose as before, and its covariances relative to that pose.

    Up in the world is estimated by the solution, so that a wrong initial guess of it bends no trajectory.
    """
    back = graph.poses[0] @ se3.inverse(poses[0])
    poses = se3.normalise(back @ poses)
    turned = replace(graph, world_up=back[:3, :3] @ graph.world_up)
    whole = join_factors(factors.fixed_part(turned), [item.make(1.0, None) for item in inliers])
    return poses, marginals(whole, factors.start_values(turned, poses), poses)


def check_graph(graph: PoseGraph) -> None:
    """Raise GraphError for a graph without a solution: numbers that are not finite, disconnected keyframes."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(graph)
    if not count or not np.isfinite(graph.poses).all():
        raise GraphError("the pose graph has no keyframes" if not count else "a keyframe's pose is not finite")
    constraints = [*graph.odometry, *graph.loops]
    for c, is_finite in zip(constraints, _are_finite(constraints), strict=True):
        if not (0 <= c.a < count and 0 <= c.b < count) or c.a == c.b:
            raise GraphError(f"a constraint joins keyframes {c.a} and {c.b}; there are {count}")
        if not is_finite:
            raise GraphError(f"the constraint between keyframes {c.a} and {c.b} is not finite")
    ends = np.array([(c.a, c.b) for c in graph.odometry], np.intp).reshape(-1, 2).T
    links = coo_matrix((np.ones(ends.shape[1]), (ends[0], ends[1])), (count, count))
    _, label = connected_components(links, directed=False)
    if (label != label[0]).any():
        lost = int(np.argmax(label != label[0]))
        raise GraphError(f"the pose graph is in pieces: odometry does not join keyframe {lost} to the first")


def _are_finite(constraints: Sequence[Constraint]) -> Bools:
    """(C,) whether a constraint's numbers are finite."""
    if not constraints:
        return np.zeros(0, np.bool_)
    poses, covariances = np.stack([c.T_a_b for c in constraints]), np.stack([c.covariance for c in constraints])
    return np.asarray(np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(covariances).all(axis=(1, 2)))


def with_distances(graph: PoseGraph) -> PoseGraph:
    """The graph with the distances travelled along its poses, where they are missing."""
    if len(graph.distances) == len(graph):
        return graph
    steps = np.linalg.norm(np.diff(graph.poses[:, :3, 3], axis=0), axis=1)
    return replace(graph, distances=np.concatenate([[0.0], np.cumsum(steps)]))
