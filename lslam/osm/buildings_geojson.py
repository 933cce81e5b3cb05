"""`buildings.geojson` (RFC 7946), the corrected buildings of a run."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, cause
from lslam.core.geometry import se2
from lslam.core.geometry.geodesy import from_local, to_local
from lslam.core.types.building import Building, BuildingCorrection, CorrectedMap, Footprint, about
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import write_text
from lslam.io.formats.osm_data import DECIMALS, OsmData

SCHEMA = "lslam-buildings-1"
ONE_NODE = 0.05  # m; a node that its buildings want nearer together than this stays one node
STAYS = 0.01  # m; what moves less is not edited


def write_buildings_geojson(path: Path, corrected_map: CorrectedMap) -> None:
    """Write `corrected_map`: one feature a building at its real place, then one a wall that no building has; atomically.

    `@id` is the element's number in OpenStreetMap; displacements are real minus map, east, north, m, and counter-clockwise
    about the middle of the box round the outlines on the map. Raises OutputError when the file cannot be written.
    """
    stuck: dict[int, list[str]] = {k: [] for pair in corrected_map.overlaps for k in pair}
    for i, j in corrected_map.overlaps:
        stuck[i].append(corrected_map.buildings[j].building.osm_id)
        stuck[j].append(corrected_map.buildings[i].building.osm_id)
    features = [_feature(c, corrected_map.origin, stuck.get(k, [])) for k, c in enumerate(corrected_map.buildings)]
    features += [
        {
            "type": "Feature",
            "properties": {"status": "new", "length_m": round(float(np.linalg.norm(wall[1] - wall[0])), 2)},
            "geometry": {"type": "LineString", "coordinates": _positions(wall, corrected_map.origin)},
        }
        for wall in corrected_map.new_walls
    ]
    tree = {
        "type": "FeatureCollection",
        "schema": SCHEMA,
        "attribution": corrected_map.attribution or "",
        "origin": [float(v) for v in corrected_map.origin],
        "mode": corrected_map.mode,
        "map_shift_m": [round(float(v), 4) for v in corrected_map.shift],
        "features": features,
    }
    write_text(path, json.dumps(tree, allow_nan=False, ensure_ascii=False) + "\n")


def read_buildings_geojson(path: Path) -> CorrectedMap:
    """Read a file of `write_buildings_geojson`, outlines rounded to 7 decimals of a degree. Raises InputError naming it."""
    try:
        tree = parse_json(path.read_bytes())
        if tree["schema"] != SCHEMA:
            raise ValueError(f"schema {tree['schema']!r}, expected {SCHEMA!r}")
        origin = np.array(tree["origin"], np.float64)
        if origin.shape != (3,) or not (np.abs(origin[:2]) <= [90, 180]).all():
            raise ValueError(f"its origin {tree['origin']} is no latitude, longitude and height")
        held = [f for f in tree["features"] if f["properties"]["status"] != "new"]
        new = [f["geometry"]["coordinates"] for f in tree["features"] if f["properties"]["status"] == "new"]
        buildings = tuple(_correction(feature, origin) for feature in held)
        numbers = {c.building.osm_id: k for k, c in enumerate(buildings)}
        left = {
            (k, numbers[other])
            for k, feature in enumerate(held)
            for other in feature["properties"]["overlaps"]
            if k < numbers[other]
        }
        walls = np.array([_metres(line, origin) for line in new]).reshape(-1, 2, 2)
        shift = np.array(tree["map_shift_m"], np.float64)
        return CorrectedMap(
            origin, buildings, tree["mode"], shift, walls, tuple(sorted(left)), tree["attribution"] or None
        )
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    except MISFIT as error:
        raise InputError(f"{path} is no buildings.geojson of a run: {error}") from None


def _feature(correction: BuildingCorrection, origin: Floats, overlaps: list[str]) -> dict[str, Any]:
    """GeoJSON feature of a corrected building; `overlaps` are the OpenStreetMap ids of the buildings that it overlaps."""
    building, (east, north, yaw) = correction.building, correction.displacement
    polygons = [
        [_positions(np.concatenate([ring, ring[:1]]), origin) for ring in footprint.rings]
        for footprint in correction.real_building.footprints
    ]
    properties = {
        "@id": building.osm_id,
        "status": correction.status,
        "displacement_east_m": round(float(east), 4),
        "displacement_north_m": round(float(north), 4),
        "displacement_m": round(float(np.hypot(east, north)), 4),
        "turn_deg": round(float(np.degrees(yaw)), 5),
        "confidence": round(correction.confidence, 4),
        "covariance": [[float(f"{v:.6g}") for v in row] for row in correction.covariance],
        "matches": correction.used_matches,
        "matches_rejected": correction.rejected_matches,
        "overlaps": overlaps,
        "height_m": building.height,
        "base_m": building.base,
        "tags": dict(building.tags),
    }
    geometry: dict[str, Any] = {"type": "MultiPolygon", "coordinates": polygons}
    if len(polygons) == 1:
        geometry = {"type": "Polygon", "coordinates": polygons[0]}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _correction(feature: dict[str, Any], origin: Floats) -> BuildingCorrection:
    """The correction that `_feature` wrote, in the frame of `origin` (3,) lat, lon, height; the building as it is on the map."""
    known, shape = feature["properties"], feature["geometry"]
    polygons = [shape["coordinates"]] if shape["type"] == "Polygon" else shape["coordinates"]
    rings = [[_metres(ring, origin)[:-1] for ring in polygon] for polygon in polygons]
    footprints = tuple(Footprint(own[0], tuple(own[1:])) for own in rings)
    there = Building(known["@id"], footprints, known["height_m"], known["base_m"], known["tags"])
    east, north, turn = known["displacement_east_m"], known["displacement_north_m"], np.radians(known["turn_deg"])
    displacement = np.array([east, north, turn], np.float64)
    return BuildingCorrection(
        _undone(there, displacement),
        displacement,
        np.array(known["covariance"], np.float64).reshape(3, 3),
        known["status"],
        known["matches"],
        known["matches_rejected"],
    )


def _undone(there: Building, displacement: Floats) -> Building:
    """The building before its `displacement` (3,), from the displaced one, `there`.

    The rotation was about the middle of the box round the building on the map.
    """
    R = se2.rotation(float(displacement[2]))
    upright = there.transform(R.T, np.zeros(2))
    return upright.transform(np.eye(2), R @ upright.middle - displacement[:2] - upright.middle)


def _positions(points: Floats, origin: Floats) -> list[list[float]]:
    """GeoJSON positions, lon, lat in deg, of points (K, 2), m, in the local frame of `origin` (3,)."""
    places = from_local(np.column_stack([points, np.zeros(len(points))]), origin)
    return [[round(lon, DECIMALS), round(lat, DECIMALS)] for lat, lon, _ in places.tolist()]


def _metres(ring: Any, origin: Floats) -> Floats:
    """Corners (K, 2), m, of a GeoJSON ring, in the local frame of `origin` (3,)."""
    places = np.array(ring, np.float64).reshape(-1, 2)
    return np.asarray(to_local(np.column_stack([places[:, ::-1], np.zeros(len(places))]), origin)[:, :2])


def corrected_osm(data: OsmData, corrected_map: CorrectedMap) -> OsmData:
    """The buildings of `corrected_map` with all their nodes, moved, as an extract to open in an editor (JOSM).

    Nodes and ways keep their numbers and versions; those that differ from `data` are `edits`. A node that several
    buildings share and displace differently stays with the building of highest confidence; the others get new nodes, with
    negative numbers. A node that a building outside `corrected_map` uses is not moved. Absent buildings are not deleted: a
    mapper decides.
    """
    owners = {_element(c.building): c for c in corrected_map.buildings}
    result = OsmData(attribution=corrected_map.attribution)
    targets: dict[int, list[_NodeTarget]] = {}
    for name, correction in owners.items():
        ways = sorted(_ways_of(data, name))
        for number in ways:
            result.add_way(data.ways[number])
            result.nodes.update((node, data.nodes[node]) for node in data.ways[number].nodes)
        for target in _node_targets(data, ways, correction, corrected_map.origin):
            targets.setdefault(target.node, []).append(target)
        if name[0] == "relation":
            result.add_relation(data.relations[name[1]])
    for node in _other_nodes(data, owners) & set(targets):
        was = targets[node][0].was
        targets[node].append(_NodeTarget(node, (), was, was, np.inf))
    _place(result, targets, corrected_map.origin)
    numbers = (("node", list(result.nodes)), ("way", list(result.ways)), ("relation", list(result.relations)))
    kept = {(kind, number) for kind, those in numbers for number in those}
    result.versions = {key: version for key, version in data.versions.items() if key in kept}
    return result


@dataclass(frozen=True)
class _NodeTarget:
    """Target position, m, of a node for one of its buildings.

    It has the position on the map, the building's ways through the node, and the building's confidence.
    """

    node: int
    ways: tuple[int, ...]
    place: Floats
    was: Floats
    confidence: float


def _node_targets(data: OsmData, ways: list[int], correction: BuildingCorrection, origin: Floats) -> list[_NodeTarget]:
    """Position (m, local frame of `origin`) to which the correction moves each node of the building's `ways`."""
    nodes = list(dict.fromkeys(node for number in ways for node in data.ways[number].nodes))
    rotation, shift = about(correction.building.middle, correction.displacement)
    was = to_local(np.array([(*data.nodes[node], 0.0) for node in nodes]).reshape(-1, 3), origin)[:, :2]
    return [
        _NodeTarget(node, tuple(n for n in ways if node in data.ways[n].nodes), place, old, correction.confidence)
        for node, place, old in zip(nodes, was @ rotation.T + shift, was, strict=True)
    ]


