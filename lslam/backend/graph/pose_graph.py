"""Pose graph optimisation: consistency checks, drift estimation, robust solution, marginals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lslam.backend.graph import factors
from lslam.backend.graph.consistency import judge_loops
from lslam.backend.graph.drift import drift_factor, with_drift
from lslam.backend.graph.pose_prior import pose_prior
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.backend.graph.solve import (
    GncResult,
    OutlierCandidate,
    gnc_solve,
    joined,
    marginal_blocks,
    marginals,
    solve,
    solve_incrementally,
)
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import GraphError
from lslam.core.geometry import noise, se3
from lslam.core.types.arrays import Bools, Floats
from lslam.core.types.constraint import Constraint, LoopStage


def optimise(graph: PoseGraph, config: GraphConfig) -> Solution:
    """Poses and covariances of all keyframes, and which loop closures, fixes and planar priors are inliers.

    Where some are held, everything else is judged from where these put the poses. Loop closures inconsistent with each other
    or with odometry are rejected first; odometry's covariances grow by the drift that the others reveal; then all is solved
    together, with loop closures, fixes and planar priors that are not held as outlier candidates.

    Raises GraphError when the graph is disconnected, singular or not finite.
    """
    check_graph(graph)
    graph = from_held(with_distances(graph), config)
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
    if config.incremental:
        everything = joined(fixed, [item.make(1.0, None) for item in candidates])
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
        for weight, squared, limit in zip(solved.weights, solved.squared, solved.limits, strict=True)
    ]
    for i, rejection in zip(accepted, rejections, strict=False):
        reasons[i] = reasons[i] or rejection
    prior = None
    if config.refine and is_placed:
        known = zip(candidates[len(loops) :], solved.weights[len(loops) :], strict=True)
        inliers = [candidate.make(1.0, None) for candidate, weight in known if weight >= 0.5]
        prior = pose_prior(
            joined(factors.fixed_part(graph, may_tilt, with_lidar=False), inliers), solved.values, len(graph)
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


def from_held(graph: PoseGraph, config: GraphConfig) -> PoseGraph:
    """The graph with its poses where the held loop closures and positions alone put them, and the drift that these reveal.

    What odometry may drift is no measure for the rest once a person has said how far it did.
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


def _map_shift(graph: PoseGraph, solved: GncResult) -> tuple[Floats, Floats]:
    """(2,) m, common shift of the map, and its sigma; zero and infinity without a map."""
    if not graph.map_priors:
        return np.zeros(2), np.full(2, np.inf)
    key = factors.map_key(graph)
    frame = solved.values.atPose3(key).matrix()
    covariance = noise.from_body(marginal_blocks(solved.factors, solved.values, [key]), frame[None])[0]
    return frame[:2, 3], np.sqrt(np.diag(covariance)[:2])


def _upright(graph: PoseGraph, poses: Floats, inliers: list[OutlierCandidate]) -> tuple[Floats, Floats]:
    """The solution with its first pose as before, and its covariances relative to that pose.

    Up in the world is estimated by the solution, so that a wrong initial guess of it bends no trajectory.
    """
    back = graph.poses[0] @ se3.inverse(poses[0])
    poses = se3.normalise(back @ poses)
    turned = replace(graph, world_up=back[:3, :3] @ graph.world_up)
    whole = joined(factors.fixed_part(turned), [item.make(1.0, None) for item in inliers])
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
