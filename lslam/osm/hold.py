"""A run held by the buildings of a map: found on it, optimised with it, and the buildings laid where they really stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.backend.georeferencing import Placement, on_earth
from lslam.backend.outcome import BackEnd, Given, solve
from lslam.errors import GraphError, InputError
from lslam.graph.odometry_constraints import corrected
from lslam.graph.problem import PoseGraph
from lslam.osm import matcher_named
from lslam.osm.location import finish
from lslam.osm.on_map import find_on_map
from lslam.osm.source import OsmSource
from lslam.types.gnss import Georeference


def hold_by_buildings(osm: OsmSource, graph: PoseGraph, placement: Placement, given: Given) -> BackEnd | None:
    """The run held by the buildings of a map, and by fixes where it has some; None, and why, where they hold nothing."""
    config, store, problems = given.config, given.store, given.problems
    known = placement.georeference
    origin = known.origin if known is not None else config.osm.origin
    if origin is None:
        problems.append(
            "OSM: without its fixes the run has no place on the map: give --origin LAT,LON of the first scan; it goes on without "
            "the buildings"
        )
        return None
    try:
        extract = osm.extract(np.asarray(origin, np.float64))
    except InputError as error:
        problems.append(f"OSM: {error}; the run goes on without the buildings")
        return None
    up = graph.world_up if graph.ups else None
    is_on_earth = config.gnss.mode == "graph" and known is not None
    if is_on_earth:
        graph = on_earth(graph, placement)
    located, held = find_on_map(
        extract, graph, store, up, None if known is None else known.T_enu_world, config, given.clocks
    )
    if located.problem:
        problems.append(located.problem)
        return None
    on_walls = Georeference(extract.origin, located.T_enu_odometry, config.gnss.crs, "osm", used=len(located.priors))
    georeference = known if is_on_earth else on_walls
    out = solve(held, given, georeference)
    if out is None or out.solution is None:
        return None
    matches = finish(located, extract, out.keyframes, out.solution, config.osm, given.clocks)
    try:
        laid = matcher_named(config.osm.matcher).lay(held, out.solution, matches, extract, given)
    except (GraphError, np.linalg.LinAlgError) as error:
        problems.append(f"OSM: {error}; the run goes on with its buildings where the map has them")
        return replace(out, osm=matches)
    laid_out = replace(out, osm=laid.matches, buildings=laid.buildings)
    if laid.joint is None:
        return laid_out
    poses, covariances = laid.joint.poses, laid.joint.covariances
    moved = corrected(given.results, store.keyframes, poses, covariances, out.solution.drift, config.graph)
    return replace(laid_out, results=moved, keyframes=poses)
