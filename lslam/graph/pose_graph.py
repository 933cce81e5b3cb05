"""Optimise the poses of keyframes: the whole recipe."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lslam.config.graph import GraphConfig
from lslam.errors import GraphError
from lslam.geometry import se3
from lslam.graph import factors
from lslam.graph.consistency import judge_loops
from lslam.graph.problem import PoseGraph, Solution
from lslam.graph.robust import Doubted, settle
from lslam.graph.scale import odometry_scale
from lslam.graph.solve import marginals, solve_incrementally

Floats = NDArray[np.float64]


def optimise(graph: PoseGraph, config: GraphConfig) -> Solution:
    """Poses and covariances of all keyframes, and which loops and fixes were believed.

    Loops that contradict each other or odometry go first; odometry's covariances are scaled to what the loops left show;
    then everything is solved together, loops and fixes that still do not fit being given up on the way.

    Raises GraphError when the graph is in pieces, singular or not finite.
    """
    check_graph(graph)
    graph = _with_distances(graph)
    reasons = judge_loops(graph, config) if config.is_pairwise else [""] * len(graph.loops)
    stages = ["consistency" if reason else "graph" for reason in reasons]
    kept = [i for i, reason in enumerate(reasons) if not reason]
    loops = [graph.loops[i] for i in kept]
    scale = odometry_scale(graph, loops)
    fixed = factors.fixed_part(graph, scale)
    doubted = [Doubted(partial(factors.between, loop), 6) for loop in loops]
    doubted += [Doubted(partial(factors.position, fix), 3) for fix in graph.fixes]
    values = factors.start_values(graph, graph.poses)
    if config.incremental:
        everything = factors.fixed_part(graph, scale)
        for item in doubted:
            everything.add(item.make(1.0, None))
        values = solve_incrementally(everything, values, len(graph))
    settled = settle(fixed, doubted, values, config)
    poses = se3.normalise(factors.poses_of(settled.values, len(graph)))
    if not np.isfinite(poses).all():
        raise GraphError("the pose graph cannot be optimised: its poses are not finite")
    for i, weight, squared, limit in zip(kept, settled.weights, settled.squared, settled.limits, strict=False):
        if weight < 0.5:
            reasons[i] = f"{np.sqrt(squared / limit):.1f} times as far as it may be from where all others put it"
    return Solution(
        poses=poses,
        covariances=marginals(settled.factors, settled.values, poses),
        loop_reasons=reasons,
        loop_stages=stages,
        fix_believed=settled.weights[len(loops) :] >= 0.5,
        odometry_scale=scale,
        rounds=settled.rounds,
        error=float(settled.factors.error(settled.values)),
    )


def check_graph(graph: PoseGraph) -> None:
    """Raise GraphError for a graph that has no solution: numbers that are not finite, keyframes that hang on nothing."""
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


def _with_distances(graph: PoseGraph) -> PoseGraph:
    """The graph with the distances travelled along its poses, where nobody filled them in."""
    if len(graph.distances) == len(graph):
        return graph
    steps = np.linalg.norm(np.diff(graph.poses[:, :3, 3], axis=0), axis=1)
    return replace(graph, distances=np.concatenate([[0.0], np.cumsum(steps)]))
