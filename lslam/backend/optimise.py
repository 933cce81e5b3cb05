"""From odometry to a consistent trajectory: loop closures, GNSS fixes, gravity and floor in one pose graph.

Odometry's poses stay as they are, byte for byte, where the graph has no other constraint (gravity counts where it is
significant) or cannot be solved.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lslam.backend.control_points import (
    against_odometry,
    as_surveyed_and_seen,
    contradicting,
    control_facts,
    control_residuals,
    with_control,
)
from lslam.backend.final_checks import fixes_against_points, redundancy, thickening, thicker_map
from lslam.backend.georeferencing import Placement, final_fixes, on_earth, place
from lslam.backend.graph.consistency import Drift, drift_of
from lslam.backend.graph.drift import tilt_factor
from lslam.backend.graph.odometry_constraints import (
    IDENTITY,
    bent,
    fitness_covariance,
    fitness_score,
    odometry_constraints,
)
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PoseGraph
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.levelling import floor_planes, on_one_plane, up_directions, world_up
from lslam.backend.outcome import BackEnd, Given, solve, unsolved, without_steady_drift
from lslam.core.config import Config
from lslam.core.errors import GraphError
from lslam.core.geometry import se3
from lslam.core.geometry.noise import RIGHT_PROBABILITY
from lslam.core.stopping import checking
from lslam.core.types.arrays import Floats
from lslam.core.types.constraint import ControlPoint, LoopCandidate, Turn
from lslam.core.types.gnss import Georeference
from lslam.core.types.imu import InertialChain
from lslam.core.types.scan_result import KeyframeClocks, ScanResult
from lslam.core.types.sequence import Sequence
from lslam.registration.preprocessing.ground import up_of, world_up_of

log = logging.getLogger("lslam")
# Solves the graph with the priors of a map, given its georeference; None where the map gives none.
Hold = Callable[[PoseGraph, Placement, Given], BackEnd | None]


def run_back_end(
    sequence: Sequence,
    results: list[ScanResult],
    store: KeyframeStore,
    config: Config,
    candidates: list[LoopCandidate],
    turns: Many[Turn] = (),
    hold: Hold | None = None,
    clocks: KeyframeClocks | None = None,
    inertial: InertialChain | None = None,
    points: Many[ControlPoint] = (),
) -> BackEnd:
    """Optimise the pose graph with loop closures, fixes and map priors, and correct all scans; odometry's poses on failure.

    points : control points, which hold
    """
    keyframes = store.keyframes
    clocks = KeyframeClocks() if clocks is None else clocks
    given = Given(results, store, config, candidates, clocks, points=tuple(points))
    problems = given.problems
    if len(keyframes) < 2:
        if config.gnss.mode != "off" or points:
            what = "control points" if points else "GNSS"
            problems.append(f"{what}: fewer than two keyframes have no heading on the Earth")
        return BackEnd(results, candidates, problems=problems)
    graph = replace(_graph(given, inertial), turns=turns)
    drift = drift_of(graph, config.graph)
    out = None
    if hold is not None:
        out = hold(
            graph, _placed(sequence, graph, given, ("graph", "fit") if config.osm.origin is None else ("graph",)), given
        )
    if out is None:
        # Loop closures observe a steady drift far better than fixes, whose gates assume odometry without it.
        graph = without_steady_drift(graph, given)
        placement = _placed(sequence, graph, given)
        if placement.georeference is not None:
            out = solve(on_earth(graph, placement), given, placement.georeference)
    if out is None and (graph.loops or graph.floors or tilt_factor(graph, config.graph) > 0):
        out = solve(graph, given)
    if out is None:
        out = unsolved(given)
    if config.gnss.mode == "fit" and out.georeference is None:
        moved = replace(graph, poses=out.keyframes)
        out = replace(out, georeference=_by_fixes(sequence, moved, given, out.results).georeference)
    if points and out.georeference is not None:
        out = _with_residuals(out, out.georeference, sequence, drift, given, is_level=bool(graph.ups))
    out = _compared_with_map(out, graph, given)
    problems[:] = [problem for problem in problems if problem]
    for problem in problems:
        log.warning("%s", problem)
    return replace(out, problems=problems, facts={"keyframes": len(keyframes)} | out.facts | given.facts)


def _with_residuals(
    out: BackEnd, georeference: Georeference, sequence: Sequence, drift: Drift, given: Given, is_level: bool
) -> BackEnd:
    """The outcome with what is left of the control points; what contradicts them is one of the problems."""
    config, points, results = given.config, given.points, given.results
    geoid = config.gnss.geoid
    residuals = control_residuals(points, out.results, georeference, geoid)
    given.problems.extend(against_odometry(points, results, given.store.keyframes, drift, RIGHT_PROBABILITY, geoid))
    given.problems.extend(contradicting(residuals, RIGHT_PROBABILITY))
    single, facts = redundancy(*as_surveyed_and_seen(points, results, geoid), is_level)
    if single and config.gnss.mode == "off":
        log.warning("%s", single)
    if sequence.gnss is not None and len(sequence.gnss):
        fixes = final_fixes(sequence, out.results, config)
        given.problems.append("" if fixes is None else fixes_against_points(fixes, points, georeference))
    return replace(out, control=residuals, facts=out.facts | {"control_points": control_facts(residuals) | facts})


def _compared_with_map(out: BackEnd, graph: PoseGraph, given: Given) -> BackEnd:
    """The outcome, its thickness of planes beside that without fixes and control points, where such hold the poses."""
    config, place = given.config, out.georeference
    if place is None or place.method not in ("graph", "control") or out.solution is None:
        return out
    without, loops = graph.poses, [c for c in out.candidates if c.is_accepted and c.constraint is not None]
    if loops and given.points:
        try:
            without = optimise(graph, config.graph).poses
        except (GraphError, np.linalg.LinAlgError) as error:
            log.debug("the graph without control points: %s", error)
            return out
    held_by = "control points" if given.points else "GNSS"
    text, facts = thicker_map(thickening(given.store, without, out.keyframes), held_by, RIGHT_PROBABILITY)
    if text and len(given.points) > 2:
        text += _without_one(graph, without, given)
    given.problems.append(text)
    return replace(out, facts=out.facts | facts)


def _without_one(graph: PoseGraph, without: Floats, given: Given) -> str:
    """The end of the sentence about control points that contradict the scans: those without which the others do not."""
    config, points, keyframes = given.config, given.points, given.store.keyframes
    results = bent(given.results, keyframes, graph.poses)
    names = []
    for i in checking(range(len(points))):
        others = [*points[:i], *points[i + 1 :]]
        placement = with_control(Placement(), others, results, keyframes, _up(graph), config)
        if placement.georeference is None:
            continue
        try:
            change = thickening(given.store, without, optimise(on_earth(graph, placement), config.graph).poses)
        except (GraphError, np.linalg.LinAlgError) as error:
            log.debug("the graph without a control point: %s", error)
            continue
        if change is not None and not change.is_clear(RIGHT_PROBABILITY):
            names.append(points[i].at.source)
    if not names:
        return "; no single one of them is why"
    return f"; without {' or without '.join(names)} the others do not: are scan, sigma and CRS right?"


def _placed(sequence: Sequence, graph: PoseGraph, given: Given, modes: tuple[str, ...] = ("graph",)) -> Placement:
    """By fixes, when they are used in one of the `modes`, and by control points; empty without both."""
    placement = _by_fixes(sequence, graph, given) if given.config.gnss.mode in modes else Placement()
    if not given.points:
        return placement
    is_fitted = placement.georeference is not None and not placement.georeference.is_in_graph
    results = bent(given.results, given.store.keyframes, graph.poses)
    placed = with_control(
        Placement() if is_fitted else placement, given.points, results, given.store.keyframes, _up(graph), given.config
    )
    return _said(placed, given)


def _said(placement: Placement, given: Given) -> Placement:
    """The placement; its problems are those of the run."""
    texts = (*placement.faults.problems, placement.problem)
    given.problems.extend(problem for problem in texts if problem and problem not in given.problems)
    given.facts.update(placement.faults.facts or {})
    return placement


def _by_fixes(sequence: Sequence, graph: PoseGraph, given: Given, results: list[ScanResult] | None = None) -> Placement:
    """Placement of the graph's poses by the fixes of a run.

    results : all scans at those poses; None for odometry's scans moved with the keyframes
    """
    keyframes, config = given.store.keyframes, given.config
    up = _up(graph)
    if results is None and graph.estimated_drift is None:
        # Odometry's tilt drifts: the first measurements of up are the best.
        results, up = given.results, None if up is None else graph.world_up
    elif results is None:
        results = bent(given.results, keyframes, graph.poses)
    return _said(place(sequence, results, keyframes, up, graph, config), given)


def _up(graph: PoseGraph) -> Floats | None:
    """(3,) up in the world of the graph's poses, by the up directions of the keyframes; None without any."""
    if not graph.ups:
        return None
    turned = sum(graph.poses[u.keyframe, :3, :3] @ u.up * u.share / u.sigma**2 for u in graph.ups)
    return np.asarray(turned / np.linalg.norm(turned))


