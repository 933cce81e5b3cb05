"""A scenario in a real place: path through an OpenStreetMap extract, city along it, and moving objects."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import portable
from lslam.core.geometry.geodesy import to_local
from lslam.core.types.building import Building, footprint_polygon, is_canopy
from lslam.io.formats.osm_buildings import BuildingExtract, distance_text, is_underground, read_buildings, right_place
from lslam.io.formats.osm_data import OsmData
from lslam.simulation.curve import RouteCurve, Terrain, smooth_curve
from lslam.simulation.moving import Mover
from lslam.simulation.osm_city import OsmCity, build_osm_city
from lslam.simulation.routes import TIGHTEST, Route, WayPoints, beside, given_route
from lslam.simulation.scenario_files import Scenario

log = logging.getLogger("lslam")


VISIBLE_M = 150.0  # m from the path: what stands farther away, no LiDAR here sees
SIDE_ROADS = 100.0  # m from the path
FARTHEST_M = 10_000.0  # m from the origin: beyond, single precision would blur the walls
ELBOW_ROOM = 1.3  # m between a street's lane and the walls beside it
_PROBE = 0.2  # s
DISTANCE_CELL_M = 1.0  # m, of the raster of distances to walls
SHIFT = 4.0  # m between the places that are tried
HEADINGS = 72
VISIBILITY_M = 50.0  # m: a place on the line counts when a wall is that near; nothing is known farther from the map
_ROADS = ("motorway", "trunk", "primary", "secondary", "tertiary")
DRIVABLE = (
    *_ROADS,
    *(f"{kind}_link" for kind in _ROADS),
    "unclassified",
    "residential",
    "living_street",
    "service",
    "road",
)
WALKABLE = (*DRIVABLE, "pedestrian", "footway", "path", "cycleway", "track")
HEADROOM = 3.0  # m; below a building that begins higher one passes
BUILT_UP = 60.0  # m from a building: beyond, a route would leave what the extract shows
LONGEST_ROUTE_M = 1500.0  # m of a route found by ourselves
SHORTEST_ROAD_M = 20.0  # m of a road worth paving
CORNER_RADIUS_M = 3.0  # m, of the corners of ways


@dataclass(frozen=True)
class MapExtract:
    """Content of an OpenStreetMap file, and its buildings in the local frame at their origin."""

    data: OsmData
    buildings: BuildingExtract

    @property
    def origin(self) -> Floats:
        """(3,) lat, lon (deg), height (m) of x = y = 0."""
        return self.buildings.origin


def read_extract(path: Path, origin: NDArray[Any] | None = None) -> MapExtract:
    """Read `path` (OSM XML or Overpass JSON) into the local frame at `origin` (3,) lat, lon (deg), height (m).

    Without `origin` it is the middle of all buildings, at height 0. Raises InputError naming the file: unreadable, without
    buildings, far from the origin.
    """
    data, extract = read_buildings(path, origin)
    corners = np.concatenate([footprint.outer for b in extract.buildings for footprint in b.footprints])
    away = float(np.linalg.norm(corners, axis=1).min())
    if away > FARTHEST_M:
        lat, lon = extract.origin[:2]
        raise InputError(
            f"{path}: its nearest building is {away / 1000:.1f} km away from the origin ({lat:.5f},{lon:.5f}): check --origin"
        )
    return MapExtract(data, extract)


def route_in_map(scenario: Scenario, extract: MapExtract, way_points: WayPoints | None) -> Route:
    """Path through the extract: `way_points`, a shape fitted into free space, or along the streets of the map.

    Raises UsageError when there is nothing to drive along, or no room for the shape.
    """
    buildings, margin = extract.buildings.buildings, scenario.path.lane + ELBOW_ROOM
    if way_points is None:
        return _along_streets(scenario, extract, margin)
    if not way_points.has_place:
        way_points = fit_shape(way_points, buildings, margin, extract.buildings.source)
    return given_route(scenario, way_points)


def city_of_map(
    scenario: Scenario, extract: MapExtract, terrain: Terrain, rng: np.random.Generator, route: Route | None
) -> OsmCity:
    """City within 150 m of `route`, or of the whole extract. Raises InputError when no building is that close."""
    whole, layout, flies = extract.buildings, scenario.layout, scenario.carrier == "drone"
    buildings = whole.buildings
    if route is not None:
        buildings = buildings_near(whole, route.line.position(route.line.sample(5.0)), VISIBLE_M)
    # Below a flight there are only the roads of the map: it may pass over anything.
    driven = [] if route is None or flies else [route.street]
    roads = side_roads(
        highways(extract.data, extract.origin, DRIVABLE),
        solid_ground(buildings, ELBOW_ROOM),
        None if route is None else route.line if flies else route.street,
        0.0 if flies else layout.road,
        SIDE_ROADS,
    )
    return build_osm_city(
        buildings, terrain, rng, [*driven, *roads], layout, whole.attribution, Path(whole.source).name
    )


def buildings_near(extract: BuildingExtract, positions: NDArray[Any], reach: float) -> list[Building]:
    """Buildings within `reach` m of one of the `positions` (N, 2), m, in the extract's frame.

    Raises InputError with the distance of the extract when there are none.
    """
    from shapely import STRtree, points

    shapes = [(k, footprint_polygon(f)) for k, b in enumerate(extract.buildings) for f in b.footprints]
    tree = STRtree(points(np.asarray(positions, np.float64)[:, :2]))
    (rows, _), distance = tree.query_nearest([shape for _, shape in shapes], return_distance=True, all_matches=False)
    wanted = {shapes[row][0] for row, away in zip(rows, distance, strict=True) if away <= reach}
    near = [building for k, building in enumerate(extract.buildings) if k in wanted]
    if not near:
        raise InputError(
            f"{extract.source} has no building within {reach:g} m of the path, the nearest is "
            f"{distance_text(float(distance.min()))} away: {right_place(extract.origin)}"
        )
    return near


def keep_out_of_walls(movers: list[Mover], city: OsmCity, duration: float) -> list[Mover]:
    """Those of `movers` that hit no wall from 0 to `duration` s: pavements are generated without regard to the map's houses."""
    from shapely import contains_xy

    solid = solid_ground(city.buildings, 0.4)
    times = np.arange(0.0, duration, _PROBE)
    return [mover for mover in movers if not contains_xy(solid, mover.poses(times)[:, :2, 3]).any()]


