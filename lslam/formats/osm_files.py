"""OpenStreetMap files: nodes, ways and relations from XML, Overpass JSON or GeoJSON, and back to XML.

XML is parsed without entities or document types, so that a hostile file cannot grow in memory.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any
from xml.etree.ElementTree import Element, ParseError
from xml.sax.saxutils import quoteattr

from lslam.errors import InputError, cause
from lslam.formats.atomic import atomic_write
from lslam.formats.overpass_reply import ELEMENTS, OverpassReply, elements_of, is_geojson
from lslam.untrusted import JsonItems

ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0, openstreetmap.org/copyright"
GENERATOR = "lslam"
DECIMALS = 7  # of a degree, as in OpenStreetMap's own database: 1.1 cm
WAY_OUT = "fetch the extract again"
# Marks of byte order, the zeros of wide characters, and blanks, before the first that counts.
_BEFORE = b"\xef\xbb\xbf\xff\xfe\0 \t\r\n"
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
# First bytes of gzip, bzip2, xz, zip and Zstandard.
_COMPRESSED = (b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"PK\x03\x04", b"\x28\xb5\x2f\xfd")


@dataclass(frozen=True)
class Way:
    """A line through nodes; closed when the first and the last are one."""

    id: int
    nodes: tuple[int, ...]
    tags: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_closed(self) -> bool:
        """True for a ring."""
        return len(self.nodes) > 1 and self.nodes[0] == self.nodes[-1]


@dataclass(frozen=True)
class Member:
    """What a relation holds: kind `node`, `way` or `relation`, its number, its role."""

    kind: str
    ref: int
    role: str


@dataclass(frozen=True)
class Relation:
    """Elements that belong together."""

    id: int
    members: tuple[Member, ...]
    tags: Mapping[str, str] = field(default_factory=dict)


@dataclass
class OsmData:
    """An extract: nodes as (lat, lon) in deg, ways and relations by number.

    attribution : the words every output made from it must carry; None for a simulated place, which nobody surveyed
    versions : by (kind, number), of elements that were edited before, which the database asks for; all others have 1
    modified : (kind, number) of elements that differ from the database, as JOSM marks them in its files
    """

    nodes: dict[int, tuple[float, float]] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    attribution: str | None = ATTRIBUTION
    versions: dict[tuple[str, int], int] = field(default_factory=dict)
    modified: set[tuple[str, int]] = field(default_factory=set)
    _drawn: dict[int, list[tuple[float, float] | None]] = field(default_factory=dict, repr=False, compare=False)

    def add_version(self, kind: str, number: int, version: Any) -> None:
        """Remember an element's version where it says another than 1."""
        if version is not None and int(version) != 1:
            self.versions[kind, number] = int(version)

    def add_node(self, number: int, lat: Any, lon: Any) -> None:
        """Add a node; raises ValueError when it is not on the Earth."""
        values = (float(lat), float(lon))
        if not (
            math.isfinite(values[0]) and abs(values[0]) <= 90 and math.isfinite(values[1]) and abs(values[1]) <= 180
        ):
            raise ValueError(f"node {number} at lat {lat}, lon {lon}")
        self.nodes[number] = values

    def add_way(self, way: Way) -> None:
        """Add a way; a second copy without tags (Overpass' `out skel`) does not replace one with tags."""
        if way.tags or way.id not in self.ways:
            self.ways[way.id] = way

    def add_relation(self, relation: Relation) -> None:
        """Add a relation, as `add_way` does."""
        if relation.tags or relation.id not in self.relations:
            self.relations[relation.id] = relation

    def draw_way(self, number: int, places: Iterable[tuple[Any, Any] | None]) -> None:
        """Say where a way runs whose nodes have no numbers (Overpass' `out geom`); None of a node outside the box asked for."""
        self._drawn.setdefault(number, [None if p is None else (float(p[0]), float(p[1])) for p in places])

    def number_drawn(self) -> None:
        """When all is read: ways that are only drawn get nodes, with numbers below zero where the place has none yet."""
        at = {place: number for number, place in self.nodes.items()} if self._drawn else {}
        fresh = min([0, *self.nodes]) - 1
        for number, places in self._drawn.items():
            way = self.ways.get(number, Way(number, ()))
            if None in places or (way.nodes and all(node in self.nodes for node in way.nodes)):
                continue
            for place in places:
                if place is not None and place not in at:
                    self.add_node(fresh, *place)
                    at[place] = fresh
                    fresh -= 1
            self.ways[number] = replace(way, nodes=tuple(at[place] for place in places if place is not None))
        self._drawn.clear()


