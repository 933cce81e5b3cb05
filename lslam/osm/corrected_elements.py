"""Corrected buildings as OpenStreetMap elements: the same numbers at new places, marked as an editor marks its changes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lslam.core.geometry.geodesy import from_local, to_local
from lslam.core.types.arrays import Floats
from lslam.core.types.building import Building, BuildingCorrection, CorrectedMap, about
from lslam.io.formats.osm_data import DECIMALS, OsmData

ONE_NODE = 0.05  # m; a node that its buildings want nearer together than this stays one node
STAYS = 0.01  # m; what moves less is not edited


def corrected_osm(data: OsmData, found: CorrectedMap) -> OsmData:
    """The buildings of `found` with all their nodes, moved, as an extract to open in an editor (JOSM).

    Nodes and ways keep their numbers and versions; those that differ from `data` are `modified`. A node that several
    buildings share and that they no longer agree on stays with the one known best; the others get new nodes, with numbers
    below zero. A building of `data` that is not in `found` holds its nodes where they are. What the run found absent is not
    deleted: it is for a mapper to decide.
    """
    owners = {_element(c.building): c for c in found.buildings}
    result = OsmData(attribution=found.attribution)
    wishes: dict[int, list[_NodeTarget]] = {}
    for name, correction in owners.items():
        ways = sorted(_ways_of(data, name))
        for number in ways:
            result.add_way(data.ways[number])
            result.nodes.update((node, data.nodes[node]) for node in data.ways[number].nodes)
        for wish in _wishes(data, ways, correction, found.origin):
            wishes.setdefault(wish.node, []).append(wish)
        if name[0] == "relation":
            result.add_relation(data.relations[name[1]])
    for node in _held(data, owners) & set(wishes):
        was = wishes[node][0].was
        wishes[node].append(_NodeTarget(node, (), was, was, np.inf))
    _place(result, wishes, found.origin)
    kept = {(kind, number) for kind, numbers in _numbers(result) for number in numbers}
    result.versions = {key: version for key, version in data.versions.items() if key in kept}
    return result


@dataclass(frozen=True)
class _NodeTarget:
    """Where, m, one building wants one of its nodes, where that is on the map, its ways through it, how well it knows."""

    node: int
    ways: tuple[int, ...]
    place: Floats
    was: Floats
    confidence: float


def _wishes(data: OsmData, ways: list[int], correction: BuildingCorrection, origin: Floats) -> list[_NodeTarget]:
    """One for each node of a building."""
    nodes = list(dict.fromkeys(node for number in ways for node in data.ways[number].nodes))
    rotation, shift = about(correction.building.middle, correction.displacement)
    was = to_local(np.array([(*data.nodes[node], 0.0) for node in nodes]).reshape(-1, 3), origin)[:, :2]
    return [
        _NodeTarget(node, tuple(n for n in ways if node in data.ways[n].nodes), place, old, correction.confidence)
        for node, place, old in zip(nodes, was @ rotation.T + shift, was, strict=True)
    ]


def _place(result: OsmData, wishes: dict[int, list[_NodeTarget]], origin: Floats) -> None:
    """Move nodes to where they are wanted; part those that are wanted in several places."""
    fresh = iter(range(min([0, *result.nodes, *result.ways]) - 1, -(2**62), -1))
    for node, wanted in wishes.items():
        for group in _agreeing(sorted(wanted, key=lambda w: -w.confidence)):
            best = group[0]
            is_first = best is max(wanted, key=lambda w: w.confidence)
            if is_first and np.linalg.norm(best.place - best.was) < STAYS:
                continue
            number = node if is_first else next(fresh)
            lat, lon, _ = from_local(np.array([[*best.place, 0.0]]), origin)[0].tolist()
            result.add_node(number, round(lat, DECIMALS), round(lon, DECIMALS))
            result.modified.add(("node", number))
            for way in [] if is_first else [way for wish in group for way in wish.ways]:
                held = result.ways[way]
                result.ways[way] = replace(held, nodes=tuple(number if n == node else n for n in held.nodes))
                result.modified.add(("way", way))


def _agreeing(wanted: list[_NodeTarget]) -> list[list[_NodeTarget]]:
    """Wishes in groups that want one place, the best known first."""
    groups: list[list[_NodeTarget]] = []
    for wish in wanted:
        near = [g for g in groups if np.linalg.norm(wish.place - g[0].place) <= ONE_NODE]
        if near:
            near[0].append(wish)
        else:
            groups.append([wish])
    return groups


def _element(building: Building) -> tuple[str, int]:
    kind, number = building.osm_id.split("/")
    return kind, int(number)


def _ways_of(data: OsmData, element: tuple[str, int]) -> set[int]:
    """Numbers of the ways of an element that are whole: no outline, as an extract's border may cut others."""
    kind, number = element
    members = data.relations[number].members if kind == "relation" and number in data.relations else ()
    ways = {number} if kind == "way" else {m.ref for m in members if m.kind == "way"}
    return {n for n in ways & set(data.ways) if all(node in data.nodes for node in data.ways[n].nodes)}


def _held(data: OsmData, corrected: Iterable[tuple[str, int]]) -> set[int]:
    """Nodes of buildings that were not corrected."""
    known = set(corrected)
    inside = {number for name in known for number in _ways_of(data, name)}
    names = [("way", way.id) for way in data.ways.values() if "building" in way.tags and way.id not in inside]
    names += [("relation", r.id) for r in data.relations.values() if "building" in r.tags]
    return {node for name in names if name not in known for n in _ways_of(data, name) for node in data.ways[n].nodes}


def _numbers(data: OsmData) -> tuple[tuple[str, Iterable[int]], ...]:
    return ("node", data.nodes), ("way", data.ways), ("relation", data.relations)
