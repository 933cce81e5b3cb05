"""Del Tufo's baseline: buildings and trajectory move each other, keyframe by keyframe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.outcome import Given
from lslam.config import Config
from lslam.formats.osm_buildings import BuildingExtract
from lslam.geometry import se2, se3
from lslam.graph.drift import with_drift
from lslam.graph.factors import PLANAR
from lslam.graph.joint import JointSolution, optimise_jointly
from lslam.graph.odometry_constraints import fitness_covariance
from lslam.graph.problem import PoseGraph, Solution
from lslam.keyframes.store import KeyframeStore
from lslam.osm.baseline import flatten_scan, lay_building, lay_scan
from lslam.osm.corrections import place_buildings
from lslam.osm.join_buildings import accepted_part
from lslam.osm.matcher import Laid
from lslam.osm.wall_map import OsmMap
from lslam.stopping import checking
from lslam.types.building import BuildingMatch, CorrectedMap, KeyframeMatch, OsmMatches
from lslam.types.stage_clock import KeyframeClocks, StageClock

Floats = NDArray[np.float64]

# Keyframes after which the baseline's graph is optimised again; Del Tufo's timer does so every 3 s.
EVERY = 5
ONLY_START = "the baseline lays buildings from there and holds no keyframe by it"


def lay(graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, given: Given) -> Laid:
    """As `matcher.Lay`; the matches of walls are not asked."""
    joint, matches, buildings = run_baseline(graph, solution, extract, given.store, given.config, given.clocks)
    return Laid(matches, buildings, joint)


def run_baseline(
    graph: PoseGraph, solution: Solution, extract: BuildingExtract, store: KeyframeStore, config: Config,
    clocks: KeyframeClocks,
) -> tuple[JointSolution, OsmMatches, CorrectedMap]:  # fmt: skip
    """The baseline, keyframe by keyframe: NDT on all buildings near, VGICP of each, edges to each, optimise, go on.

    graph : in the frame of the map, at the start that is shared with every other mode; of `solution` its verdicts on loops
        and fixes are taken
    Raises GraphError when it cannot be solved.
    """
    osm = OsmMap(extract.buildings)
    odometry = with_drift(graph, 0.0, config.graph)
    graph = replace(accepted_part(graph, solution), odometry=odometry, map_priors=(), start=None, start_sigma=None)
    middles = np.array([b.middle for b in osm.buildings]).reshape(-1, 2)
    poses, local, sights = graph.poses.copy(), list[BuildingMatch](), list[KeyframeMatch]()
    for k in checking(range(len(store))):
        sight, found = _match(k, store, poses[k], osm, config, clocks[k])
        sights.append(sight)
        local += found
        if found and (k % EVERY == 0 or k == len(store) - 1):
            with clocks[k].stage("graph"):
                joint = optimise_jointly(_first(graph, poses, k + 1), middles, local, None, config.graph)
            poses[k:] = joint.poses[k] @ se3.inverse(poses[k]) @ poses[k:]
            poses[: k + 1] = joint.poses
    with clocks[len(store) - 1].stage("graph"):
        joint = optimise_jointly(replace(graph, poses=poses), middles, local, None, config.graph)
    matches = OsmMatches(
        extract.origin, osm.buildings, osm.walls, osm.owners, tuple(sights), tuple(local), source=extract.source,
        attribution=extract.attribution,
    )  # fmt: skip
    placed = place_buildings(matches, se2.of_se3(joint.poses), local, joint.buildings, config.osm, "baseline")
    return joint, matches, placed


def _match(
    number: int, store: KeyframeStore, pose: Floats, osm: OsmMap, config: Config, clock: StageClock
) -> tuple[KeyframeMatch, list[BuildingMatch]]:
    """One keyframe's scan, above the horizon and flat, against the buildings near."""
    at = se2.of_se3(pose)
    tilt = se2.to_se3(np.array([0.0, 0.0, -at[2]]))[:3, :3] @ pose[:3, :3]
    with clock.stage("walls"):
        seen = flatten_scan(store.points(number) @ tilt.T.astype(np.float32), config.osm.wall_range)
    with clock.stage("map match"):
        whole = lay_scan(seen, osm.walls[osm.walls_near(at[:2], config.osm.use_radius)], at)
    start = at if whole is None else whole.pose
    sight = KeyframeMatch(
        number, np.zeros((0, 2, 2)), np.zeros((1, 2)), at, np.zeros(3), start, np.zeros((3, 3)),
        kind="none" if whole is None else "edges", reason="no convergence" if whole is None else ONLY_START,
    )  # fmt: skip
    found = []
    for building in osm.near(start[:2], config.osm.use_radius).tolist():
        middle = osm.buildings[building].middle
        walls = osm.walls[osm.owners == building] - middle
        with clock.stage("building match"):
            fit = lay_building(walls, seen, se2.relative(start, np.append(middle, 0.0)))
        if fit is not None:
            spread = fitness_covariance(fit.rmse**2, config.graph)[np.ix_(PLANAR, PLANAR)]
            information, nothing = np.asarray(np.linalg.inv(spread), np.float64), np.zeros((0, 2), np.int64)
            found.append(
                BuildingMatch(
                    number, building, fit.pose, information, 3, "edges", -fit.rmse, fit.overlap, fit.rmse, nothing
                )
            )
    return sight, found


def _first(graph: PoseGraph, poses: Floats, count: int) -> PoseGraph:
    """The graph of the first `count` keyframes, from `poses` on."""
    return replace(
        graph,
        poses=poses[:count],
        odometry=[c for c in graph.odometry if max(c.a, c.b) < count],
        loops=[c for c in graph.loops if max(c.a, c.b) < count],
        fixes=[fix for fix in graph.fixes if fix.keyframe < count],
        ups=[up for up in graph.ups if up.keyframe < count],
        turns=[turn for turn in graph.turns if max(turn.a, turn.b) < count],
        floors=[floor for floor in graph.floors if floor.keyframe < count],
        distances=graph.distances[:count],
    )
