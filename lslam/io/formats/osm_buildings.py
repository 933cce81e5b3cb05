"""Buildings of an OpenStreetMap extract: which elements count, their outlines in metres, their heights."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError
from lslam.core.geometry.geodesy import to_local
from lslam.core.types.building import Building, Footprint, footprints_of
from lslam.io.formats.osm_data import OsmData, Relation, Way
from lslam.io.formats.osm_files import read_osm

FARTHEST_M = 100e3  # m
STOREY_M = 3.0  # m, docs/conventions.md
FOOT = 0.3048  # m
TALLEST_M = 1000.0  # m; what is higher is a slip of the pen
NodeIds = tuple[int, ...]


@dataclass(frozen=True)
class BuildingExtract:
    """The buildings of one extract, in the local frame at `origin`.

    buildings : in the order of the file, ways first; omissions : why elements were left out -> how many
    origin : (3,) lat, lon (deg), height (m) of x = y = 0; attribution : as `OsmData.attribution`; source : for messages
    """

    buildings: list[Building]
    omissions: Mapping[str, int]
    origin: Floats
    attribution: str | None
    source: str


def read_buildings(path: Path, origin: NDArray[Any] | None = None) -> tuple[OsmData, BuildingExtract]:
    """All of `path` (OSM XML, Overpass JSON, GeoJSON), and its buildings in the local frame at `origin` (3,) lat, lon, height.

    Without `origin` it is the middle of all buildings, at height 0. Raises InputError naming the file: unreadable
    (`read_osm`), without one building, far from the origin.
    """
    data = read_osm(path)
    return data, some_buildings_of(data, middle_of(data) if origin is None else origin, path)


def some_buildings_of(data: OsmData, origin: NDArray[Any], path: Path) -> BuildingExtract:
    """`buildings_of` the data read from `path`. Raises InputError naming the file if there are none."""
    extract = buildings_of(data, origin, str(path))
    if not extract.buildings:
        why = ", ".join(f"{count} x {reason}" for reason, count in extract.omissions.items())
        raise InputError(
            f"{path} holds no building outline ({len(data.ways)} ways, {len(data.relations)} relations"
            f"{'; left out: ' + why if why else ''}): fetch an extract with the buildings of the place"
        )
    return extract


def buildings_of(data: OsmData, origin: NDArray[Any], source: str = "the extract") -> BuildingExtract:
    """Footprints of every building in `data`, by the rules of docs/conventions.md ("Geodesy and OpenStreetMap").

    Closed ways and multipolygons count, except `building=no`, underground buildings and those with missing nodes.
    Raises InputError when all nodes lie more than 100 km from the origin, where a local frame is invalid.
    """
    at = np.asarray(origin, np.float64)
    where = _Positions(data, at)
    if data.nodes and not (away := where.distance()) < FARTHEST_M:
        far = "more than a continent" if not np.isfinite(away) else distance_text(away)
        raise InputError(f"{source} lies {far} away from the origin: {right_place(at, _has_swapped_axes(data, at))}")
    omissions: Counter[str] = Counter()
    of_relations: list[Building] = []
    outlines: set[int] = set()
    for relation in data.relations.values():
        if relation.tags.get("type") != "multipolygon" or not _counts(relation.tags, omissions):
            continue
        footprints = _relation_footprints(relation, data, where, omissions)
        if footprints:
            of_relations.append(_building(f"relation/{relation.id}", footprints, relation.tags))
            outlines |= {m.ref for m in relation.members if m.kind == "way" and m.role in ("", "outer")}
    buildings: list[Building] = []
    for way in data.ways.values():
        if not _counts(way.tags, omissions):
            continue
        if way.id in outlines:
            omissions["outline of a multipolygon already read"] += 1
            continue
        footprints = _way_footprints(way, where, omissions)
        if footprints:
            buildings.append(_building(f"way/{way.id}", footprints, way.tags))
    return BuildingExtract(buildings + of_relations, dict(omissions), at, data.attribution, source)


def middle_of(data: OsmData) -> Floats:
    """(3,) lat, lon (deg) of the centre of the box round all buildings' nodes, for --origin; height 0."""
    ways = [way for way in data.ways.values() if "building" in way.tags]
    members = {m.ref for r in data.relations.values() if "building" in r.tags for m in r.members if m.kind == "way"}
    ways += [way for number, way in data.ways.items() if number in members]
    fixes = np.array([data.nodes[node] for way in ways for node in way.nodes if node in data.nodes])
    if not len(fixes):
        fixes = np.array([*data.nodes.values()] or [(0.0, 0.0)])
    first = fixes[0, 1]
    fixes[:, 1] = first + (fixes[:, 1] - first + 180) % 360 - 180  # a place on the antimeridian is in one piece
    return np.append(np.round((fixes.min(axis=0) + fixes.max(axis=0)) / 2, 7), 0.0)