def _along_streets(scenario: Scenario, extract: MapExtract, margin: float) -> Route:
    """Path along the longest street, in its right lane, `margin` m from houses; raises UsageError if there is none."""
    lane, kinds = scenario.path.lane, WALKABLE if scenario.carrier == "walker" else DRIVABLE
    radius = TIGHTEST[scenario.carrier] + lane + 1.0
    if scenario.carrier == "drone":
        radius = max(radius, 1.1 * scenario.speed**2 / scenario.lateral + lane)
    source = extract.buildings.source
    ways = highways(extract.data, extract.origin, kinds)
    line = find_route(ways, extract.buildings.buildings, margin, radius)
    if line is None:
        raise UsageError(
            f"{source} has {'no street' if not ways else 'no 50 m of street clear of walls'} to go along: give --path FILE "
            f"with way-points; --osm {source} --plan map.png without --path draws the place to read them from"
        )
    street = smooth_curve(line, closed=False)
    log.info("going along %.0f m of the streets of %s: --path FILE takes another line", street.length, source)
    return Route(street, beside(street, -lane))


def fit_shape(shape: WayPoints, buildings: Sequence[Building], margin: float, source: str) -> WayPoints:
    """The shape rotated and shifted so that it keeps `margin` m from walls and as many of its points as possible see walls.

    Of equally good positions the first in a fixed order is used. Raises UsageError when there is none.
    """
    points = _dense(shape)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    low, distance = _distances(buildings)
    best, most = None, -1
    for angle in 2 * np.pi * np.arange(HEADINGS) / HEADINGS:
        c, s = portable.cos(angle), portable.sin(angle)
        R = np.array([[c, -s], [s, c]])
        shifts, seen = _free_shifts(portable.product(points - middle, R.T), low, distance, margin)
        if len(seen) and seen.max() > most:
            most = int(seen.max())
            best = R, shifts[int(np.argmax(seen))] - portable.rotate(R, middle)
    if best is None:
        raise UsageError(
            f"the shape of --path fits nowhere between the buildings of {source} with {margin:.1f} m of room: give way-points "
            "of the place itself; --plan without --path draws it"
        )
    R, shift = best
    turn = np.degrees(portable.arctan2(R[1, 0], R[0, 0]))
    x, y = portable.rotate(R, points[0]) + shift
    log.info("the shape of --path begins at x = %.0f, y = %.0f m, turned by %.0f deg", x, y, turn)
    return replace(shape, points=portable.product(shape.points[:, :2], R.T) + shift, has_place=True)


