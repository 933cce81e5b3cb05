"""From odometry to a consistent trajectory: loops, satellite fixes, gravity and floor, made one in a pose graph.

Where nothing but odometry is known, or an IMU finds no tilt in it beyond its own doubt, or the graph cannot be solved,
odometry's poses stay as they are, byte for byte.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.errors import GraphError, InputError
from lslam.geometry import se2, se3
from lslam.graph.drift import tilt_factor
from lslam.graph.factors import well_conditioned
from lslam.graph.floors import on_one_plane
from lslam.graph.odometry import corrected, fitness_covariance, odometry_constraints
from lslam.graph.pose_graph import optimise
from lslam.graph.problem import PoseGraph, Solution
from lslam.keyframes.store import KeyframeStore
from lslam.pipeline.building_pass import correct_buildings
from lslam.pipeline.georeferencing import Placement, place
from lslam.pipeline.graph_inputs import floor_planes, up_directions, world_up
from lslam.pipeline.osm_graph import on_map, straightened
from lslam.pipeline.osm_joint import join_buildings, run_baseline
from lslam.pipeline.osm_pass import finish, locate
from lslam.pipeline.osm_source import OsmSource
from lslam.types.building_correction import CorrectedMap
from lslam.types.building_match import OsmMatches
from lslam.types.constraint import Constraint, LoopCandidate, Turn
from lslam.types.georeference import Georeference
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BackEnd:
    """What became of a run's odometry.

    results : all scans, where they belong; candidates : all loop candidates with verdicts
    keyframes : (K, 4, 4) final poses; constraints : odometry's and the loops that were believed, empty without a graph
    georeference : where the world of `results` lies on the Earth, None when that is not known
    T_final_odometry : (4, 4) from the world of odometry into that of `results`
    solution : the graph's, None where the poses are not its own
    osm : what walls and buildings had to do with each other, None without a map that could be used; buildings : of that map,
        where they really stand
    facts : for the manifest; problems : what could not be done, one sentence each
    """

    results: list[ScanResult]
    candidates: list[LoopCandidate] = field(default_factory=list)
    keyframes: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))
    constraints: list[Constraint] = field(default_factory=list)
    georeference: Georeference | None = None
    T_final_odometry: Floats = field(default_factory=lambda: np.eye(4))
    solution: Solution | None = None
    osm: OsmMatches | None = None
    buildings: CorrectedMap | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def is_optimised(self) -> bool:
        """Whether the poses are the graph's and not odometry's."""
        return bool(self.constraints)


def run_back_end(
    sequence: Sequence, results: list[ScanResult], store: KeyframeStore, config: Config,
    candidates: list[LoopCandidate], turns: Many[Turn] = (), osm: OsmSource | None = None,
) -> BackEnd:  # fmt: skip
    """Close loops, take in fixes and buildings, optimise, and place all scans accordingly; odometry's poses where that fails."""
    keyframes = store.keyframes
    problems: list[str] = []
    if len(keyframes) < 2:
        if config.gnss.mode != "off":
            problems.append("GNSS: fewer than two keyframes have no heading on the Earth")
        return BackEnd(results, candidates, problems=problems)
    graph = replace(_graph(results, store, config, candidates, problems), turns=turns)
    up = graph.world_up if graph.ups else None
    out, placement = None, Placement()
    if config.gnss.mode == "graph" or (config.gnss.mode == "fit" and osm is not None and config.osm.origin is None):
        placement = place(sequence, results, keyframes, up, config.gnss, config.graph)
        problems += [placement.problem] if placement.problem else []
    if osm is not None:
        out = _on_buildings(osm, graph, placement, candidates, results, store, config, problems)
    if out is None and config.gnss.mode == "graph" and placement.georeference is not None:
        out = _solved(_on_earth(graph, placement), candidates, results, store, config, problems, placement.georeference)
    if out is None and (graph.loops or graph.floors or tilt_factor(graph, config.graph) > 0):
        out = _solved(graph, candidates, results, store, config, problems, None)
    if out is None:
        out = BackEnd(results, candidates, np.stack([k.T_world_lidar for k in keyframes]))
    if config.gnss.mode == "fit" and out.georeference is None:
        turned = None if up is None else _up_after(out, graph)
        placement = place(sequence, out.results, keyframes, turned, config.gnss, config.graph)
        problems += [placement.problem] if placement.problem and placement.problem not in problems else []
        out = replace(out, georeference=placement.georeference)
    for problem in problems:
        log.warning("%s", problem)
    return replace(out, problems=problems, facts={"keyframes": len(keyframes)} | out.facts)