def read_osm(path: Path) -> OsmData:
    """Read an OSM XML file, a stored Overpass reply (JSON) or outlines in GeoJSON; the content decides, not the name.

    Raises InputError naming the file: missing, cut short, none of the three, with entities, with positions off the Earth.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(64)
        if start.startswith(_COMPRESSED) or b"OSMHeader" in start:
            raise InputError(
                f"{path} is compressed: turn it into plain XML first (gunzip, bunzip2, or osmium cat -o map.osm)"
            )
        first = start.lstrip(_BEFORE)[:1]
        if first not in (b"<", b"{", b"["):
            what = "is neither XML nor JSON" if first else "is empty"
            raise InputError(f"{path} {what}, so it is no OpenStreetMap extract: {WAY_OUT}")
        return _read_xml(path, start.startswith(_UTF16)) if first == b"<" else _read_json(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None


class GaveUpError(ValueError):
    """What Overpass says, `remark`, when it ran out of time or memory: the reply is valid JSON but incomplete."""

    def __init__(self, remark: Any) -> None:
        super().__init__(f"the server gave up: {str(remark)[:200]}")
        self.remark = str(remark)


def from_overpass(reply: Any) -> OsmData:
    """An Overpass reply (`[out:json]`), an `OverpassReply` or parsed already. Raises as `merged`."""
    return merged([reply])


def merged(replies: Iterable[Any]) -> OsmData:
    """One extract of many replies; what several hold is in it once.

    Raises ValueError saying what is wrong with one; GaveUpError, which is such, when a server did.
    """
    data = OsmData()
    for reply in replies:
        if isinstance(reply, OverpassReply):
            items = reply.items_of()
            _add_all(data, items)
            _check_reply(items.has_list, items.rest)
        else:
            _check_reply(isinstance(reply, dict) and isinstance(reply.get(ELEMENTS), list), reply)
            _add_all(data, reply[ELEMENTS])
    data.number_drawn()
    return data


def _check_reply(has_elements: bool, facts: Any) -> None:
    if not has_elements:
        raise ValueError("no list of elements, so this is no Overpass reply")
    if facts.get("remark"):
        raise GaveUpError(facts["remark"])


def _add_all(data: OsmData, elements: Iterable[Any]) -> None:
    for element in elements:
        try:
            _add_json(data, element)
        except (AttributeError, LookupError, TypeError, ArithmeticError) as error:
            raise ValueError(f"an element without {error}: {str(element)[:80]}") from None


def write_osm(path: Path, data: OsmData) -> None:
    """Write `data` as OSM XML 0.6, atomically, degrees with 7 decimals; what it read, or rounded, reads back equal."""
    with atomic_write(path) as stream:
        stream.write("".join(_xml_lines(data)).encode("utf-8", "replace"))


def _read_json(path: Path) -> OsmData:
    try:
        data = OsmData()
        with path.open("rb") as stream:
            items = JsonItems(stream, ELEMENTS)
            _add_all(data, items)
        if not items.has_list and is_geojson(items.rest):
            data = from_overpass({ELEMENTS: elements_of(items.rest)})
            data.attribution = items.rest.get("attribution", ATTRIBUTION) or None
            return data
        _check_reply(items.has_list, items.rest)
        data.number_drawn()
        return data
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is broken JSON, perhaps cut short ({error}): {WAY_OUT}") from None
    except ValueError as error:
        raise InputError(f"{path} cannot be used, {error}: {WAY_OUT}") from None


def _add_json(data: OsmData, element: dict[str, Any]) -> None:
    kind, number = element["type"], int(element.get("id", 0))
    data.add_version(kind, number, element.get("version"))
    tags = {sys.intern(str(key)): str(value) for key, value in element.get("tags", {}).items()}
    if kind == "node":
        data.add_node(number, element["lat"], element["lon"])
    elif kind == "way":
        nodes = tuple(int(n) for n in element.get("nodes", ()))
        # `out geom` says where nodes are beside their numbers, and of those outside its box nothing.
        for node, place in zip(nodes, element.get("geometry", ()), strict=False):
            if place is not None:
                data.add_node(node, place["lat"], place["lon"])
        if not nodes and "geometry" in element:
            data.draw_way(number, _places(element["geometry"]))
        data.add_way(Way(number, nodes, tags))
    elif kind == "relation":
        members = element.get("members", ())
        found = tuple(Member(str(m["type"]), int(m["ref"]), str(m.get("role", ""))) for m in members)
        for member in members:
            if member["type"] == "way" and "geometry" in member:
                data.draw_way(int(member["ref"]), _places(member["geometry"]))
        data.add_relation(Relation(number, found, tags))


def _places(geometry: list[Any]) -> list[tuple[Any, Any] | None]:
    """Where nodes without numbers are; None of those outside the box asked for, of which XML says nothing more either."""
    return [(place["lat"], place["lon"]) if place and "lat" in place else None for place in geometry]


def _read_xml(path: Path, is_wide: bool) -> OsmData:
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
    """Element by element, each forgotten once it is understood: a town's extract is large."""
    from defusedxml.ElementTree import iterparse

    data, root = OsmData(), None
    for event, element in iterparse(stream, events=("start", "end"), forbid_dtd=True):
        if root is None:
            root = element
            _check_root(path, root)
            _take_attribution(data, root)
        elif event == "end" and element.tag in ("node", "way", "relation"):
            _add_xml(data, element)
            root.clear()
    data.number_drawn()
    return data