def _dense(shape: WayPoints) -> Floats:
    """The line (N, 2), m, sampled every 2 m."""
    line = shape.points[:, :2]
    line = np.concatenate([line, line[:1]]) if shape.closed else line
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, along[-1], max(int(along[-1] / 2.0), 1) + 1)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def _distances(buildings: Sequence[Building]) -> tuple[Floats, NDArray[np.float32]]:
    """Distance to the nearest wall, m, on a raster from `low` (2,), m; 0 inside of buildings."""
    from scipy.ndimage import distance_transform_edt
    from shapely import contains_xy

    solid = solid_ground(buildings, 0.5 * DISTANCE_CELL_M)
    bounds = np.array(solid.bounds).reshape(2, 2) + np.array([[-VISIBILITY_M], [VISIBILITY_M]])
    x, y = (np.arange(bounds[0, k], bounds[1, k], DISTANCE_CELL_M) for k in (0, 1))
    inside = contains_xy(solid, *np.meshgrid(x, y, indexing="ij"))
    return bounds[0], np.asarray(DISTANCE_CELL_M * distance_transform_edt(~inside), np.float32)


def _free_shifts(line: Floats, low: Floats, distance: NDArray[np.float32], margin: float) -> tuple[Floats, Longs]:
    """Shifts (M, 2), m, on a grid that keep `line` (N, 2) `margin` m off buildings, and the points (M,) in sight of walls.

    distance : (X, Y) m to the next building, from the corner `low` (2,) on
    """
    size = DISTANCE_CELL_M * np.array(distance.shape)
    x, y = (np.arange(low[k], low[k] + size[k], SHIFT) for k in (0, 1))
    shifts = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    seen = np.zeros(len(shifts), np.int64)
    # From far apart to near: most shifts fail at the first few points.
    order = np.concatenate([np.arange(k, len(line), 16) for k in range(16)])
    for point in line[order]:
        cell = np.floor((shifts + point - low) / DISTANCE_CELL_M).astype(np.int64)
        on_map = ((cell >= 0) & (cell < distance.shape)).all(axis=1)
        away = distance[tuple(np.where(on_map[:, None], cell, 0).T)]
        free = on_map & (away > margin)
        shifts, seen = shifts[free], seen[free] + (away[free] <= VISIBILITY_M)
        if not len(shifts):
            break
    return shifts, seen


def highways(data: OsmData, origin: NDArray[Any], kinds: Iterable[str]) -> list[tuple[tuple[int, ...], Floats]]:
    """Ways whose `highway` tag is one of `kinds` on open ground: node numbers and corners (N, 2), m from `origin`.

    Tunnels, bridges, areas, and underground or indoor ways are left out. A way with missing nodes is split there.
    """
    wanted = frozenset(kinds)
    runs: list[tuple[int, ...]] = []
    for way in data.ways.values():
        if way.tags.get("highway") in wanted and _is_open_ground(way.tags):
            runs += _known_runs(way.nodes, data)
    if not runs:
        return []
    fixes = np.array([(*data.nodes[node], 0.0) for run in runs for node in run])
    ends = np.cumsum([len(run) for run in runs])[:-1]
    return list(zip(runs, np.split(to_local(fixes, origin)[:, :2], ends), strict=True))


def solid_ground(buildings: Iterable[Building], margin: float) -> Any:
    """Area (a shapely geometry) of all buildings with walls, grown by `margin` m."""
    from shapely import prepare, union_all

    solid = (b for b in buildings if not is_canopy(b) and b.base < HEADROOM)
    ground = union_all([footprint_polygon(f).buffer(margin) for b in solid for f in b.footprints])
    prepare(ground)
    return ground


def find_route(
    ways: Sequence[tuple[tuple[int, ...], Floats]], buildings: Sequence[Building], margin: float, radius: float
) -> Floats | None:
    """Axis (N, 2), m, of a street to drive: the longest one in the built-up area, at most 1.5 km.

    It is the longest of the shortest paths between two crossings, cut to its longest part that keeps `margin` m from
    walls and whose bends have a radius of at least `radius` m. None if that is less than 50 m.
    """
    from shapely import distance, points

    walls = solid_ground(buildings, 0.0)
    line = _longest_way(ways, buildings, walls)
    if line is None or _length(line) < 50:
        return None
    # A right angle smoothed by sigma has the radius 0.89 sigma.
    curve = smooth_curve(line, closed=False, smoothing=max(CORNER_RADIUS_M, 1.2 * radius))
    s = curve.sample(1.0)
    clear = np.asarray(distance(points(curve.position(s)), walls)) > margin
    good = clear & (np.abs(curve.curvature(s)) * radius < 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return None
    begin, end = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))]
    end = min(end, begin + int(LONGEST_ROUTE_M))
    return curve.position(s[begin:end]) if end - begin >= 50 else None