def _on_buildings(
    osm: OsmSource, graph: PoseGraph, placement: Placement, candidates: list[LoopCandidate], results: list[ScanResult],
    store: KeyframeStore, config: Config, problems: list[str],
) -> BackEnd | None:  # fmt: skip
    """The run held by the buildings of a map, and by fixes where it has some; None, and why, where they hold nothing."""
    known = placement.georeference
    origin = known.origin if known is not None else config.osm.origin
    if origin is None:
        problems.append("OSM: without its fixes the run has no place on the map: it goes on without the buildings")
        return None
    try:
        extract = osm.extract(np.asarray(origin, np.float64))
    except InputError as error:
        problems.append(f"OSM: {error}; the run goes on without the buildings")
        return None
    up = graph.world_up if graph.ups else None
    located = locate(extract, store, up, config, None if known is None else known.T_enu_world)
    if located.problem:
        problems.append(located.problem)
        return None
    if config.gnss.mode == "graph" and known is not None:
        graph, georeference = _on_earth(graph, placement), known
    else:
        georeference = Georeference(
            extract.origin, located.T_enu_odometry, config.gnss.crs, "osm", used=len(located.priors)
        )
    held = on_map(graph, located, config)
    if config.osm.matcher == "walls" and not held.is_rigid:
        held = straightened(held, located, config)
    out = _solved(held, candidates, results, store, config, problems, georeference)
    if out is None or out.solution is None:
        return None
    matches = finish(located, extract, out.keyframes, out.solution, config.osm)
    try:
        if config.osm.matcher == "baseline":
            joint, matches, buildings = run_baseline(held, out.solution, extract, store, config)
        elif config.osm.mode == "non-rigid":
            joint, buildings = join_buildings(held, out.solution, matches, config)
        else:
            return replace(
                out, osm=matches, buildings=correct_buildings(matches, se2.of_se3(out.keyframes), config.osm)
            )
    except (GraphError, np.linalg.LinAlgError) as error:
        problems.append(f"OSM: {error}; the run goes on with its buildings where the map has them")
        return replace(out, osm=matches)
    moved = corrected(results, store.keyframes, joint.poses, joint.covariances, out.solution.drift, config.graph)
    return replace(out, results=moved, keyframes=joint.poses, osm=matches, buildings=buildings)


def _solved(
    graph: PoseGraph, candidates: list[LoopCandidate], results: list[ScanResult], store: KeyframeStore, config: Config,
    problems: list[str], georeference: Georeference | None,
) -> BackEnd | None:  # fmt: skip
    """The run as the optimised graph has it; None, and one more of `problems`, when it cannot be had."""
    try:
        solution = optimise(graph, config.graph)
    except (GraphError, np.linalg.LinAlgError) as error:
        problems.append(f"{error}; the run goes on without it")
        return None
    if graph.fixes and solution.fix_believed.sum() < config.gnss.min_fixes:
        problems.append(
            f"GNSS: the pose graph believes {solution.fix_believed.sum()} of {len(graph.fixes)} fixes: all rejected"
        )
        return None
    judged, believed = _verdicts(candidates, graph, solution)
    log.info(
        "pose graph: %d keyframes, %d of %d loops believed, drift beside odometry's covariances %.3g, %d rounds",
        len(graph), len(believed), len(graph.loops), solution.drift, solution.rounds,
    )  # fmt: skip
    facts = _facts(solution, graph, candidates, believed)
    tilts = not believed and tilt_factor(graph, config.graph) > 0
    if not (believed or graph.fixes or graph.floors or graph.map_priors or tilts):
        return BackEnd(results, judged, graph.poses, facts=facts)
    T = np.eye(4)
    if georeference is not None:
        T = georeference.T_enu_world
        georeference = replace(_scored(georeference, graph, solution), T_enu_world=np.eye(4))
    moved = corrected(results, store.keyframes, solution.poses, solution.covariances, solution.drift, config.graph)
    # As they were solved: the covariance of odometry may be singular, and no information can be written of that.
    kept = [replace(c, covariance=well_conditioned(c.covariance)) for c in (*graph.odometry, *believed)]
    return BackEnd(moved, judged, solution.poses, kept, georeference, T, solution=solution, facts=facts)