class _Positions:
    """Rings of node numbers as corners in metres; every node is projected once."""

    def __init__(self, data: OsmData, origin: Floats) -> None:
        self.row = {number: k for k, number in enumerate(data.nodes)}
        fixes = np.array([(lat, lon, 0.0) for lat, lon in data.nodes.values()]).reshape(-1, 3)
        self.xy = to_local(fixes, origin)[:, :2]

    def distance(self) -> float:
        """Distance from the origin to the nearest node, m; inf where the projection is not defined."""
        return float(np.min(np.nan_to_num(np.linalg.norm(self.xy, axis=1), nan=np.inf)))

    def has(self, nodes: Iterable[int]) -> bool:
        """Whether all nodes have positions."""
        return all(node in self.row for node in nodes)

    def ring(self, nodes: Sequence[int]) -> Floats:
        """Corners (K, 2), m, of a closed ring of nodes, the first not repeated."""
        return np.asarray(self.xy[[self.row[node] for node in nodes[:-1]]])


def _counts(tags: Mapping[str, str], omissions: Counter[str]) -> bool:
    """Whether an element is a building above the ground. Other buildings are counted in `omissions`."""
    kind = tags.get("building")
    if kind is None:
        return False
    if kind.strip().lower() == "no":
        omissions["building=no"] += 1
    elif is_underground(tags):
        omissions["underground"] += 1
    else:
        return True
    return False


def _way_footprints(way: Way, where: _Positions, omissions: Counter[str]) -> tuple[Footprint, ...]:
    """Footprints of a closed way; empty, with a count in `omissions`, if it is open, has missing nodes or no area."""
    if not where.has(way.nodes) or not way.nodes:
        omissions["nodes missing"] += 1
    elif not way.is_ring:
        omissions["open way"] += 1
    elif footprints := footprints_from_rings([where.ring(way.nodes)], []):
        return footprints
    else:
        omissions["no area"] += 1
    return ()


def _relation_footprints(
    relation: Relation, data: OsmData, where: _Positions, omissions: Counter[str]
) -> tuple[Footprint, ...]:
    """Footprints of a multipolygon; empty, with a count in `omissions`, if rings do not close, nodes are missing or no area."""
    members = [m for m in relation.members if m.kind == "way" and m.role in ("", "outer", "inner")]
    ways = [data.ways.get(m.ref) for m in members]
    if not all(way is not None and way.nodes and where.has(way.nodes) for way in ways):
        omissions["nodes missing"] += 1
        return ()
    parts = [(m.role == "inner", way.nodes) for m, way in zip(members, ways, strict=True) if way is not None]
    outer, inner = (join_rings([nodes for is_inner, nodes in parts if is_inner == wanted]) for wanted in (False, True))
    if not outer or inner is None:
        omissions["rings that do not close"] += 1
        return ()
    footprints = footprints_from_rings([where.ring(ring) for ring in outer], [where.ring(ring) for ring in inner])
    if not footprints:
        omissions["no area"] += 1
    return footprints


def _building(osm_id: str, footprints: tuple[Footprint, ...], tags: Mapping[str, str]) -> Building:
    """The building of these footprints, with heights and tags by its element's `tags`."""
    own = {key: value for key, value in tags.items() if key != "type"}
    return Building(osm_id, footprints, height_of(tags), base_of(tags), own)


def _has_swapped_axes(data: OsmData, origin: Floats) -> bool:
    """Whether data and origin would agree if latitude and longitude were swapped."""
    return abs(float(origin[1])) <= 90 and _Positions(data, origin[[1, 0, 2]]).distance() < FARTHEST_M


def right_place(origin: Floats, has_swapped_axes: bool = False) -> str:
    """Advice for a message about an extract far from the origin: check it, or swap latitude and longitude."""
    if has_swapped_axes:
        return (
            f"latitude and longitude are swapped, in --origin ({origin[0]:.5f},{origin[1]:.5f}; latitude first) or in the file "
            "(GeoJSON has the longitude first)"
        )
    return f"check --origin ({origin[0]:.5f},{origin[1]:.5f}) or fetch the extract of that place"


def distance_text(distance: float) -> str:
    """Distance (m) as text for messages."""
    return f"{distance / 1000:.1f} km" if distance > 1000 else f"{distance:.0f} m"


def height_of(tags: Mapping[str, str]) -> float | None:
    """Height, m, from `height` (m, or feet and inches), else 3 m times `building:levels`; None when neither is plausible."""
    height = _length(tags.get("height", ""))
    if height is None:
        levels = _number(tags.get("building:levels", ""))
        height = None if levels is None else levels * STOREY_M
    return height if height is not None and 0 < height < TALLEST_M else None


