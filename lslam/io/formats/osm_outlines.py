"""Outlines of buildings in GeoJSON, as elements of OpenStreetMap."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from lslam.io.formats.osm_data import ATTRIBUTION, AreaMaker, OsmData, Place, is_on_earth

_PARTS = {"FeatureCollection": "features", "GeometryCollection": "geometries"}
KINDS = (*_PARTS, "Feature", "Polygon", "MultiPolygon")
# What names the one coordinate system that RFC 7946 allows; older files say it in so many ways.
_WGS84 = re.compile(r"CRS84|EPSG:+4326|WGS ?84", re.IGNORECASE)
_REPROJECT = "turn it into longitude and latitude first (ogr2ogr -t_srs EPSG:4326 new.geojson old.geojson)"
Area = tuple[tuple[str, int] | None, dict[str, str], list[Any]]


def is_geojson(tree: Any) -> bool:
    """True for a parsed GeoJSON document, whatever is in it."""
    return isinstance(tree, dict) and tree.get("type") in KINDS


def osm_from_outlines(tree: Any) -> OsmData:
    """The polygons of a parsed GeoJSON document as ways and multipolygons.

    Properties are tags, `@id` or `osm_id` keeps the element's number (`way/12`); others get negative numbers. In a file
    whose properties never say `building` every polygon is one. Raises ValueError for another coordinate system, and for
    polygons that are none.
    """
    if (crs := tree.get("crs")) and not _WGS84.search(str(crs)):
        raise ValueError(f"its coordinates are in {str(crs)[:80]}: {_REPROJECT}")
    areas = list(_areas(tree))
    says_building = any("building" in tags for _, tags, _ in areas)
    data = OsmData(attribution=tree.get("attribution", ATTRIBUTION) or None)
    maker = AreaMaker(data, {name[1] for name, _, _ in areas if name and name[0] == "way"}, shares_nodes=True)
    used: set[tuple[str, int] | None] = set()
    for name, tags, polygons in areas:
        tags = tags if says_building else {"building": "yes", **tags}
        places = [[_places(ring) for ring in rings] for rings in polygons]
        maker.add(None if name in used else name, places, tags, {**tags, "type": "multipolygon"})
        used.add(name)
    return data


def _places(ring: Any) -> list[Place]:
    if not isinstance(ring, list) or len(ring) < 4:
        raise ValueError("a ring of a polygon has fewer than four positions")
    return [_place(position) for position in ring]


def _place(position: Any) -> Place:
    try:
        lon, lat = float(position[0]), float(position[1])
    except (TypeError, ValueError, IndexError, KeyError):
        raise ValueError(f"{str(position)[:60]} is no position") from None
    if not is_on_earth(lat, lon):
        is_swapped = abs(lon) <= 90 < abs(lat) <= 180
        way_out = "GeoJSON has the longitude first, and then the latitude" if is_swapped else _REPROJECT
        raise ValueError(f"{lon:g}, {lat:g} are no degrees of longitude and latitude: {way_out}")
    return lat, lon


def _areas(tree: Any, properties: Any = None, name: Any = None) -> Iterator[Area]:
    """(kind, number) or None, tags, and polygons as lists of rings, of everything in the tree that has an area."""
    kind = str(tree.get("type")) if isinstance(tree, dict) else ""
    if kind in _PARTS:
        parts = tree.get(_PARTS[kind]) or []
        if not isinstance(parts, list):
            raise ValueError(f"a {kind} without a list of {_PARTS[kind]}")
        for part in parts:
            yield from _areas(part, properties, name)
    elif kind == "Feature":
        own = tree.get("properties")
        yield from _areas(tree.get("geometry"), own if isinstance(own, dict) else {}, tree.get("id"))
    elif kind in ("Polygon", "MultiPolygon"):
        held = tree.get("coordinates")
        polygons = [held] if kind == "Polygon" else held
        if not isinstance(polygons, list) or not all(isinstance(rings, list) for rings in polygons):
            raise ValueError(f"a {kind} without a list of rings")
        known = properties or {}
        yield _named(known, name), _tags(known), [rings for rings in polygons if rings]


def _named(properties: dict[str, Any], name: Any) -> tuple[str, int] | None:
    """`way/12` of Overpass turbo and lslam, a plain number of osmium and QGIS."""
    for value in (properties.get("@id"), properties.get("osm_id"), name):
        found = re.fullmatch(r"(?:(way|relation)/)?(-?\d{1,18})", str(value))
        if found:
            return found[1] or "way", int(found[2])
    return None


def _tags(properties: dict[str, Any]) -> dict[str, str]:
    held = properties.get("tags")
    flat = {**properties, **(held if isinstance(held, dict) else {})}
    return {str(k): str(v) for k, v in flat.items() if isinstance(v, str | int | float) and not str(k).startswith("@")}