def _up_after(out: BackEnd, graph: PoseGraph) -> Floats:
    """(3,) up in the world of the optimised poses, by what the keyframes saw of it."""
    turned = sum(out.keyframes[u.keyframe, :3, :3] @ u.up * u.share / u.sigma**2 for u in graph.ups)
    return np.asarray(turned / np.linalg.norm(turned))


def _graph(
    results: list[ScanResult],
    store: KeyframeStore,
    config: Config,
    candidates: list[LoopCandidate],
    problems: list[str],
) -> PoseGraph:
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
        problems.append(
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


def _on_earth(graph: PoseGraph, placement: Placement) -> PoseGraph:
    """The graph in east, north, up, held by its fixes instead of its first pose."""
    assert placement.georeference is not None
    T = placement.georeference.T_enu_world
    return replace(
        graph, poses=T @ graph.poses, fixes=placement.fixes, world_up=np.array([0.0, 0.0, 1.0]), is_anchored=False
    )


def _verdicts(
    candidates: list[LoopCandidate], graph: PoseGraph, solution: Solution
) -> tuple[list[LoopCandidate], list[Constraint]]:
    """Candidates with the graph's verdicts on the accepted ones, and the constraints it believed."""
    judged = iter(zip(graph.loops, solution.loop_reasons, solution.loop_stages, strict=True))
    out, believed = [], []
    for candidate in candidates:
        if candidate.verdict == "accepted" and candidate.constraint is not None:
            loop, reason, stage = next(judged)
            if reason:
                candidate = replace(candidate, verdict="rejected", stage=stage, reason=reason)
            else:
                believed.append(loop)
        out.append(candidate)
    return out, believed


def _scored(georeference: Georeference, graph: PoseGraph, solution: Solution) -> Georeference:
    """The georeference with the residuals of the fixes that the graph believed; as it is without fixes."""
    if not graph.fixes:
        return georeference
    k = np.array([f.keyframe for f in graph.fixes])
    arms, positions = np.stack([f.arm for f in graph.fixes]), np.stack([f.position for f in graph.fixes])
    antenna = np.einsum("fij,fj->fi", solution.poses[k, :3, :3], arms) + solution.poses[k, :3, 3]
    off = (positions - antenna)[solution.fix_believed]
    return replace(
        georeference,
        rmse_horizontal=float(np.sqrt((off[:, :2] ** 2).sum(1).mean())),
        rmse_vertical=float(np.sqrt((off[:, 2] ** 2).mean())),
        used=int(solution.fix_believed.sum()),
    )


def _facts(
    solution: Solution, graph: PoseGraph, candidates: list[LoopCandidate], believed: list[Constraint]
) -> dict[str, Any]:
    moved = se3.relative(graph.poses, solution.poses)[:, :3, 3]
    return {
        "loop_candidates": len(candidates),
        "loops": len(believed),
        "fixes": int(solution.fix_believed.sum()),
        "gravity_factors": len(graph.ups),
        "imu_orientation_factors": len(graph.turns),
        "floor_factors": len(graph.floors),
        "map_priors": sum(not reason for reason in solution.map_reasons),
        "drift_factor": round(solution.drift, 4),
        "rounds": solution.rounds,
        "largest_correction_m": round(float(np.linalg.norm(moved, axis=1).max()), 4),
    }