def _check_root(path: Path, root: Element) -> None:
    if root.tag != "osm":
        raise InputError(f"{path} is XML but no OpenStreetMap extract: it begins with <{root.tag}>, not with <osm>")


def _take_attribution(data: OsmData, root: Element) -> None:
    """Whatever does not say that lslam made it up comes from OpenStreetMap."""
    if root.get("generator") == GENERATOR and not root.get("attribution"):
        data.attribution = None


def _add_xml(data: OsmData, element: Element) -> None:
    # JOSM marks deletions, the history API hides old versions: neither is on the ground.
    if element.get("action") == "delete" or element.get("visible") == "false":
        return
    number = int(element.attrib["id"])
    data.add_version(element.tag, number, element.get("version"))
    if element.get("action") == "modify":
        data.modified.add((element.tag, number))
    if element.tag == "node":
        data.add_node(number, element.attrib["lat"], element.attrib["lon"])
        return
    tags = {sys.intern(tag.attrib["k"]): tag.attrib["v"] for tag in element.iter("tag")}
    if element.tag == "way":
        corners = [n.attrib for n in element.iter("nd")]
        if corners and "ref" not in corners[0]:
            data.draw_way(number, _places(corners))
            corners = []
        for place in corners:
            if "lat" in place:
                data.add_node(int(place["ref"]), place["lat"], place["lon"])
        data.add_way(Way(number, tuple(int(place["ref"]) for place in corners), tags))
        return
    members = list(element.iter("member"))
    for member in members:
        if member.attrib["type"] == "way" and len(member):
            data.draw_way(int(member.attrib["ref"]), _places([n.attrib for n in member.iter("nd")]))
    found = tuple(Member(m.attrib["type"], int(m.attrib["ref"]), m.get("role", "")) for m in members)
    data.add_relation(Relation(number, found, tags))


def _xml_lines(data: OsmData) -> Iterator[str]:
    yield "<?xml version='1.0' encoding='UTF-8'?>\n"
    credit = f" attribution={quoteattr(data.attribution)}" if data.attribution else ""
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
            yield f'  <member type="{m.kind}" ref="{m.ref}" role={_quoted(m.role)}/>\n'
        yield from _tag_lines(relation.tags.items())
        yield " </relation>\n"
    yield "</osm>\n"


def _identity(data: OsmData, kind: str, number: int) -> str:
    action = ' action="modify"' if (kind, number) in data.modified else ""
    return f'id="{number}" version="{data.versions.get((kind, number), 1)}"{action}'


def _tag_lines(tags: Iterable[tuple[str, str]]) -> Iterator[str]:
    return (f"  <tag k={_quoted(key)} v={_quoted(value)}/>\n" for key, value in tags)


def _quoted(text: str) -> str:
    # XML has no way to write most control characters.
    return quoteattr("".join(c for c in text if c.isprintable() or c in "\t\n\u00a0"))
