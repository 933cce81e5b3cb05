"""From odometry to a consistent trajectory: loops, satellite fixes, gravity and floor, made one in a pose graph.

Where nothing but odometry is known, or an IMU finds no tilt in it beyond its own doubt, or the graph cannot be solved,
odometry's poses stay as they are, byte for byte.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.graph.drift import tilt_factor
from lslam.graph.floors import on_one_plane
from lslam.graph.odometry import fitness_covariance, odometry_constraints
from lslam.graph.problem import PoseGraph
from lslam.keyframes.store import KeyframeStore
from lslam.pipeline.georeferencing import Placement, on_earth, place
from lslam.pipeline.graph_inputs import floor_planes, up_directions, world_up
from lslam.pipeline.graph_outcome import BackEnd, Given, solve, unsolved
from lslam.pipeline.osm_back_end import hold_by_buildings
from lslam.pipeline.osm_source import OsmSource
from lslam.types.constraint import LoopCandidate, Turn
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")
Floats = NDArray[np.float64]


def run_back_end(
    sequence: Sequence, results: list[ScanResult], store: KeyframeStore, config: Config,
    candidates: list[LoopCandidate], turns: Many[Turn] = (), osm: OsmSource | None = None,
) -> BackEnd:  # fmt: skip
    """Close loops, take in fixes and buildings, optimise, and place all scans accordingly; odometry's poses where that fails."""
    keyframes = store.keyframes
    given = Given(results, store, config, candidates)
    problems = given.problems
    if len(keyframes) < 2:
        if config.gnss.mode != "off":
            problems.append("GNSS: fewer than two keyframes have no heading on the Earth")
        return BackEnd(results, candidates, problems=problems)
    graph = replace(_graph(given), turns=turns)
    up = graph.world_up if graph.ups else None
    out, placement = None, Placement()
    if config.gnss.mode == "graph" or (config.gnss.mode == "fit" and osm is not None and config.osm.origin is None):
        placement = place(sequence, results, keyframes, up, config.gnss, config.graph)
        problems += [placement.problem] if placement.problem else []
    if osm is not None:
        out = hold_by_buildings(osm, graph, placement, given)
    if out is None and config.gnss.mode == "graph" and placement.georeference is not None:
        out = solve(on_earth(graph, placement), given, placement.georeference)
    if out is None and (graph.loops or graph.floors or tilt_factor(graph, config.graph) > 0):
        out = solve(graph, given)
    if out is None:
        out = unsolved(given)
    if config.gnss.mode == "fit" and out.georeference is None:
        turned = None if up is None else _up_after(out, graph)
        placement = place(sequence, out.results, keyframes, turned, config.gnss, config.graph)
        problems += [placement.problem] if placement.problem and placement.problem not in problems else []
        out = replace(out, georeference=placement.georeference)
    for problem in problems:
        log.warning("%s", problem)
    return replace(out, problems=problems, facts={"keyframes": len(keyframes)} | out.facts)


def _up_after(out: BackEnd, graph: PoseGraph) -> Floats:
    """(3,) up in the world of the optimised poses, by what the keyframes saw of it."""
    turned = sum(out.keyframes[u.keyframe, :3, :3] @ u.up * u.share / u.sigma**2 for u in graph.ups)
    return np.asarray(turned / np.linalg.norm(turned))


def _graph(given: Given) -> PoseGraph:
    store, config, results, candidates = given.store, given.config, given.results, given.candidates
    loops = [c.constraint for c in candidates if c.verdict == "accepted" and c.constraint is not None]
    if config.graph.information == "fitness":
        rmse = {(c.a, c.b): c.rmse for c in candidates}
        loops = [replace(loop, covariance=fitness_covariance(rmse[loop.a, loop.b], config.graph)) for loop in loops]
    ups = up_directions(store.keyframes, results, config.graph) if config.graph.gravity else []
    up = world_up(ups, store.keyframes)
    poses = np.stack([k.T_world_lidar for k in store.keyframes])
    distances = np.array([k.distance for k in store.keyframes])
    seen = floor_planes(store, config.graph) if config.graph.floor else []
    floors = on_one_plane(seen, poses, distances, config.graph)
    if seen and not floors:
        given.problems.append(
            f"floor: the ground seen from {len(seen)} keyframes is not one plane: it holds no pose "
            "(graph.floor = false looks for none)"
        )
    return PoseGraph(
        poses=poses,
        odometry=odometry_constraints(store.keyframes, results, config.graph),
        loops=loops,
        floors=floors,
        distances=distances,
        ups=ups,
        world_up=np.array([0.0, 0.0, 1.0]) if up is None else up,
    )
