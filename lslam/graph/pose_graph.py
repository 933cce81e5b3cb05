"""Optimise the poses of keyframes: the whole recipe."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.errors import GraphError
from lslam.geometry import noise, se3
from lslam.graph import factors
from lslam.graph.consistency import judge_loops
from lslam.graph.drift import drift_factor, with_drift
from lslam.graph.gnc import Doubted, Settled, joined, settle
from lslam.graph.problem import PoseGraph, Solution
from lslam.graph.solve import marginal_blocks, marginals, solve_incrementally
from lslam.types.constraint import LoopStage

Floats = NDArray[np.float64]


def optimise(graph: PoseGraph, config: GraphConfig) -> Solution:
    """Poses and covariances of all keyframes, and which loops, fixes and planar priors were believed.

    Loops that contradict each other or odometry go first; odometry's covariances grow by the drift that the loops left show;
    then everything is solved together, loops, fixes and planar priors that still do not fit being given up on the way.

    Raises GraphError when the graph is in pieces, singular or not finite.
    """
    check_graph(graph)
    graph = with_distances(graph)
    reasons = judge_loops(graph, config) if config.is_pairwise else [""] * len(graph.loops)
    stages = [LoopStage.CONSISTENCY if reason else LoopStage.GRAPH for reason in reasons]
    kept = [i for i, reason in enumerate(reasons) if not reason]
    loops = [graph.loops[i] for i in kept]
    drift = 0.0 if graph.is_rigid else max(drift_factor(graph, loops, config), graph.walk)
    graph = replace(graph, odometry=with_drift(graph, drift, config))
    may_tilt = graph.is_anchored and len(graph.ups) > 0
    is_placed = graph.start_sigma is not None or not graph.is_anchored
    fixed = factors.fixed_part(graph, may_tilt)
    doubted = [Doubted(partial(factors.between, loop), 6) for loop in loops]
    doubted += [Doubted(partial(factors.position, fix), 3) for fix in graph.fixes]
    key = factors.map_key(graph)
    doubted += [
        Doubted(partial(factors.planar, prior, graph.poses[prior.keyframe], key), prior.rank)
        for prior in graph.map_priors
    ]
    values = factors.start_values(graph, graph.poses)
    if config.incremental:
        everything = joined(fixed, [item.make(1.0, None) for item in doubted])
        values = solve_incrementally(everything, values, len(graph))
    settled = settle(fixed, doubted, values, config)
    poses = se3.normalise(factors.poses_of(settled.values, len(graph)))
    if not np.isfinite(poses).all():
        raise GraphError("the pose graph cannot be optimised: its poses are not finite")
    if may_tilt and not is_placed:
        poses, covariances = _upright(
            graph, poses, [d for d, w in zip(doubted, settled.weights, strict=True) if w >= 0.5]
        )
    else:
        covariances = marginals(settled.factors, settled.values, poses)
    covariances = covariances if graph.spread is None else covariances + graph.spread
    doubts = [
        ""
        if weight >= 0.5
        else f"{np.sqrt(squared / limit):.1f} times as far as it may be from where all others put it"
        for weight, squared, limit in zip(settled.weights, settled.squared, settled.limits, strict=True)
    ]
    for i, doubt in zip(kept, doubts, strict=False):
        reasons[i] = reasons[i] or doubt
    rest = len(loops) + len(graph.fixes)
    shift, shift_sigma = _map_shift(graph, settled)
    return Solution(
        poses=poses,
        covariances=covariances,
        loop_reasons=reasons,
        loop_stages=stages,
        fix_believed=settled.weights[len(loops) : rest] >= 0.5,
        map_reasons=doubts[rest:],
        shift=shift,
        shift_sigma=shift_sigma,
        drift=drift,
        rounds=settled.rounds,
        error=float(settled.factors.error(settled.values)),
    )


def _map_shift(graph: PoseGraph, settled: Settled) -> tuple[Floats, Floats]:
    """(2,) m by which the map is off as a whole, and its sigma; zero and infinity without a map."""
    if not graph.map_priors:
        return np.zeros(2), np.full(2, np.inf)
    key = factors.map_key(graph)
    frame = settled.values.atPose3(key).matrix()
    covariance = noise.from_body(marginal_blocks(settled.factors, settled.values, [key]), frame[None])[0]
    return frame[:2, 3], np.sqrt(np.diag(covariance)[:2])


def _upright(graph: PoseGraph, poses: Floats, believed: list[Doubted]) -> tuple[Floats, Floats]:
    """The solution with its first pose where it was, and its covariances as seen from there.

    Which way is up in the world came out of the solution: gravity bends no trajectory to a first guess of it.
    """
    back = graph.poses[0] @ se3.inverse(poses[0])
    poses = se3.normalise(back @ poses)
    turned = replace(graph, world_up=back[:3, :3] @ graph.world_up)
    whole = joined(factors.fixed_part(turned), [item.make(1.0, None) for item in believed])
    return poses, marginals(whole, factors.start_values(turned, poses), poses)


def check_graph(graph: PoseGraph) -> None:
    """Raise GraphError for a graph that has no solution: numbers that are not finite, keyframes that hang on nothing."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(graph)
    if not count or not np.isfinite(graph.poses).all():
        raise GraphError("the pose graph has no keyframes" if not count else "a keyframe's pose is not finite")
    constraints = [*graph.odometry, *graph.loops]
    for c in constraints:
        if not (0 <= c.a < count and 0 <= c.b < count) or c.a == c.b:
            raise GraphError(f"a constraint joins keyframes {c.a} and {c.b}; there are {count}")
        if not (np.isfinite(c.T_a_b).all() and np.isfinite(c.covariance).all()):
            raise GraphError(f"the constraint between keyframes {c.a} and {c.b} is not finite")
    ends = np.array([(c.a, c.b) for c in graph.odometry], np.intp).reshape(-1, 2).T
    links = coo_matrix((np.ones(ends.shape[1]), (ends[0], ends[1])), (count, count))
    _, label = connected_components(links, directed=False)
    if (label != label[0]).any():
        lost = int(np.argmax(label != label[0]))
        raise GraphError(f"the pose graph is in pieces: odometry does not join keyframe {lost} to the first")


def with_distances(graph: PoseGraph) -> PoseGraph:
    """The graph with the distances travelled along its poses, where nobody filled them in."""
    if len(graph.distances) == len(graph):
        return graph
    steps = np.linalg.norm(np.diff(graph.poses[:, :3, 3], axis=0), axis=1)
    return replace(graph, distances=np.concatenate([[0.0], np.cumsum(steps)]))
