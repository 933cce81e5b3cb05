"""Del Tufo's baseline: buildings and trajectory are estimated in one graph, keyframe by keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.building_graph import optimise_jointly
from lslam.backend.graph.drift import with_drift
from lslam.backend.graph.factors import PLANAR
from lslam.backend.graph.odometry_constraints import fitness_covariance
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.backend.keyframes.store import KeyframeStore, submap_labels
from lslam.backend.outcome import BackEndInput
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se2, se3
from lslam.core.labels import table_of
from lslam.core.stopping import checking
from lslam.core.types.building import BuildingMatch, KeyframeMatch, OsmMatches
from lslam.core.types.scan_result import StageClock
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm.corrections import BuildingFit, accepted_part, place_buildings
from lslam.osm.walls import WALL_RANGE_M, OsmMap, classify
from lslam.registration.alignment import solve
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import Annealing
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import find_residual

# Keyframes after which the baseline's graph is optimised again; Del Tufo's timer does so every 3 s.
EVERY = 5
ONLY_START = "the baseline starts the matches of buildings there and gives the keyframe no prior"
OUTLINE_STEP_M = 0.25  # m between the points of an outline, and the grid of a flattened scan
HEIGHTS = (0.2, 0.7, 1.2, 1.7)  # m
NDT_VOXEL, VGICP_VOXEL = 2.0, 1.0  # m; hdl_graph_slam's NDT resolution, fast_gicp's voxel
WIDTH, STEPS = 2.0, 40  # m, where the kernel opens; Gauss-Newton steps at most
NOISE = 0.1  # m
LEAST_POINTS = 20
LEAST_OVERLAP = 0.1  # share of the points with a correspondence
FARTHEST_M = 5.0  # m from the prior; a result beyond has not converged
FAR = 1.0  # m; points farther from their nearest one do not count in the fitness score (the range of hdl_graph_slam's)


def fit_buildings(
    graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, inputs: BackEndInput
) -> BuildingFit:
    """Estimate buildings and poses, keyframe by keyframe: NDT of the scan with all buildings in range, VGICP with each of them.

    Every registered building is an edge of one graph, which is optimised. The signature is that of `corrections.BuildingFitter`.
    `matches` is not used; loops and fixes that `solution` rejected are omitted.
    """
    store, config, clocks = inputs.store, inputs.config, inputs.clocks
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
    matches = osm.collect(extract, sights, local)
    buildings = place_buildings(matches, se2.of_se3(joint.poses), local, joint.buildings, config.osm, "baseline")
    return BuildingFit(matches, buildings, joint)


def _match(
    number: int, store: KeyframeStore, pose: Floats, osm: OsmMap, config: Config, clock: StageClock
) -> tuple[KeyframeMatch, list[BuildingMatch]]:
    """Match the scan of a keyframe, projected to the ground without its points below the horizon, with the buildings in range.

    pose : (4, 4), map frame. Returns the sighting, whose kind is `none` when NDT does not converge, and the building matches.
    """
    at = se2.of_se3(pose)
    tilt = se2.to_se3(np.array([0.0, 0.0, -at[2]]))[:3, :3] @ pose[:3, :3]
    with clock.stage("walls"):
        points = store.points(number) @ tilt.T.astype(np.float32)
        if config.osm.labels:
            labels = submap_labels(store, number, 1) if config.osm.needs_labels else classify(points)
            points = points[table_of(config.osm.labels)[labels]]
        seen = flatten_scan(points, WALL_RANGE_M)
    with clock.stage("map match"):
        whole = align_scan(seen, osm.walls[osm.walls_near(at[:2], config.osm.use_radius)], at)
    start = at if whole is None else whole.pose
    no_walls, about = (np.zeros((0, 2, 2)), np.zeros((1, 2))), (at, np.zeros(3), start, np.zeros((3, 3)))
    sight = KeyframeMatch(number, *no_walls, *about, kind="edges", reason=ONLY_START)
    if whole is None:
        sight = replace(sight, kind="none", reason="no convergence")
    found = []
    for building in osm.near(start[:2], config.osm.use_radius).tolist():
        middle = osm.buildings[building].middle
        walls = osm.walls[osm.owners == building] - middle
        with clock.stage("building match"):
            fit = align_building(walls, seen, se2.relative(start, np.append(middle, 0.0)))
        if fit is not None:
            spread = fitness_covariance(fit.rmse**2, config.graph)[np.ix_(PLANAR, PLANAR)]
            information = np.asarray(np.linalg.inv(spread), np.float64)
            scores = (-fit.rmse, fit.overlap, fit.rmse, np.zeros((0, 2), np.int64))
            found.append(BuildingMatch(number, building, fit.pose, information, 3, "edges", *scores))
    return sight, found


def _first(graph: PoseGraph, poses: Floats, count: int) -> PoseGraph:
    """The graph of the first `count` keyframes alone, at `poses` (K, 4, 4)."""
    return replace(
        graph,
        poses=poses[:count],
        odometry=[c for c in graph.odometry if max(c.a, c.b) < count],
        loops=[c for c in graph.loops if max(c.a, c.b) < count],
        fixes=[fix for fix in graph.fixes if fix.keyframe < count],
        ups=[up for up in graph.ups if up.keyframe < count],
        turns=[turn for turn in graph.turns if max(turn.a, turn.b) < count],
        inertial=None if graph.inertial is None else graph.inertial.until(count),
        floors=[floor for floor in graph.floors if floor.keyframe < count],
        distances=graph.distances[:count],
    )


@dataclass(frozen=True)
class FlatFit:
    """Planar pose (3,) of the source in the target; rmse : m, distance to the nearest target points, of those within `FAR`."""

    pose: Floats
    rmse: float
    overlap: float


def flatten_scan(cloud: NDArray[np.float32], reach: float) -> Floats:
    """Points (M, 2), m, of a level scan (N, 3) above the sensor's horizon within `reach`, m, one per cell of `OUTLINE_STEP_M`."""
    flat = cloud[(cloud[:, 2] > 0) & (np.abs(cloud[:, :2]).max(axis=1, initial=0.0) < reach), :2].astype(np.float64)
    _, first = np.unique(np.floor(flat / OUTLINE_STEP_M).astype(np.int64), axis=0, return_index=True)
    return np.asarray(flat[np.sort(first)])