def _place(result: OsmData, targets: dict[int, list[_NodeTarget]], origin: Floats) -> None:
    """Move the nodes of `result` to their targets; a node with targets in several places is split into new nodes."""
    fresh = iter(range(min([0, *result.nodes, *result.ways]) - 1, -(2**62), -1))
    for node, wanted in targets.items():
        for group in _agreeing(sorted(wanted, key=lambda w: -w.confidence)):
            best = group[0]
            is_first = best is max(wanted, key=lambda w: w.confidence)
            if is_first and np.linalg.norm(best.place - best.was) < STAYS:
                continue
            number = node if is_first else next(fresh)
            lat, lon, _ = from_local(np.array([[*best.place, 0.0]]), origin)[0].tolist()
            result.add_node(number, round(lat, DECIMALS), round(lon, DECIMALS))
            result.edits.add(("node", number))
            for way in [] if is_first else [way for target in group for way in target.ways]:
                held = result.ways[way]
                result.ways[way] = replace(held, nodes=tuple(number if n == node else n for n in held.nodes))
                result.edits.add(("way", way))


def _agreeing(targets: list[_NodeTarget]) -> list[list[_NodeTarget]]:
    """Groups of targets that lie within `ONE_NODE` m of the first target of the group."""
    groups: list[list[_NodeTarget]] = []
    for target in targets:
        near = [g for g in groups if np.linalg.norm(target.place - g[0].place) <= ONE_NODE]
        if near:
            near[0].append(target)
        else:
            groups.append([target])
    return groups


def _element(building: Building) -> tuple[str, int]:
    """Kind and number of a building's element."""
    kind, number = building.osm_id.split("/")
    return kind, int(number)


def _ways_of(data: OsmData, element: tuple[str, int]) -> set[int]:
    """Numbers of the ways of an element that are whole: no outline, as an extract's border may cut others."""
    kind, number = element
    members = data.relations[number].members if kind == "relation" and number in data.relations else ()
    ways = {number} if kind == "way" else {m.ref for m in members if m.kind == "way"}
    return {n for n in ways & set(data.ways) if all(node in data.nodes for node in data.ways[n].nodes)}


def _other_nodes(data: OsmData, elements: Iterable[tuple[str, int]]) -> set[int]:
    """Nodes of buildings that were not corrected."""
    known = set(elements)
    inside = {number for name in known for number in _ways_of(data, name)}
    names = [("way", way.id) for way in data.ways.values() if "building" in way.tags and way.id not in inside]
    names += [("relation", r.id) for r in data.relations.values() if "building" in r.tags]
    return {node for name in names if name not in known for n in _ways_of(data, name) for node in data.ways[n].nodes}
