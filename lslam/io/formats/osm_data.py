"""Elements of OpenStreetMap: nodes, ways and relations, and areas made of them."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0, openstreetmap.org/copyright"
DECIMALS = 7  # of a degree, as in OpenStreetMap's own database: 1.1 cm
Place = tuple[float, float]  # lat, lon, deg


def is_on_earth(lat: float, lon: float) -> bool:
    """True for degrees of latitude and longitude; False for NaN."""
    return abs(lat) <= 90 and abs(lon) <= 180


@dataclass(frozen=True)
class Way:
    """A line through nodes; closed when the first and the last are one."""

    id: int
    nodes: tuple[int, ...]
    tags: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_ring(self) -> bool:
        """True for a ring."""
        return len(self.nodes) > 1 and self.nodes[0] == self.nodes[-1]


@dataclass(frozen=True)
class Member:
    """Reference to a member of a relation: kind `node`, `way` or `relation`, number, and role."""

    kind: str
    ref: int
    role: str


@dataclass(frozen=True)
class Relation:
    """Group of elements with tags, such as a multipolygon."""

    id: int
    members: tuple[Member, ...]
    tags: Mapping[str, str] = field(default_factory=dict)


@dataclass
class OsmData:
    """An extract: nodes as (lat, lon) in deg, ways and relations by number.

    attribution : the credit that every output made from it must carry; None for a simulated place
    versions : by (kind, number), of elements that were edited before, which the database requires; all others have 1
    edits : (kind, number) of elements that differ from the database, as JOSM marks them in its files
    """

    nodes: dict[int, tuple[float, float]] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    attribution: str | None = ATTRIBUTION
    versions: dict[tuple[str, int], int] = field(default_factory=dict)
    edits: set[tuple[str, int]] = field(default_factory=set)
    _outlines: dict[int, list[tuple[float, float] | None]] = field(default_factory=dict, repr=False, compare=False)

    def add_node(self, number: int, lat: Any, lon: Any) -> None:
        """Add a node; raises ValueError when it is not on the Earth."""
        place = (float(lat), float(lon))
        if not is_on_earth(*place):
            raise ValueError(f"node {number} at lat {lat}, lon {lon}")
        self.nodes[number] = place

    def add_way(self, way: Way) -> None:
        """Add a way; a second copy without tags (Overpass' `out skel`) does not replace one with tags."""
        if way.tags or way.id not in self.ways:
            self.ways[way.id] = way

    def add_relation(self, relation: Relation) -> None:
        """Add a relation, as `add_way` does."""
        if relation.tags or relation.id not in self.relations:
            self.relations[relation.id] = relation

    def add_element(self, element: Mapping[str, Any]) -> None:
        """Add an element of an Overpass reply in JSON. Raises LookupError, TypeError or ValueError if it is malformed."""
        kind, number = element["type"], int(element.get("id", 0))
        if (version := element.get("version")) is not None and int(version) != 1:
            self.versions[kind, number] = int(version)
        tags = {sys.intern(str(key)): str(value) for key, value in element.get("tags", {}).items()}
        if kind == "node":
            self.add_node(number, element["lat"], element["lon"])
        elif kind == "way":
            nodes = tuple(int(n) for n in element.get("nodes", ()))
            # `out geom` says where nodes are beside their numbers, and of those outside its box nothing.
            for node, place in zip(nodes, element.get("geometry", ()), strict=False):
                if place is not None:
                    self.add_node(node, place["lat"], place["lon"])
            if not nodes and "geometry" in element:
                self.draw_way(number, element["geometry"])
            self.add_way(Way(number, nodes, tags))
        elif kind == "relation":
            members = element.get("members", ())
            own = tuple(Member(str(m["type"]), int(m["ref"]), str(m.get("role", ""))) for m in members)
            for member in members:
                if member["type"] == "way" and "geometry" in member:
                    self.draw_way(int(member["ref"]), member["geometry"])
            self.add_relation(Relation(number, own, tags))

    def draw_way(self, number: int, geometry: Iterable[Mapping[str, Any] | None]) -> None:
        """Store positions of a way whose nodes have no numbers (Overpass' `out geom`); None outside the requested box."""
        places = [(float(p["lat"]), float(p["lon"])) if p and "lat" in p else None for p in geometry]
        self._outlines.setdefault(number, places)

    def number_outlines(self) -> None:
        """Give node numbers to ways that have positions only; call it after reading. Ways with missing parts stay undrawn.

        New nodes get negative numbers; existing nodes at the same position are reused.
        """
        at = {place: number for number, place in self.nodes.items()} if self._outlines else {}
        fresh = min([0, *self.nodes]) - 1
        for number, places in self._outlines.items():
            way = self.ways.get(number, Way(number, ()))
            if None in places or (way.nodes and all(node in self.nodes for node in way.nodes)):
                continue
            for place in places:
                if place is not None and place not in at:
                    self.add_node(fresh, *place)
                    at[place] = fresh
                    fresh -= 1
            self.ways[number] = replace(way, nodes=tuple(at[place] for place in places if place is not None))
        self._outlines.clear()


class AreaMaker:
    """Adds areas to `data`: one outline without holes is a way, all else a multipolygon.

    Nodes, and elements without a number, get negative numbers, which no element of OpenStreetMap has, and none of
    those `numbers`. With `shares_nodes`, corners at the same position are one node.
    """

    def __init__(self, data: OsmData, numbers: Collection[int], shares_nodes: bool) -> None:
        self._data, self._shares_nodes = data, shares_nodes
        self._numbers = (number for number in count(-1, -1) if number not in numbers)
        self._at: dict[Place, int] = {}

    def add(
        self,
        name: tuple[str, int] | None,
        polygons: Sequence[Sequence[Iterable[Place]]],
        tags: Mapping[str, str],
        tags_of_relation: Mapping[str, str],
    ) -> None:
        """Add the element `name`, kind and number, of polygons whose first ring is the outline; rings are closed or not.

        A way that has several rings cannot keep its number: relations have their own.
        """
        kind, number = name or ("way", None)
        if kind == "way" and len(polygons) == 1 == len(polygons[0]):
            self._way(polygons[0][0], number, tags)
            return
        members = tuple(
            Member("way", self._way(ring, None, {}), "inner" if k else "outer")
            for rings in polygons
            for k, ring in enumerate(rings)
        )
        if kind != "relation" or number is None:
            number = next(self._numbers)
        self._data.add_relation(Relation(number, members, tags_of_relation))

    def _way(self, ring: Iterable[Place], number: int | None, tags: Mapping[str, str]) -> int:
        """Add a closed way of the ring; returns its number, a new negative one if `number` is None."""
        if number is None:
            number = next(self._numbers)
        nodes = [self._node(place) for place in ring]
        nodes += nodes[:1] if nodes[0] != nodes[-1] else []
        self._data.add_way(Way(number, tuple(nodes), tags))
        return number

    def _node(self, place: Place) -> int:
        """Number of the node at a place, added unless nodes are shared and it exists."""
        if not self._shares_nodes or place not in self._at:
            self._at[place] = next(self._numbers)
            self._data.add_node(self._at[place], *place)
        return self._at[place]