def base_of(tags: Mapping[str, str]) -> float:
    """Height above the ground at which the walls begin, m: `min_height`, else 3 m times `building:min_level`, else 0.

    A base above the building's own height counts as 0.
    """
    base = _length(tags.get("min_height", ""))
    if base is None:
        base = (_number(tags.get("building:min_level", "")) or 0.0) * STOREY_M
    return base if 0 < base < (height_of(tags) or TALLEST_M) else 0.0


def is_underground(tags: Mapping[str, str]) -> bool:
    """True for `location=underground` and for a negative `layer`."""
    layer = _number(tags.get("layer", ""))
    return tags.get("location") == "underground" or (layer is not None and layer < 0)


def _number(text: str) -> float | None:
    """The decimal number that a text is; None for other texts."""
    match = re.fullmatch(r"\s*([+-]?\d+(?:[.,]\d+)?)\s*", text)
    return float(match[1].replace(",", ".")) if match else None


def _length(text: str) -> float | None:
    """Metres from `12`, `12.5 m`, `40 ft` or `40'6"`."""
    match = re.fullmatch(r"\s*(\d+(?:[.,]\d+)?)\s*(m|metres?|meters?|ft|feet|')?\s*(?:(\d+(?:\.\d+)?)\")?\s*", text)
    if not match or (match[3] and match[2] != "'"):
        return None
    value = float(match[1].replace(",", "."))
    return value * FOOT + float(match[3] or 0) * FOOT / 12 if match[2] in ("ft", "feet", "'") else value


def join_rings(parts: Sequence[NodeIds]) -> list[NodeIds] | None:
    """Closed rings of node numbers (first = last) from parts in any order and direction; None when they do not close.

    Where more than two open parts meet in one node, the way back to the ring's start is preferred.
    """
    rings = [part for part in parts if part[0] == part[-1]]
    rest = [part for part in parts if part[0] != part[-1]]
    while rest:
        ring = rest.pop(0)
        while ring[0] != ring[-1]:
            touching = [k for k, part in enumerate(rest) if ring[-1] in (part[0], part[-1])]
            if not touching:
                return None
            closing = [k for k in touching if ring[0] in (rest[k][0], rest[k][-1])]
            part = rest.pop((closing or touching)[0])
            ring += part[1:] if part[0] == ring[-1] else part[-2::-1]
        rings.append(ring)
    return rings


def footprints_from_rings(outers: Sequence[Floats], inners: Sequence[Floats]) -> tuple[Footprint, ...]:
    """Footprints of the outlines (K, 2), m, minus the inner rings; the corners of valid rings are unchanged.

    Rings that cross themselves or each other are repaired (shapely's make_valid); rings without area vanish.
    """
    from shapely import make_valid, union_all

    outlines = [p for ring in outers if (p := _polygon(ring)) is not None]
    holes = [p for ring in inners if (p := _polygon(ring)) is not None]
    plain = _plain(outlines, holes)
    if plain is not None:
        return plain
    ground = union_all([make_valid(p) for p in outlines])
    return footprints_of(_polygonal(ground.difference(union_all([make_valid(p) for p in holes]))))


def _plain(outlines: list[Any], holes: list[Any]) -> tuple[Footprint, ...] | None:
    """Footprints without repair if all outlines are valid and disjoint and each hole lies in one of them; else None."""
    from shapely import MultiPolygon, Polygon

    inside: list[list[Any]] = [[] for _ in outlines]
    for hole in holes:
        owner = next((k for k, outline in enumerate(outlines) if outline.is_valid and outline.covers(hole)), None)
        if owner is None:
            return None
        inside[owner].append(hole.exterior)
    polygons = [Polygon(outline.exterior, held) for outline, held in zip(outlines, inside, strict=True)]
    return footprints_of(MultiPolygon(polygons)) if MultiPolygon(polygons).is_valid else None


def _polygon(ring: Floats) -> Any | None:
    """A shapely polygon without repeated corners; None with fewer than three."""
    from shapely import Polygon

    corners = ring[np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1) > 1e-6]
    return Polygon(corners) if len(corners) >= 3 else None


def _polygonal(geometry: Any) -> Any:
    """Flat list of the polygons of a geometry. Repair leaves lines and points behind, and nests collections."""
    from shapely import MultiPolygon

    parts = [geometry]
    areas = []
    while parts:
        part = parts.pop(0)
        if part.geom_type == "Polygon":
            areas.append(part)
        else:
            parts.extend(getattr(part, "geoms", ()))
    return MultiPolygon(areas)
