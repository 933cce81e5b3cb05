"""A run with a map of buildings: keyframes are located on it, the graph has planar priors by it, buildings are displaced."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.backend.georeferencing import Placement, on_earth
from lslam.backend.graph.odometry_constraints import correct_scans
from lslam.backend.graph.problem import PlanarPrior, PoseGraph
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.outcome import BackEnd, BackEndInput, solve
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.config.backend import OsmConfig
from lslam.core.errors import GraphError, InputError
from lslam.core.geometry import se2, se3
from lslam.core.stopping import checking
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import KeyframeClocks
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm import find_matcher
from lslam.osm.location import MapLocations, finish, locate
from lslam.osm.source import OsmSource
from lslam.osm.wall_drift import WallDrift, WallSightings, find_wall_drift, without_drift
from lslam.osm.wall_match import match_buildings
from lslam.osm.walls import BUILDING_RATIO

log = logging.getLogger("lslam")
# Iterations of the drift estimate: the drift within a submap is not visible in its walls at first.
HOLD_ROUNDS = 5
# Modes in which the buildings of the map do not move relative to each other.
RIGID_MODES = ("prior", "rigid")
# m, sigma of a wall in these modes: the rounding of a survey.
SURVEY_SIGMA = 0.01


def hold_by_buildings(osm: OsmSource, graph: PoseGraph, placement: Placement, inputs: BackEndInput) -> BackEnd | None:
    """The back end with planar priors by a map's buildings, and with fixes where there are some.

    None, with a problem in `inputs`, when there is no map, no keyframe located on it, or no solution.
    """
    config, store, problems = inputs.config, inputs.store, inputs.problems
    known = placement.georeference
    origin = known.origin if known is not None else config.osm.origin
    if origin is None:
        problems.append(
            "OSM: without its fixes the run has no place on the map: give --origin LAT,LON of the first scan; it goes on without "
            "the buildings"
        )
        return None
    if config.osm.needs_labels and all(store.labels(k) is None for k in range(len(store))):
        problems.append(
            "OSM: osm.labels needs labels of points, and the keyframes have none: run the recording again with it; the run goes "
            "on without the buildings"
        )
        return None
    try:
        extract = osm.extract(np.asarray(origin, np.float64))
    except InputError as error:
        problems.append(f"OSM: {error}; the run goes on without the buildings")
        return None
    up = graph.world_up if graph.ups else None
    is_on_earth = known is not None and known.is_in_graph
    if is_on_earth:
        graph = on_earth(graph, placement)
    locations, held = find_on_map(
        extract, graph, store, up, None if known is None else known.T_enu_world, config, inputs.clocks
    )
    if locations.problem:
        problems.append(locations.problem)
        return None
    on_walls = Georeference(
        extract.origin,
        locations.T_enu_odometry,
        config.gnss.crs,
        "osm",
        used=len(locations.priors),
        height_epsg=config.gnss.height_crs,
        geoid=config.gnss.geoid,
    )
    georeference = known if is_on_earth else on_walls
    out = solve(held, inputs, georeference)
    if out is None or out.solution is None:
        return None
    matches = finish(locations, extract, out.keyframes, out.solution, config.osm, inputs.clocks)
    try:
        laid = find_matcher(config.osm.matcher).fit_buildings(held, out.solution, matches, extract, inputs)
    except (GraphError, np.linalg.LinAlgError) as error:
        problems.append(f"OSM: {error}; the run goes on with its buildings where the map has them")
        return replace(out, osm=matches)
    laid_out = replace(out, osm=laid.matches, buildings=laid.buildings)
    if laid.joint is None:
        return laid_out
    poses, covariances = laid.joint.poses, laid.joint.covariances
    moved = correct_scans(inputs.results, store.keyframes, poses, covariances, out.solution.drift, config.graph)
    return replace(laid_out, results=moved, keyframes=poses)


def find_on_map(
    extract: BuildingExtract,
    graph: PoseGraph,
    store: KeyframeStore,
    up: Floats | None,
    T_map_world: Floats | None,
    config: Config,
    clocks: KeyframeClocks | None = None,
) -> tuple[MapLocations, PoseGraph]:
    """The keyframes located on the map, and the graph in its frame, corrected by a significant drift.

    graph : of odometry, or aligned by GNSS fixes; up, T_map_world, clocks : as of `locate`; stage `drift` of the last keyframe
    """
    clocks = KeyframeClocks() if clocks is None else clocks
    locations = locate(extract, store, up, config, T_map_world, clocks=clocks)
    held = on_map(graph, locations, config)
    is_straight = held.is_rigid or not config.graph.steady_drift
    if locations.problem or not find_matcher(config.osm.matcher).reveals_drift or is_straight:
        return locations, held
    before: WallDrift | None = None
    for _ in range(HOLD_ROUNDS):
        with clocks[len(store) - 1].stage("drift"):
            seen = sightings(locations, held.poses, config)
            drift = find_wall_drift(held, seen, *_wall_sigmas(config.osm), config.graph, before)
        if drift is None or not drift.is_sure:
            break
        before = drift
        held = replace(without_drift(held, drift.rates), spread=drift.spread, estimated_drift=drift.estimated_drift)
        odometry = se3.inverse(locations.T_enu_odometry) @ held.poses
        again = None if drift.is_final else locate(extract, store, up, config, T_map_world, odometry, clocks)
        if again is None or again.problem:
            break
        locations = again
        held = on_map(replace(held, poses=odometry), locations, config)
    if before is not None:
        estimated = before.estimated_drift
        rates = estimated.rates if estimated.rms is None else estimated.rms
        log.info(
            "OSM: %s drift of odometry, %.1f %% and %.1f deg/100 m, is corrected",
            "varying" if estimated.is_varying else "steady",
            100 * np.linalg.norm(rates[:2]),
            100 * np.degrees(rates[2]),
        )
    return locations, held


def on_map(graph: PoseGraph, locations: MapLocations, config: Config) -> PoseGraph:
    """The graph in the frame of the map, with planar priors by walls, and with its fixes."""
    return replace(
        graph,
        poses=graph.poses if graph.fixes else locations.T_enu_odometry @ graph.poses,
        map_priors=_priors(locations, config),
        shift_sigma=0.0 if config.osm.mode == "prior" else config.osm.shift_sigma,
        map_sigma=0.0 if config.osm.mode in RIGID_MODES else config.osm.map_sigma,
        world_up=np.array([0.0, 0.0, 1.0]),
        start=None if graph.fixes else locations.start,
        start_sigma=None if graph.fixes else locations.start_sigma,
        is_rigid=config.osm.trust_poses and config.odometry.method == "poses",
    )


def _priors(locations: MapLocations, config: Config) -> list[PlanarPrior]:
    """The planar priors on keyframes by the accepted matches.

    The error of a wall on the map is common to all keyframes that see it (`shares`). In the modes with an exact map only
    sightings have errors, which are independent between submaps.
    """
    if config.osm.mode not in RIGID_MODES:
        return locations.priors
    sharper = (config.osm.wall_sigma / _wall_sigmas(config.osm)[0]) ** 2
    share = 1.0 / config.keyframes.submap_size
    return [replace(prior, information=sharper * prior.information, share=share) for prior in locations.priors]


def _wall_sigmas(config: OsmConfig) -> tuple[float, float]:
    """Sigmas, m, of a sighting relative to the map's wall, and of the wall on the map."""
    if config.mode in RIGID_MODES:
        # The points of a wall are uniform within the tolerance.
        return config.wall_tolerance / np.sqrt(3.0), SURVEY_SIGMA
    return config.wall_sigma, BUILDING_RATIO * config.map_sigma


