"""What is held, before everything else: where it puts the keyframes, and what of it odometry contradicts."""

from __future__ import annotations

import logging
from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np

from lslam.backend.control_points import with_control
from lslam.backend.georeferencing import Placement, on_earth
from lslam.config import Config
from lslam.errors import GraphError
from lslam.geometry import noise
from lslam.graph.consistency import judge_loops
from lslam.graph.odometry_constraints import odometry_constraints
from lslam.graph.pose_graph import from_held
from lslam.graph.problem import PoseGraph
from lslam.types.constraint import Constraint, ControlPoint, KnownPair, LoopCandidate
from lslam.types.scan_result import ScanResult
from lslam.types.trajectory import Keyframe

log = logging.getLogger("lslam")


def where_held(
    keyframes: list[Keyframe], known: list[LoopCandidate], points: Many[ControlPoint], results: list[ScanResult],
    config: Config,
) -> list[Keyframe]:  # fmt: skip
    """The keyframes where odometry, known pairs and control points put them: further loop closures are searched from there."""
    loops = [c.constraint for c in known if c.is_accepted and c.constraint is not None]
    if len(keyframes) < 2 or not (loops or points):
        return keyframes
    graph, R = _graph_of(keyframes, loops, results, config), np.eye(3)
    if points:
        placement = with_control(Placement(), points, results, keyframes, None, config)
        if placement.georeference is not None:
            graph, R = on_earth(graph, placement), placement.georeference.T_enu_world[:3, :3]
    try:
        poses = from_held(graph, config.graph).poses
    except (GraphError, np.linalg.LinAlgError) as error:
        log.debug("known pairs and control points alone: %s", error)  # said where all of it is solved
        return keyframes
    return [
        replace(k, T_world_lidar=T, covariance=None if k.covariance is None else noise.rotated(k.covariance, R))
        for k, T in zip(keyframes, poses, strict=True)
    ]


def doubts(
    keyframes: list[Keyframe], known: list[LoopCandidate], pairs: Many[KnownPair], results: list[ScanResult],
    config: Config,
) -> list[str]:  # fmt: skip
    """A sentence for each known pair that does not register, and for each that odometry contradicts, which holds all the same."""
    said = [
        f"{pair.said}: the scans of the known pair do not close a loop: {candidate.reason}"
        for pair, candidate in zip(pairs, known, strict=True)
        if not candidate.is_accepted
    ]
    held = [(p, c.constraint) for p, c in zip(pairs, known, strict=True) if c.is_accepted and c.constraint is not None]
    if held:
        graph = _graph_of(keyframes, [constraint for _, constraint in held], results, config)
        reasons = judge_loops(graph, config.graph)
        said += [
            f"{pair.said}: the known pair holds, though {reason}"
            for (pair, _), reason in zip(held, reasons, strict=True)
            if reason
        ]
    return said


def _graph_of(
    keyframes: list[Keyframe], loops: list[Constraint], results: list[ScanResult], config: Config
) -> PoseGraph:
    return PoseGraph(
        poses=np.stack([k.T_world_lidar for k in keyframes]),
        odometry=odometry_constraints(keyframes, results, config.graph, None),
        loops=loops,
        distances=np.array([k.distance for k in keyframes]),
    )