def _fitness(store: KeyframeStore, a: int, b: int, T_a_b: Floats) -> float:
    """Fitness score, m2, of keyframe `b` on keyframe `a`."""
    return fitness_score(store.points(b), store.points(a), T_a_b)


def _graph(given: Given, inertial: InertialChain | None) -> PoseGraph:
    store, config, results, candidates = given.store, given.config, given.results, given.candidates
    loops = [c.constraint for c in candidates if c.is_accepted and c.constraint is not None]
    fitness = None
    if config.graph.information == "identity":
        loops = [replace(loop, covariance=IDENTITY) for loop in loops]
    if config.graph.information == "fitness":
        loops = [
            replace(loop, covariance=fitness_covariance(_fitness(store, loop.a, loop.b, loop.T_a_b), config.graph))
            for loop in checking(loops)
        ]
        known = [k.T_world_lidar for k in store.keyframes]
        steps = [se3.relative(a, b) for a, b in pairwise(known)]
        fitness = [_fitness(store, k, k + 1, T) for k, T in enumerate(checking(steps))]
    ups = up_directions(store.keyframes, results, config.graph) if config.graph.gravity else []
    up = world_up(ups, store.keyframes)
    poses = np.stack([k.T_world_lidar for k in store.keyframes])
    distances = np.array([k.distance for k in store.keyframes])
    horizon = world_up_of(config.preprocess, store.keyframes[0].T_world_lidar)
    seen = floor_planes(store, config.graph, up_of(config.preprocess), horizon) if config.graph.floor else []
    floors = on_one_plane(seen, poses, distances, config.graph) if config.graph.floor_is_flat else seen
    if seen and not floors:
        given.problems.append(
            f"floor: the ground seen from {len(seen)} keyframes is not one plane: it holds no pose "
            "(graph.floor = false looks for none)"
        )
    # Odometry that a smoother estimated knows of the IMU: beside its factors it weighs as much as its points.
    by_points = results if inertial is None else [result.by_points for result in results]
    return PoseGraph(
        poses=poses,
        odometry=odometry_constraints(store.keyframes, by_points, config.graph, fitness),
        loops=loops,
        floors=floors,
        distances=distances,
        ups=ups,
        inertial=inertial,
        world_up=horizon if up is None else up,
    )