def outline_points(walls: Floats) -> Floats:
    """(N, 2) points along walls (T, 2, 2), m."""
    found = []
    for a, b in walls:
        shares = np.linspace(0, 1, max(int(np.linalg.norm(b - a) / OUTLINE_STEP_M), 1) + 1)[:-1, None]
        found.append(a + shares * (b - a))
    return np.concatenate(found) if found else np.zeros((0, 2))


def align_scan(scan: Floats, walls: Floats, prior: Floats) -> FlatFit | None:
    """Register the flattened scan (N, 2) with all `walls` (T, 2, 2) by NDT from `prior` (3,); None without convergence."""
    return _align(scan, outline_points(walls), prior, NDT_VOXEL, "ndt")


def align_building(walls: Floats, scan: Floats, prior: Floats) -> FlatFit | None:
    """Register a building's `walls` (T, 2, 2), about its middle, with the flattened scan (N, 2) by VGICP, from `prior` (3,).

    None without convergence.
    """
    return _align(outline_points(walls), scan, prior, VGICP_VOXEL, "vgicp")


def _align(
    source: Floats, target: Floats, prior: Floats, voxel: float, residual: Literal["ndt", "vgicp"]
) -> FlatFit | None:
    """Pose of the points `source` (N, 2) in `target` (M, 2), m, registered from `prior` (3,); voxel : edge, m.

    None for too few points, for a poor overlap, and far from the prior.
    """
    from scipy.spatial import cKDTree

    if min(len(source), len(target)) < LEAST_POINTS:
        return None
    ground = GaussianMap(voxel, reach=np.inf, capacity=1 << int(np.ceil(np.log2(len(target) * len(HEIGHTS)))))
    ground.insert(_upright(target, HEIGHTS).astype(np.float32), np.eye(4))
    upright = _upright(source, HEIGHTS)
    points = PreparedPoints(upright.astype(np.float32), upright, np.zeros((len(upright), 6)), len(upright))
    annealing, c = Annealing(WIDTH, STEPS, 0.5, 0.8), RegistrationConfig(sigma=NOISE, weak_share=0.0)
    kind = replace(find_residual(residual), non_planar_weight=1.0)
    found = solve((ground,), points, se2.to_se3(prior), annealing, c, residual=kind)
    pose = se2.of_se3(found.T_world_lidar)
    if not found.ok or found.overlap < LEAST_OVERLAP or np.linalg.norm(pose[:2] - prior[:2]) > FARTHEST_M:
        return None
    away = np.asarray(cKDTree(target).query(se2.apply(pose, source))[0])
    near = away[away <= FAR]
    return FlatFit(pose, float(np.sqrt(np.mean(near**2))), found.overlap) if len(near) else None


def _upright(flat: Floats, heights: Sequence[float]) -> Floats:
    """Points (N * H, 3): each of `flat` (N, 2) at each of the `heights`, m. Registration in three dimensions needs them."""
    return np.concatenate([np.column_stack([flat, np.full(len(flat), z)]) for z in heights])