def sightings(locations: MapLocations, poses: Floats, config: Config) -> WallSightings:
    """The sightings of the map's walls, with the keyframes at `poses` (K, 4, 4), as drift estimation takes them."""
    osm, planar = locations.osm, se2.of_se3(poses)
    rows: list[tuple[Floats, Floats]] = [(np.zeros((0, 2, 2)), np.zeros((0, 2), np.int64))]
    for match in checking(locations.matches):
        at = match.pose if match.is_accepted else match.prior
        for one in match_buildings(match, at, np.zeros(2), osm, config.osm):
            if one.is_accepted:
                walls = np.flatnonzero(osm.owners == one.building)[one.pairs[:, 0]]
                seen = se2.apply(planar[match.keyframe], match.walls[one.pairs[:, 1]])
                rows.append((seen, np.column_stack([np.full(len(walls), match.keyframe), walls])))
    keyframes, walls = np.concatenate([numbers for _, numbers in rows]).T
    places = np.concatenate([seen for seen, _ in rows]).mean(axis=1)
    along = osm.walls[walls, 1] - osm.walls[walls, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    offsets = np.einsum("ni,ni->n", normals, places - osm.walls[walls, 0])
    return WallSightings(keyframes, walls, normals, places, offsets, 1.0 / config.keyframes.submap_size)
