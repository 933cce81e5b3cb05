"""OpenStreetMap files: nodes, ways and relations from XML, Overpass JSON or GeoJSON, and back to XML.

XML is parsed without entities or document types, so that a hostile file cannot grow in memory.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any
from xml.etree.ElementTree import Element, ParseError

from lslam.core.errors import InputError, input_errors
from lslam.core.untrusted import JsonItems
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.osm_data import ATTRIBUTION, DECIMALS, AreaMaker, OsmData, Place, is_on_earth

GENERATOR = "lslam"
ELEMENTS = "elements"  # of a reply
WAY_OUT = "fetch the extract again"
# Marks of byte order, the zeros of wide characters, and blanks, before the first that counts.
_BEFORE = b"\xef\xbb\xbf\xff\xfe\0 \t\r\n"
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
# First bytes of gzip, bzip2, xz, zip and Zstandard.
_COMPRESSION_MARKS = (b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"PK\x03\x04", b"\x28\xb5\x2f\xfd")
_PARTS = {"FeatureCollection": "features", "GeometryCollection": "geometries"}
KINDS = (*_PARTS, "Feature", "Polygon", "MultiPolygon")
# What names the one coordinate system that RFC 7946 allows; older files say it in so many ways.
_WGS84 = re.compile(r"CRS84|EPSG:+4326|WGS ?84", re.IGNORECASE)
_REPROJECT = "turn it into longitude and latitude first (ogr2ogr -t_srs EPSG:4326 new.geojson old.geojson)"
Area = tuple[tuple[str, int] | None, dict[str, str], list[Any]]


def read_osm(path: Path) -> OsmData:
    """Read an OSM XML file, a stored Overpass reply (JSON) or outlines in GeoJSON; the content decides, not the name.

    Raises InputError naming the file: missing, cut short, none of the three, with entities, with positions off the Earth.
    """
    with input_errors(path):
        with path.open("rb") as stream:
            start = stream.read(64)
        if start.startswith(_COMPRESSION_MARKS) or b"OSMHeader" in start:
            raise InputError(
                f"{path} is compressed: turn it into plain XML first (gunzip, bunzip2, or osmium cat -o map.osm)"
            )
        first = start.lstrip(_BEFORE)[:1]
        if first not in (b"<", b"{", b"["):
            what = "is neither XML nor JSON" if first else "is empty"
            raise InputError(f"{path} {what}, so it is no OpenStreetMap extract: {WAY_OUT}")
        return _read_xml(path, start.startswith(_UTF16)) if first == b"<" else _read_json(path)


class GaveUpError(ValueError):
    """Raised when Overpass ran out of time or memory, with its `remark`: the reply is valid JSON but incomplete."""

    def __init__(self, remark: Any) -> None:
        super().__init__(f"the server gave up: {str(remark)[:200]}")
        self.remark = str(remark)


def add_elements(data: OsmData, items: JsonItems) -> None:
    """Add the elements of an Overpass reply. Raises ValueError naming a malformed one."""
    for element in items:
        try:
            data.add_element(element)
        except (AttributeError, LookupError, TypeError, ArithmeticError) as error:
            raise ValueError(f"an element without {error}: {str(element)[:80]}") from None


def check_reply(items: JsonItems) -> None:
    """Raise ValueError if a document is no reply of Overpass, GaveUpError (a ValueError) if the server gave up."""
    if not items.has_list:
        raise ValueError("no list of elements, so this is no Overpass reply")
    if items.rest.get("remark"):
        raise GaveUpError(items.rest["remark"])


def write_osm(path: Path, data: OsmData) -> None:
    """Write `data` as OSM XML 0.6, atomically, degrees with 7 decimals. Data that were read or rounded read back equal."""
    with atomic_write(path) as stream:
        stream.write("".join(_xml_lines(data)).encode("utf-8", "replace"))


def _read_json(path: Path) -> OsmData:
    """Read an Overpass reply or GeoJSON; raises InputError if it is broken or unusable."""
    data = OsmData()
    try:
        with path.open("rb") as stream:
            items = JsonItems(stream, ELEMENTS)
            add_elements(data, items)
        if not items.has_list and is_geojson(items.rest):
            return osm_from_outlines(items.rest)
        check_reply(items)
        data.number_outlines()
        return data
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is broken JSON, perhaps cut short ({error}): {WAY_OUT}") from None
    except ValueError as error:
        raise InputError(f"{path} cannot be used, {error}: {WAY_OUT}") from None


def _read_xml(path: Path, is_wide: bool) -> OsmData:
    """Read OSM XML; is_wide : it is in UTF-16. Raises InputError if it is broken, no OSM file, or declares entities."""
    from defusedxml import DefusedXmlException, DTDForbidden

    try:
        # What a shell turned into UTF-16 still says of itself that it is UTF-8.
        with path.open(encoding="utf-16") if is_wide else path.open("rb") as stream:
            return _parsed_xml(path, stream)
    except DTDForbidden as error:
        if str(error.name).lower() == "html":
            raise InputError(f"{path} is a web page and no OpenStreetMap extract: {WAY_OUT}") from None
        raise InputError(
            f"{path} declares a document type or entities, which no OpenStreetMap file does: {WAY_OUT}"
        ) from None
    except DefusedXmlException:
        raise InputError(f"{path} declares entities, which no OpenStreetMap file does: {WAY_OUT}") from None
    except (ParseError, UnicodeError) as error:
        raise InputError(f"{path} is broken XML or cut short ({error}): {WAY_OUT}") from None
    except (KeyError, ValueError, LookupError) as error:
        raise InputError(f"{path} holds an element that makes no sense ({error}): {WAY_OUT}") from None


def _parsed_xml(path: Path, stream: IO[Any]) -> OsmData:
    """Iterate over an XML file's elements, each freed after use, as files are large; InputError unless it is OSM's."""
    from defusedxml.ElementTree import iterparse

    data, root = OsmData(), None
    for event, element in iterparse(stream, events=("start", "end"), forbid_dtd=True):
        if root is None:
            root = element
            if root.tag != "osm":
                what = f"it begins with <{root.tag}>, not with <osm>"
                raise InputError(f"{path} is XML but no OpenStreetMap extract: {what}")
            # Whatever does not say that lslam made it up comes from OpenStreetMap.
            if root.get("generator") == GENERATOR and not root.get("attribution"):
                data.attribution = None
        elif event == "end" and element.tag in ("node", "way", "relation"):
            _add_xml(data, element)
            root.clear()
    data.number_outlines()
    return data


def _add_xml(data: OsmData, element: Element) -> None:
    """Add a node, way or relation of OSM XML to `data`; deleted and invisible ones are skipped."""
    # JOSM marks deletions, the history API hides old versions: neither is on the ground.
    if element.get("action") == "delete" or element.get("visible") == "false":
        return
    number = int(element.attrib["id"])
    if element.get("action") == "modify":
        data.edits.add((element.tag, number))
    said: dict[str, Any] = {**element.attrib, "type": element.tag, "id": number}
    if element.tag != "node":
        said["tags"] = {tag.attrib["k"]: tag.attrib["v"] for tag in element.iter("tag")}
    if element.tag == "way" and (corners := [corner.attrib for corner in element.iter("nd")]):
        said["nodes"] = [corner["ref"] for corner in corners] if "ref" in corners[0] else ()
        said["geometry"] = [corner if "lat" in corner else None for corner in corners]
    if element.tag == "relation":
        said["members"] = [
            {**m.attrib, "geometry": [corner.attrib for corner in m.iter("nd")]} if len(m) else m.attrib
            for m in element.iter("member")
        ]
    data.add_element(said)


def _xml_lines(data: OsmData) -> Iterator[str]:
    """Lines of an OSM XML file with all elements of `data`."""
    yield "<?xml version='1.0' encoding='UTF-8'?>\n"
    credit = f" attribution={_quote(data.attribution)}" if data.attribution else ""
    yield f'<osm version="0.6" generator="{GENERATOR}"{credit}>\n'
    if data.nodes:
        lats, lons = zip(*data.nodes.values(), strict=True)
        sides = zip(("minlat", "minlon", "maxlat", "maxlon"), (min(lats), min(lons), max(lats), max(lons)), strict=True)
        yield " <bounds " + " ".join(f'{name}="{value:.{DECIMALS}f}"' for name, value in sides) + "/>\n"
    for number, (lat, lon) in data.nodes.items():
        yield f' <node {_identity(data, "node", number)} lat="{lat:.{DECIMALS}f}" lon="{lon:.{DECIMALS}f}"/>\n'
    for way in data.ways.values():
        yield f" <way {_identity(data, 'way', way.id)}>\n"
        yield from (f'  <nd ref="{node}"/>\n' for node in way.nodes)
        yield from _tag_lines(way.tags.items())
        yield " </way>\n"
    for relation in data.relations.values():
        yield f" <relation {_identity(data, 'relation', relation.id)}>\n"
        for m in relation.members:
            yield f'  <member type="{m.kind}" ref="{m.ref}" role={_quote(m.role)}/>\n'
        yield from _tag_lines(relation.tags.items())
        yield " </relation>\n"
    yield "</osm>\n"


def _identity(data: OsmData, kind: str, number: int) -> str:
    """XML attributes of an element: id, version, and the mark of an edited one."""
    action = ' action="modify"' if (kind, number) in data.edits else ""
    return f'id="{number}" version="{data.versions.get((kind, number), 1)}"{action}'


def _tag_lines(tags: Iterable[tuple[str, str]]) -> Iterator[str]:
    """XML lines of tags."""
    return (f"  <tag k={_quote(key)} v={_quote(value)}/>\n" for key, value in tags)


def _quote(text: str) -> str:
    """A text as a quoted XML attribute, without control characters, which XML cannot hold."""
    from xml.sax.saxutils import quoteattr  # with what speaks to servers

    # XML has no way to write most control characters.
    return quoteattr("".join(c for c in text if c.isprintable() or c in "\t\n\u00a0"))


def is_geojson(tree: Any) -> bool:
    """True for a parsed GeoJSON document, whatever is in it."""
    return isinstance(tree, dict) and tree.get("type") in KINDS


def osm_from_outlines(tree: Any) -> OsmData:
    """The polygons of a parsed GeoJSON document as ways and multipolygons.

    Properties become tags, `@id` or `osm_id` the element's number (`way/12`); others get negative numbers. In a file
    whose properties never have `building`, every polygon is a building. Raises ValueError for another coordinate system, and for
    malformed polygons.
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
    """Positions (lat, lon) of a GeoJSON ring; raises ValueError for fewer than four."""
    if not isinstance(ring, list) or len(ring) < 4:
        raise ValueError("a ring of a polygon has fewer than four positions")
    return [_place(position) for position in ring]


