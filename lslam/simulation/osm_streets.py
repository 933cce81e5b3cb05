"""Streets of an OpenStreetMap extract: which ways can be driven or walked, a route along them, and the roads beside it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry.geodesy import to_local
from lslam.core.types.arrays import Floats
from lslam.core.types.building import Building, footprint_polygon, is_canopy
from lslam.io.formats.osm_buildings import is_underground
from lslam.io.formats.osm_data import OsmData
from lslam.simulation.curve import RouteCurve, smooth_curve

_ROADS = ("motorway", "trunk", "primary", "secondary", "tertiary")
DRIVABLE = (
    *_ROADS, *(f"{kind}_link" for kind in _ROADS), "unclassified", "residential", "living_street", "service", "road",
)  # fmt: skip
WALKABLE = (*DRIVABLE, "pedestrian", "footway", "path", "cycleway", "track")
HEADROOM = 3.0  # m; below a building that begins higher one passes
BUILT_UP = 60.0  # m from a building: beyond, a route would leave what the extract shows
LONGEST = 1500.0  # m of a route found by ourselves
SHORTEST = 20.0  # m of a road worth paving
ROUNDING = 3.0  # m, of the corners of ways


def highways(data: OsmData, origin: NDArray[Any], kinds: Iterable[str]) -> list[tuple[tuple[int, ...], Floats]]:
    """Ways of the given `kinds` of highway on open ground: node numbers and corners (N, 2), m from `origin`.

    Left out are tunnels, bridges, what is underground, indoors or an area; a way with missing nodes falls into its parts.
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
    """The ground (a shapely geometry) that buildings with walls take, `margin` m of air around them included."""
    from shapely import prepare, union_all

    solid = (b for b in buildings if not is_canopy(b) and b.base < HEADROOM)
    ground = union_all([footprint_polygon(f).buffer(margin) for b in solid for f in b.footprints])
    prepare(ground)
    return ground


def find_route(
    ways: Sequence[tuple[tuple[int, ...], Floats]], buildings: Sequence[Building], margin: float, radius: float
) -> Floats | None:
    """The middle (N, 2), m, of a street to drive: as long as there is one through the built-up ground, at most 1.5 km.

    It is the longest shortest way between two crossings, cut to its longest part that keeps `margin` m from walls and whose
    bends have at least `radius` m; None where there are not 50 m of such a street.
    """
    from shapely import distance, points

    walls = solid_ground(buildings, 0.0)
    line = _longest_way(ways, buildings, walls)
    if line is None or _length(line) < 50:
        return None
    # A right angle smoothed by sigma has the radius 0.89 sigma.
    curve = smooth_curve(line, closed=False, smoothing=max(ROUNDING, 1.2 * radius))
    s = curve.sample(1.0)
    clear = np.asarray(distance(points(curve.position(s)), walls)) > margin
    good = clear & (np.abs(curve.curvature(s)) * radius < 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return None
    begin, end = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))]
    end = min(end, begin + int(LONGEST))
    return curve.position(s[begin:end]) if end - begin >= 50 else None


def side_roads(
    ways: Sequence[tuple[tuple[int, ...], Floats]], solid: Any, along: RouteCurve | None, apart: float, reach: float
) -> list[RouteCurve]:
    """The other roads: `ways` outside of `solid` ground, within `reach` m of the line `along`, more than `apart` m off it."""
    from shapely import LineString, line_merge, union_all

    if not ways:
        return []
    lines = union_all([LineString(xy) for _, xy in ways]).difference(solid)
    if along is not None:
        line = LineString(along.position(along.sample(1.0)))
        lines = lines.intersection(line.buffer(reach)).difference(line.buffer(apart, cap_style="flat"))
    merged = line_merge(lines) if lines.geom_type == "MultiLineString" else lines
    parts = [p for p in getattr(merged, "geoms", [merged]) if p.geom_type == "LineString" and p.length >= SHORTEST]
    return [smooth_curve(np.array(part.coords), closed=False, smoothing=ROUNDING) for part in parts]


def _is_open_ground(tags: Mapping[str, str]) -> bool:
    covered = any(tags.get(key, "no") != "no" for key in ("tunnel", "bridge", "covered", "indoor"))
    return not covered and not is_underground(tags) and tags.get("area") != "yes"


def _known_runs(nodes: Sequence[int], data: OsmData) -> list[tuple[int, ...]]:
    """Stretches of a way whose nodes are all in the extract."""
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
    """Corners (N, 2) of the longest shortest way over the largest network, by going to the far end twice."""
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
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
