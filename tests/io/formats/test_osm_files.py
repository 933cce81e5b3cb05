"""OpenStreetMap files: XML and Overpass JSON hold the same, writing loses nothing, broken files are said to be broken."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from osm_builders import ExtractMaker

from lslam.core.errors import InputError, OutputError
from lslam.io.formats.osm_buildings import buildings_of
from lslam.io.formats.osm_data import ATTRIBUTION, Member, OsmData, Relation, Way
from lslam.io.formats.osm_files import read_osm, write_osm
from lslam.osm.overpass import from_overpass


def small() -> ExtractMaker:
    maker = ExtractMaker()
    maker.square(7, 0, 0, 10, building="yes", name="Bäckerei")
    maker.square(8, 2, 2, 3)
    maker.relation(9, [(7, "outer"), (8, "inner")], type="multipolygon", building="yes")
    return maker


def test_xml_and_overpass_json_say_the_same(tmp_path: Path) -> None:
    xml, reply = read_osm(small().write_xml(tmp_path / "a.osm")), read_osm(small().write_json(tmp_path / "a.json"))
    assert xml.ways == reply.ways
    assert xml.relations == reply.relations
    assert list(xml.nodes) == list(reply.nodes)
    np.testing.assert_allclose(list(xml.nodes.values()), list(reply.nodes.values()), rtol=0, atol=1e-9)
    assert xml.attribution == reply.attribution == ATTRIBUTION
    assert xml.ways[7].tags["name"] == "Bäckerei"
    assert xml.relations[9].members == (Member("way", 7, "outer"), Member("way", 8, "inner"))


def test_a_byte_order_mark_and_leading_blanks_are_no_obstacle(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"\n  " + json.dumps(small().tree()).encode())
    assert len(read_osm(path).ways) == 2
    xml = small().write_xml(tmp_path / "a.osm")
    xml.write_bytes(b"\xef\xbb\xbf" + xml.read_bytes())
    assert len(read_osm(xml).ways) == 2


@pytest.mark.parametrize("code", ["utf-16", "UTF-16BE"])
def test_wide_characters_are_no_obstacle(code: str, tmp_path: Path) -> None:
    """A shell that redirects into UTF-16 leaves the declaration of UTF-8 as it is; without a mark the declaration is right."""
    path = small().write_xml(tmp_path / "a.osm")
    whole, text = read_osm(path), path.read_text("utf-8")
    path.write_bytes(text.replace("UTF-8", "UTF-8" if code == "utf-16" else code).encode(code))
    assert read_osm(path) == whole
    path.write_bytes(json.dumps(small().tree()).encode(code))
    assert read_osm(path).ways == whole.ways
    path.write_bytes(text.encode("utf-16")[:-7])
    with pytest.raises(InputError, match="is broken XML or cut short"):
        read_osm(path)


def test_what_is_written_reads_back_equal(tmp_path: Path) -> None:
    data = OsmData(attribution=ATTRIBUTION)
    data.add_node(-1, 59.3482687, 18.0732043)
    data.add_node(5, -33.8567844, -151.2152967)
    data.add_node(6, 0.0, 179.9999999)
    data.add_way(Way(-3, (-1, 5, 6, -1), {"building": "yes", "name": "Müller & Söhne \"<A>\"\n2. Hof 'b'"}))
    data.add_relation(Relation(4, (Member("way", -3, "outer"), Member("node", 5, "")), {"type": "multipolygon"}))
    write_osm(tmp_path / "map.osm", data)
    back = read_osm(tmp_path / "map.osm")
    assert back == data
    write_osm(tmp_path / "again.osm", back)
    assert (tmp_path / "again.osm").read_bytes() == (tmp_path / "map.osm").read_bytes()
    assert not list(tmp_path.glob("*.part"))


def test_degrees_are_exact_to_seven_decimals(tmp_path: Path) -> None:
    data = OsmData()
    data.add_node(1, 49.01120012345678, 8.42290098765432)
    write_osm(tmp_path / "map.osm", data)
    lat, lon = read_osm(tmp_path / "map.osm").nodes[1]
    assert abs(lat - 49.01120012345678) <= 0.5e-7
    assert abs(lon - 8.42290098765432) <= 0.5e-7


def test_control_characters_do_not_break_the_file(tmp_path: Path) -> None:
    data = OsmData()
    data.add_way(Way(1, (), {"note": "a\x00b\x0bc\ud800d"}))
    write_osm(tmp_path / "map.osm", data)
    assert read_osm(tmp_path / "map.osm").ways[1].tags["note"] == "abcd"


def test_only_what_lslam_made_up_needs_no_attribution(tmp_path: Path) -> None:
    made_up, real = OsmData(attribution=None), OsmData()
    write_osm(tmp_path / "a.osm", made_up)
    write_osm(tmp_path / "b.osm", real)
    assert read_osm(tmp_path / "a.osm").attribution is None
    assert ATTRIBUTION in (tmp_path / "b.osm").read_text(encoding="utf-8")
    assert read_osm(tmp_path / "b.osm").attribution == ATTRIBUTION


def test_deleted_elements_are_not_there_and_skeletons_do_not_erase_tags(tmp_path: Path) -> None:
    path = tmp_path / "a.osm"
    path.write_text(
        "<osm version='0.6'><node id='1' visible='false'/><way id='2' action='delete'><nd ref='1'/></way>"
        "<way id='3'><nd ref='4'/><tag k='building' v='yes'/></way><way id='3'><nd ref='4'/></way></osm>"
    )
    data = read_osm(path)
    assert data.nodes == {}
    assert data.ways == {3: Way(3, (4,), {"building": "yes"})}


def test_places_written_beside_the_numbers_of_nodes_are_taken(tmp_path: Path) -> None:
    """Overpass' `out geom`, as its web page exports; nodes outside the box asked for have none."""
    path = tmp_path / "a.json"
    places = [{"lat": 48.0, "lon": 11.0}, None, {"lat": 48.1, "lon": 11.1}]
    way = {"type": "way", "id": 1, "nodes": [4, 5, 6, 4], "geometry": [*places, places[0]], "tags": {"building": "yes"}}
    path.write_text(json.dumps({"elements": [way]}))
    reply = read_osm(path)
    assert reply.nodes == {4: (48.0, 11.0), 6: (48.1, 11.1)}
    assert reply.ways == {1: Way(1, (4, 5, 6, 4), {"building": "yes"})}
    path.write_text(
        "<osm><way id='1'><nd ref='4' lat='48.0' lon='11.0'/><nd ref='5'/><nd ref='6' lat='48.1' lon='11.1'/>"
        "<nd ref='4' lat='48.0' lon='11.0'/><tag k='building' v='yes'/></way></osm>"
    )
    xml = read_osm(path)
    assert (xml.nodes, xml.ways) == (reply.nodes, reply.ways)
    path.write_text(json.dumps({"elements": [{**way, "geometry": [{"lat": 48.0}]}]}))
    with pytest.raises(InputError, match="an element without 'lon'"):
        read_osm(path)


