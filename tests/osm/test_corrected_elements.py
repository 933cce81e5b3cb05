"""The change file: same numbers at new places, shared nodes kept where walls stay together and parted where not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from defusedxml import ElementTree
from numpy.typing import NDArray
from osm_builders import ORIGIN, ExtractMaker, square_at

from lslam.core.errors import InputError
from lslam.core.types.building import Building, BuildingCorrection, CorrectedMap
from lslam.io.formats.osm_buildings import buildings_of
from lslam.io.formats.osm_data import ATTRIBUTION, Member, OsmData, Way
from lslam.io.formats.osm_files import read_osm, write_osm
from lslam.osm.buildings_geojson import corrected_osm
from lslam.osm.overpass import from_overpass

Floats = NDArray[np.float64]


def pair() -> OsmData:
    """Two houses wall to wall, sharing two nodes, a fence on one of these, a house by itself and one with a court."""
    maker = ExtractMaker()
    left = maker.nodes(square_at(0, 0, 10))
    right = maker.nodes([(20, 0), (20, 10)])
    maker.way(1, [*left, left[0]], building="house")
    maker.way(2, [left[1], right[0], right[1], left[2], left[1]], building="house")
    maker.way(3, [left[1], *maker.nodes([(10, -8)])], barrier="fence")
    maker.square(4, 40, 0, 8, building="house")
    maker.square(5, 60, 0, 20)
    maker.square(6, 65, 5, 6)
    maker.relation(7, [(5, "outer"), (6, "inner")], type="multipolygon", building="yes")
    return from_overpass(maker.tree())


def correct(data: OsmData, displacements: dict[str, tuple[float, float, float]], sure: str = "way/1") -> OsmData:
    buildings = {b.osm_id: b for b in buildings_of(data, ORIGIN).buildings}
    found = [
        BuildingCorrection(buildings[name], np.array(d), np.eye(3) * (0.01 if name == sure else 1.0), "seen")
        for name, d in displacements.items()
    ]
    return corrected_osm(data, CorrectedMap(ORIGIN, tuple(found), "two-level"))


def places(data: OsmData, name: str) -> Building:
    return next(b for b in buildings_of(data, ORIGIN).buildings if b.osm_id == name)


def check_moved(before: OsmData, after: OsmData, name: str, displacement: tuple[float, float, float]) -> None:
    expected = places(before, name).displace(np.array(displacement))
    for one, other in zip(places(after, name).footprints, expected.footprints, strict=True):
        for ring, wanted in zip(one.rings, other.rings, strict=True):
            np.testing.assert_allclose(ring, wanted, atol=0.015)


def test_neighbours_that_move_together_keep_their_nodes() -> None:
    data, d = pair(), (0.7, -0.4, 0.0)
    after = correct(data, {"way/1": d, "way/2": d})
    check_moved(data, after, "way/1", d)
    check_moved(data, after, "way/2", d)
    assert after.ways == {1: data.ways[1], 2: data.ways[2]}
    assert after.edits == {("node", n) for n in (1, 2, 3, 4, 5, 6)}


def test_neighbours_that_part_share_no_node_any_more() -> None:
    data = pair()
    moves = {"way/1": (0.7, -0.4, 0.0), "way/2": (0.7, 0.3, 0.02)}
    after = correct(data, moves, sure="way/2")
    for name, d in moves.items():
        check_moved(data, after, name, d)
    assert after.ways[2] == data.ways[2]
    new = set(after.ways[1].nodes) - set(data.ways[1].nodes)
    assert len(new) == 2
    assert all(n < 0 for n in new)
    assert after.ways[1].is_ring
    assert after.ways[1].tags == data.ways[1].tags
    assert ("way", 1) in after.edits
    assert ("way", 2) not in after.edits


def test_a_neighbour_that_was_not_corrected_is_not_dragged_along() -> None:
    data, d = pair(), (0.7, -0.4, 0.0)
    after = correct(data, {"way/1": d})
    check_moved(data, after, "way/1", d)
    assert set(after.ways) == {1}
    assert after.nodes[2] == data.nodes[2]
    assert ("node", 2) not in after.edits
    assert len([n for n in after.ways[1].nodes if n < 0]) == 2


def test_courtyards_move_with_their_building_and_relations_stay_whole() -> None:
    data, d = pair(), (-1.0, 0.5, 0.03)
    after = correct(data, {"relation/7": d})
    check_moved(data, after, "relation/7", d)
    assert after.relations == {7: data.relations[7]}
    assert set(after.ways) == {5, 6}


def test_a_member_that_is_no_outline_and_that_the_border_cuts_is_left_out() -> None:
    data, d = pair(), (-1.0, 0.5, 0.0)
    data.add_way(Way(8, (next(iter(data.nodes)), 999), {"building:part": "yes"}))
    members = (*data.relations[7].members, Member("way", 8, "part"), Member("way", 9, "part"))
    data.relations[7] = replace(data.relations[7], members=members)
    after = correct(data, {"relation/7": d})
    check_moved(data, after, "relation/7", d)
    assert set(after.ways) == {5, 6}
    assert after.relations[7].members == members


def test_what_stays_is_not_edited() -> None:
    after = correct(pair(), {"way/4": (0.0, 0.0, 0.0), "way/1": (0.004, 0.0, 0.0)})
    assert after.edits == set()
    assert after.nodes[9] == pair().nodes[9]


def test_an_editor_gets_versions_and_marks_and_the_file_reads_back(tmp_path: Path) -> None:
    data = pair()
    data.versions = {("node", 1): 4, ("way", 1): 12, ("way", 3): 5}
    after = correct(data, {"way/1": (0.7, -0.4, 0.1), "way/4": (0.0, 0.0, 0.0)})
    after = replace(after, attribution=ATTRIBUTION)
    assert after.versions == {("node", 1): 4, ("way", 1): 12}
    write_osm(tmp_path / "buildings.osm", after)
    text = (tmp_path / "buildings.osm").read_text(encoding="utf-8")
    assert '<node id="1" version="4" action="modify" lat=' in text
    assert '<way id="1" version="12" action="modify">' in text
    assert '<way id="4" version="1">' in text
    assert "OpenStreetMap contributors, ODbL 1.0" in text
    back = read_osm(tmp_path / "buildings.osm")
    np.testing.assert_allclose(list(back.nodes.values()), list(after.nodes.values()), rtol=0, atol=5.1e-8)
    assert replace(back, nodes=after.nodes) == after


def test_an_editor_finds_nothing_missing(tmp_path: Path) -> None:
    """What JOSM refuses a file for, or asks the server: numbers, versions, references; told by plain XML."""
    data = pair()
    data.versions = {("node", 1): 4, ("relation", 7): 3}
    moves = {
        "way/1": (0.7, -0.4, 0.0),
        "way/2": (0.7, 0.3, 0.02),
        "way/4": (0.5, 0.0, 0.0),
        "relation/7": (-1.0, 0.5, 0.0),
    }
    write_osm(tmp_path / "buildings.osm", correct(data, moves, sure="way/2"))
    root = ElementTree.parse(tmp_path / "buildings.osm").getroot()
    assert (root.tag, root.get("version")) == ("osm", "0.6")
    numbers: dict[str, list[int]] = {
        kind: [int(e.get("id")) for e in root.iter(kind)] for kind in ("node", "way", "relation")
    }
    assert min(numbers["node"]) < 0 < max(numbers["node"]), "nodes that parted are new ones"
    for kind, found in numbers.items():
        assert len(set(found)) == len(found) > 0
        assert 0 not in found
        for element in root.iter(kind):
            assert int(element.get("version")) >= 1
            assert element.get("action") in (None, "modify")
            assert int(element.get("id")) > 0 or element.get("action") == "modify"
    assert all(abs(float(n.get("lat"))) <= 90 and abs(float(n.get("lon"))) <= 180 for n in root.iter("node"))
    for way in root.iter("way"):
        refs = [int(nd.get("ref")) for nd in way.iter("nd")]
        assert set(refs) <= set(numbers["node"])
        assert refs[0] == refs[-1]
        assert len(set(refs)) == len(refs) - 1 >= 3
    for member in root.iter("member"):
        assert int(member.get("ref")) in numbers[member.get("type")]
        assert member.get("role") in ("outer", "inner")


def test_a_version_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.osm"
    path.write_text('<osm version="0.6"><node id="1" version="x" lat="1" lon="2"/></osm>')
    with pytest.raises(InputError, match="holds an element that makes no sense"):
        read_osm(path)
