"""A reply of an Overpass server as it came: its text, a fifth of what it takes as a tree, read element by element."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import IO, Any

from lslam.untrusted import JsonItems, parse_json

ELEMENTS = "elements"
KINDS = ("FeatureCollection", "Feature", "Polygon", "MultiPolygon", "GeometryCollection")
# What names the one coordinate system that RFC 7946 allows; older files say it in so many ways.
_WGS84 = re.compile(r"CRS84|EPSG:+4326|WGS ?84", re.IGNORECASE)
_REPROJECT = "turn it into longitude and latitude first (ogr2ogr -t_srs EPSG:4326 new.geojson old.geojson)"


class OverpassReply(Mapping[str, Any]):
    """The reply as the mapping its text says, parsed when it is asked for and then forgotten; nothing in it is checked.

    text : JSON; UTF-8, UTF-16 or UTF-32
    """

    def __init__(self, text: bytes) -> None:
        encoding = json.detect_encoding(text[:4])
        self.text = text if encoding == "utf-8" else text.decode(encoding, "surrogatepass").encode("utf-8", "replace")

    @classmethod
    def of(cls, tree: Mapping[str, Any]) -> OverpassReply:
        """The reply of a parsed one, or itself."""
        return tree if isinstance(tree, cls) else cls(json.dumps(tree, ensure_ascii=False).encode("utf-8", "replace"))

    def items_of(self) -> JsonItems:
        """Its elements, one at a time. Going through them raises ValueError as `JsonItems`."""
        return JsonItems(io.BytesIO(self.text), ELEMENTS)

    def write(self, stream: IO[bytes], facts: Mapping[str, Any]) -> None:
        """The text of a reply that was checked, with `facts` before what it says."""
        stream.write(json.dumps(facts).encode().removesuffix(b"}") + b", ")
        stream.write(memoryview(self.text)[self.text.index(b"{") + 1 :])

    def facts(self) -> dict[str, Any]:
        """All that is not elements."""
        found = self.items_of()
        for _ in found:
            pass
        return found.rest

    def __getitem__(self, key: str) -> Any:
        return parse_json(self.text)[key]

    def __iter__(self) -> Iterator[str]:
        return iter(parse_json(self.text))

    def __len__(self) -> int:
        return len(parse_json(self.text))

    def __repr__(self) -> str:
        return f"OverpassReply({self.text[:60]!r}..., {len(self.text)} bytes)"


def is_geojson(tree: Any) -> bool:
    """True for a parsed GeoJSON document, whatever is in it."""
    return isinstance(tree, dict) and tree.get("type") in KINDS


def elements_of(tree: Any) -> list[dict[str, Any]]:
    """Nodes, ways and relations of the polygons of a parsed GeoJSON document, in the form of Overpass.

    Properties are tags, `@id` or `osm_id` keeps the element's number (`way/12`); others get negative numbers. In a file
    whose properties never say `building` every polygon is one. Raises ValueError for another coordinate system, and for
    polygons that are none.
    """
    if (crs := tree.get("crs")) and not _WGS84.search(str(crs)):
        raise ValueError(f"its coordinates are in {str(crs)[:80]}: {_REPROJECT}")
    found = list(_polygons(tree))
    says_building = any("building" in tags for _, tags, _ in found)
    maker = _Elements({name for name, _, _ in found if name})
    for name, tags, polygons in found:
        maker.add(name, tags if says_building else {"building": "yes", **tags}, polygons)
    return maker.elements


class _Elements:
    """Collects elements; corners at one place are one node."""

    def __init__(self, taken: set[tuple[str, int]]) -> None:
        self.elements: list[dict[str, Any]] = []
        self._nodes: dict[tuple[float, float], int] = {}
        self._ways = {number for kind, number in taken if kind == "way"}
        self._number = 0
        self._used: set[tuple[str, int]] = set()

    def add(self, name: tuple[str, int] | None, tags: dict[str, str], polygons: list[Any]) -> None:
        if name in self._used:
            name = None
        self._used |= {name} if name else set()
        is_plain = len(polygons) == 1 and len(polygons[0]) == 1
        if is_plain and (name is None or name[0] == "way"):
            self._way(polygons[0][0], name[1] if name else self._fresh(), tags)
            return
        members = []
        for rings in polygons:
            for k, ring in enumerate(rings):
                number = self._way(ring, self._fresh(), {})
                members.append({"type": "way", "ref": number, "role": "inner" if k else "outer"})
        number = name[1] if name and name[0] == "relation" else self._fresh()
        tags = {**tags, "type": "multipolygon"}
        self.elements.append({"type": "relation", "id": number, "members": members, "tags": tags})

    def _way(self, ring: Any, number: int, tags: dict[str, str]) -> int:
        if not isinstance(ring, list) or len(ring) < 4:
            raise ValueError("a ring of a polygon has fewer than four positions")
        nodes = [self._node(position) for position in ring]
        nodes += [] if nodes[0] == nodes[-1] else nodes[:1]
        self.elements.append({"type": "way", "id": number, "nodes": nodes, "tags": tags})
        return number

    def _node(self, position: Any) -> int:
        try:
            lon, lat = float(position[0]), float(position[1])
        except (TypeError, ValueError, IndexError, KeyError):
            raise ValueError(f"{str(position)[:60]} is no position") from None
        if not (math.isfinite(lon) and abs(lon) <= 180 and math.isfinite(lat) and abs(lat) <= 90):
            is_swapped = abs(lon) <= 90 < abs(lat) <= 180
            way_out = "GeoJSON has the longitude first, and then the latitude" if is_swapped else _REPROJECT
            raise ValueError(f"{lon:g}, {lat:g} are no degrees of longitude and latitude: {way_out}")
        at = (lat, lon)
        if at not in self._nodes:
            self._nodes[at] = self._fresh()
            self.elements.append({"type": "node", "id": self._nodes[at], "lat": lat, "lon": lon})
        return self._nodes[at]

    def _fresh(self) -> int:
        self._number -= 1
        while self._number in self._ways:
            self._number -= 1
        return self._number


def _polygons(tree: Any, properties: Any = None, name: Any = None) -> Iterator[tuple[Any, dict[str, str], list[Any]]]:
    """(kind, number) or None, tags, and polygons as lists of rings, of everything in the tree that has an area."""
    kind = tree.get("type") if isinstance(tree, dict) else None
    if kind == "FeatureCollection":
        for feature in tree.get("features") or ():
            yield from _polygons(feature)
    elif kind == "Feature":
        own = tree.get("properties")
        yield from _polygons(tree.get("geometry"), own if isinstance(own, dict) else {}, tree.get("id"))
    elif kind == "GeometryCollection":
        for part in tree.get("geometries") or ():
            yield from _polygons(part, properties, name)
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
