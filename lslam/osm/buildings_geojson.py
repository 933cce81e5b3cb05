"""`buildings.geojson` (RFC 7946), the corrected buildings of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.errors import InputError, cause
from lslam.core.geometry import se2
from lslam.core.geometry.geodesy import from_local, to_local
from lslam.core.types.arrays import Floats
from lslam.core.types.building import Building, BuildingCorrection, CorrectedMap, Footprint
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import write_text
from lslam.io.formats.osm_data import DECIMALS

SCHEMA = "lslam-buildings-1"


def write_corrected(path: Path, found: CorrectedMap) -> None:
    """Write `found`: one feature a building at its real place, then one a wall that no building has; atomically.

    `@id` is the element's number in OpenStreetMap; displacements are real minus map, east, north, m, and counter-clockwise
    about the middle of the box round the outlines on the map. Raises OutputError when the file cannot be written.
    """
    stuck: dict[int, list[str]] = {k: [] for pair in found.left for k in pair}
    for i, j in found.left:
        stuck[i].append(found.buildings[j].building.osm_id)
        stuck[j].append(found.buildings[i].building.osm_id)
    features = [_feature(c, found.origin, stuck.get(k, [])) for k, c in enumerate(found.buildings)]
    features += [
        {
            "type": "Feature",
            "properties": {"status": "new", "length_m": round(float(np.linalg.norm(wall[1] - wall[0])), 2)},
            "geometry": {"type": "LineString", "coordinates": _positions(wall, found.origin)},
        }
        for wall in found.new_walls
    ]
    tree = {
        "type": "FeatureCollection",
        "schema": SCHEMA,
        "attribution": found.attribution or "",
        "origin": [float(v) for v in found.origin],
        "mode": found.mode,
        "map_shift_m": [round(float(v), 4) for v in found.shift],
        "features": features,
    }
    write_text(path, json.dumps(tree, allow_nan=False, ensure_ascii=False) + "\n")


def read_corrected(path: Path) -> CorrectedMap:
    """Read what `write_corrected` wrote, outlines rounded to 7 decimals of a degree. Raises InputError naming the file."""
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
    building, (east, north, yaw) = correction.building, correction.displacement
    polygons = [
        [_positions(np.concatenate([ring, ring[:1]]), origin) for ring in footprint.rings]
        for footprint in correction.corrected.footprints
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
        "matches": correction.used,
        "matches_rejected": correction.rejected,
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
    known, shape = feature["properties"], feature["geometry"]
    polygons = [shape["coordinates"]] if shape["type"] == "Polygon" else shape["coordinates"]
    rings = [[_metres(ring, origin)[:-1] for ring in polygon] for polygon in polygons]
    footprints = tuple(Footprint(own[0], tuple(own[1:])) for own in rings)
    there = Building(known["@id"], footprints, known["height_m"], known["base_m"], known["tags"])
    east, north, turn = known["displacement_east_m"], known["displacement_north_m"], np.radians(known["turn_deg"])
    displacement = np.array([east, north, turn], np.float64)
    return BuildingCorrection(
        _undone(there, displacement), displacement, np.array(known["covariance"], np.float64).reshape(3, 3),
        known["status"], known["matches"], known["matches_rejected"],
    )  # fmt: skip


def _undone(there: Building, displacement: Floats) -> Building:
    """The building as on the map; what it was turned about is the middle of the box round it there."""
    R = se2.rotation(float(displacement[2]))
    upright = there.moved(R.T, np.zeros(2))
    return upright.moved(np.eye(2), R @ upright.middle - displacement[:2] - upright.middle)


def _positions(points: Floats, origin: Floats) -> list[list[float]]:
    """(K, 2) m as lon, lat in deg."""
    places = from_local(np.column_stack([points, np.zeros(len(points))]), origin)
    return [[round(lon, DECIMALS), round(lat, DECIMALS)] for lat, lon, _ in places.tolist()]


def _metres(ring: Any, origin: Floats) -> Floats:
    places = np.array(ring, np.float64).reshape(-1, 2)
    return np.asarray(to_local(np.column_stack([places[:, ::-1], np.zeros(len(places))]), origin)[:, :2])