def side_roads(
    ways: Sequence[tuple[tuple[int, ...], Floats]], solid: Any, along: RouteCurve | None, apart: float, reach: float
) -> list[RouteCurve]:
    """Other roads: `ways` outside of `solid` ground, within `reach` m of the line `along`, more than `apart` m off it."""
    from shapely import LineString, line_merge, union_all

    if not ways:
        return []
    lines = union_all([LineString(xy) for _, xy in ways]).difference(solid)
    if along is not None:
        line = LineString(along.position(along.sample(1.0)))
        lines = lines.intersection(line.buffer(reach)).difference(line.buffer(apart, cap_style="flat"))
    merged = line_merge(lines) if lines.geom_type == "MultiLineString" else lines
    parts = [
        p for p in getattr(merged, "geoms", [merged]) if p.geom_type == "LineString" and p.length >= SHORTEST_ROAD_M
    ]
    return [smooth_curve(np.array(part.coords), closed=False, smoothing=CORNER_RADIUS_M) for part in parts]


def _is_open_ground(tags: Mapping[str, str]) -> bool:
    """Whether a way is on open ground: no tunnel, bridge, area, and neither covered nor indoors."""
    covered = any(tags.get(key, "no") != "no" for key in ("tunnel", "bridge", "covered", "indoor"))
    return not covered and not is_underground(tags) and tags.get("area") != "yes"


def _known_runs(nodes: Sequence[int], data: OsmData) -> list[tuple[int, ...]]:
    """Stretches of a way, as node numbers, whose nodes are all in the extract."""
    runs: list[list[int]] = [[]]
    for node in nodes:
        if node not in data.nodes:
            runs.append([])
        elif not runs[-1] or runs[-1][-1] != node:
            runs[-1].append(node)
    return [tuple(run) for run in runs if len(run) > 1]


def _longest_way(
    ways: Sequence[tuple[tuple[int, ...], Floats]], buildings: Sequence[Building], solid: Any
) -> Floats | None:
    """Corners (N, 2), m, of the longest shortest path over the largest network, found by going to the far end twice."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, dijkstra
    from shapely import LineString, STRtree, intersects, points

    row: dict[int, int] = {}
    corners: list[Floats] = []
    pairs: list[tuple[int, int]] = []
    for nodes, xy in ways:
        for node, corner in zip(nodes, xy, strict=True):
            if node not in row:
                row[node] = len(corners)
                corners.append(corner)
        pairs += [(row[a], row[b]) for a, b in pairwise(nodes)]
    if not pairs:
        return None
    xy = np.array(corners)
    outlines = STRtree([footprint_polygon(f) for b in buildings for f in b.footprints])
    built_up = np.zeros(len(xy), np.bool_)
    built_up[np.unique(outlines.query(points(xy), predicate="dwithin", distance=BUILT_UP)[0])] = True
    edges = np.array(pairs)
    segments = [LineString(xy[edge]) for edge in edges]
    usable = built_up[edges].all(axis=1) & ~np.asarray(intersects(solid, segments))
    edges = edges[usable]
    if not len(edges):
        return None
    lengths = np.maximum(np.linalg.norm(xy[edges[:, 0]] - xy[edges[:, 1]], axis=1), 1e-6)
    # Of two ways between the same nodes the shorter counts.
    order = np.lexsort((lengths, edges.max(axis=1), edges.min(axis=1)))
    ends, first = np.unique(np.sort(edges[order], axis=1), axis=0, return_index=True)
    graph = coo_array((lengths[order][first], (ends[:, 0], ends[:, 1])), shape=(len(xy), len(xy))).tocsr()
    _, part = connected_components(graph, directed=False)
    largest = int(np.argmax(np.bincount(part[ends[:, 0]], weights=lengths[order][first])))
    here = int(np.flatnonzero(part == largest)[0])
    before = np.zeros(0)
    for _ in range(2):
        start = here
        away, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)  # type: ignore[call-overload]
        here = int(np.argmax(np.where(np.isfinite(away), away, -1.0)))
    chain = [here]
    while chain[-1] != start:
        chain.append(int(before[chain[-1]]))
    return np.asarray(xy[chain])


def _length(line: Floats) -> float:
    """Length of a polyline (N, 2), m."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