def bomb() -> bytes:
    levels = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    return f'<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY a0 "ha">{levels}]><osm><tag k="&a9;"/></osm>'.encode()


def test_ways_that_are_only_drawn_are_as_good_as_those_with_nodes(tmp_path: Path) -> None:
    """Overpass' `out geom` draws the members of relations, and `out tags geom` ways, without numbers of nodes."""
    maker = ExtractMaker()
    ((lat, lon), (lat_2, lon_2)) = (
        (float(e["lat"]), float(e["lon"])) for e in (maker.nodes([[0, 0], [10, 8]]), maker.elements)[1]
    )
    a, b, c, d = ({"lat": y, "lon": x} for y, x in ((lat, lon), (lat, lon_2), (lat_2, lon_2), (lat_2, lon)))
    members = [
        {"type": "way", "ref": 11, "role": "outer", "geometry": [a, b, c]},
        {"type": "way", "ref": 12, "role": "outer", "geometry": [c, d, a]},
        {"type": "node", "ref": 5, "role": "entrance", **a},
    ]
    house = {"type": "relation", "id": 9, "members": members, "tags": {"type": "multipolygon", "building": "yes"}}
    shed = {"type": "way", "id": 7, "geometry": [a, b, d, a], "tags": {"building": "yes"}}
    cut = {"type": "way", "id": 8, "geometry": [a, None, d, a], "tags": {"building": "yes"}}
    drawn = from_overpass({"elements": [house, shed, cut]})
    assert len(drawn.nodes) == 4, "one place is one node"
    assert max(drawn.nodes) < 0
    assert [len(drawn.ways[number].nodes) for number in (11, 12, 7, 8)] == [3, 3, 4, 0]
    extract = buildings_of(drawn, np.array([lat, lon, 0.0]))
    assert [round(one.area, 2) for one in extract.buildings] == [40.0, 80.0]
    assert extract.omissions == {"nodes missing": 1}

    def xml(corners: list[dict[str, float]]) -> str:
        return "".join(f'<nd lat="{place["lat"]!r}" lon="{place["lon"]!r}"/>' for place in corners)

    outline = "".join(
        f'<member type="way" ref="{m["ref"]}" role="outer">{xml(m["geometry"])}</member>' for m in members[:2]
    )
    (tmp_path / "a.osm").write_text(
        f'<osm><way id="7">{xml([a, b, d, a])}<tag k="building" v="yes"/></way><way id="8"><nd/>{xml([b, d])}</way>'
        f'<relation id="9">{outline}<tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation></osm>'
    )
    again = buildings_of(read_osm(tmp_path / "a.osm"), np.array([lat, lon, 0.0]))
    assert [round(one.area, 2) for one in again.buildings] == [40.0, 80.0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bomb(), "declares a document type or entities"),
        (b'<!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/passwd">]><osm>&x;</osm>', "declares a document type"),
        (b"<!DOCTYPE html><html><body>504</body></html>", "is a web page and no OpenStreetMap extract"),
        (b"<html><body>busy</body></html>", "begins with <html>, not with <osm>"),
        (b"", "is empty"),
        (b" \n", "is empty"),
        (b"hello there", "neither XML nor JSON"),
        (b"\x00\x01\x02\x03", "neither XML nor JSON"),
        (b"<osm><node id='1' lat='1' lon='2'/><way id='3'><nd re", "broken XML or cut short .*line 1"),
        (b"<osm><node id='1' lat='1' lon='2'/>", "broken XML or cut short"),
        (b"<osm><node id='1' lat='95' lon='2'/></osm>", "makes no sense .*node 1 at lat 95"),
        (b"<osm><node id='1' lat='nan' lon='2'/></osm>", "node 1 at lat nan"),
        (b"<osm><node id='1' lat='1'/></osm>", "makes no sense .*'lon'"),
        (b"<osm><way id='x'/></osm>", "makes no sense"),
        (b'{"elements": [', "broken JSON, perhaps cut short"),
        (b'{"elements": [{"type": "node", "id": 1}]}', "an element without 'lat'"),
        (b'{"elements": [{"type": "node", "id": 1, "lat": 99, "lon": 1}]}', "node 1 at lat 99"),
        (b'{"elements": ["node"]}', "an element without"),
        (b'{"version": 0.6}', "no Overpass reply"),
        (b"[1, 2]", "no Overpass reply"),
        (b'{"elements": [], "remark": "runtime error: Query timed out"}', "the server gave up: runtime error"),
        (b"\x1f\x8b\x08\x00rest", "is compressed"),
        (b"\x00\x00\x00\x0d\x0a\x09OSMHeader\x18", "is compressed"),
        (b"BZh91AY&SY", "is compressed: .*bunzip2"),
        (b"\xfd7zXZ\x00\x00\x04", "is compressed"),
        (b"PK\x03\x04\x14\x00", "is compressed"),
        (b"\x28\xb5\x2f\xfd\x04\x58", "is compressed"),
    ],
)
def test_bad_files_get_one_sentence_that_names_them(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.osm"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_osm(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_truncation_is_an_error(tmp_path: Path) -> None:
    for whole in (small().write_xml(tmp_path / "a.osm"), small().write_json(tmp_path / "a.json")):
        content = whole.read_bytes()
        for share in range(1, 20):
            cut = tmp_path / "cut"
            cut.write_bytes(content[: len(content) * share // 20])
            with pytest.raises(InputError, match="cut short"):
                read_osm(cut)


def test_missing_files_and_unwritable_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.osm cannot be read"):
        read_osm(tmp_path / "none.osm")
    with pytest.raises(InputError, match="cannot be read"):
        read_osm(tmp_path)
    with pytest.raises(OutputError, match="cannot be written"):
        write_osm(tmp_path / "no" / "map.osm", OsmData())


def test_an_overpass_reply_needs_no_file() -> None:
    assert set(from_overpass(small().tree()).ways) == {7, 8}
    with pytest.raises(ValueError, match="no Overpass reply"):
        from_overpass([])


def test_a_real_extract_comes_through_whole(recordings: Callable[[str], Path], tmp_path: Path) -> None:
    path = recordings("mcd_kth_day_06") / "mcd_kth_day_06" / "kth.osm"
    data = read_osm(path)
    text = path.read_text(encoding="utf-8")
    assert (len(data.nodes), len(data.ways)) == (text.count("<node "), text.count("<way "))
    assert len(data.relations) == text.count("<relation ")
    assert data.attribution == ATTRIBUTION
    write_osm(tmp_path / "copy.osm", data)
    assert read_osm(tmp_path / "copy.osm") == data