def _place(position: Any) -> Place:
    """(lat, lon), deg, of a GeoJSON position; raises ValueError for anything else, with advice on swapped axes."""
    try:
        lon, lat = float(position[0]), float(position[1])
    except (TypeError, ValueError, IndexError, KeyError):
        raise ValueError(f"{str(position)[:60]} is no position") from None
    if not is_on_earth(lat, lon):
        has_swapped_axes = abs(lon) <= 90 < abs(lat) <= 180
        way_out = "GeoJSON has the longitude first, and then the latitude" if has_swapped_axes else _REPROJECT
        raise ValueError(f"{lon:g}, {lat:g} are no degrees of longitude and latitude: {way_out}")
    return lat, lon


def _areas(tree: Any, properties: Any = None, name: Any = None) -> Iterator[Area]:
    """Areas of a GeoJSON tree: (kind, number) or None, tags, polygons as lists of rings; ValueError for a malformed one."""
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
        yield _identifier(known, name), _tags(known), [rings for rings in polygons if rings]


def _identifier(properties: dict[str, Any], name: Any) -> tuple[str, int] | None:
    """Kind and number in an identifier: `way/12` of Overpass turbo and lslam, a plain number of osmium and QGIS."""
    for value in (properties.get("@id"), properties.get("osm_id"), name):
        match = re.fullmatch(r"(?:(way|relation)/)?(-?\d{1,18})", str(value))
        if match:
            return match[1] or "way", int(match[2])
    return None


def _tags(properties: dict[str, Any]) -> dict[str, str]:
    """Tags of GeoJSON properties, as texts; those in a table `tags` too."""
    held = properties.get("tags")
    flat = {**properties, **(held if isinstance(held, dict) else {})}
    return {str(k): str(v) for k, v in flat.items() if isinstance(v, str | int | float) and not str(k).startswith("@")}
