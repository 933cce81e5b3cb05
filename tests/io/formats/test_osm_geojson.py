"""Outlines in GeoJSON read as the same buildings as in OpenStreetMap's own formats, and what is none is said to be none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osm_builders import ORIGIN, ExtractMaker, square_at

from lslam.core.errors import InputError
from lslam.core.geometry.geodesy import from_local
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.osm_data import ATTRIBUTION


def ring(x: float, y: float, side: float) -> list[list[float]]:
    corners = np.column_stack([square_at(x, y, side), np.zeros(4)])
    places = [[lon, lat] for lat, lon, _ in from_local(corners, ORIGIN)]
    return [*places, places[0]]


def feature(geometry: dict[str, Any], **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def polygon(*rings: list[list[float]]) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": list(rings)}


def written(path: Path, *features: dict[str, Any], **members: Any) -> Path:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features), **members}))
    return path


def test_geojson_and_osm_give_the_same_buildings(tmp_path: Path) -> None:
    maker = ExtractMaker()
    maker.square(7, 0, 0, 10, building="house", height="6.5")
    maker.square(8, 20, 0, 12)
    maker.square(9, 24, 4, 3)
    maker.relation(5, [(8, "outer"), (9, "inner")], type="multipolygon", building="yes")
    maker.square(11, 50, 0, 10, leisure="pitch")
    theirs = read_buildings(maker.write_xml(tmp_path / "a.osm"), ORIGIN)[1]
    path = written(
        tmp_path / "a.geojson",
        feature(polygon(ring(0, 0, 10)), **{"@id": "way/7", "building": "house", "height": 6.5}),
        feature(polygon(ring(20, 0, 12), ring(24, 4, 3)), osm_id="relation/5", tags={"building": "yes"}),
        feature(polygon(ring(50, 0, 10)), leisure="pitch"),
        feature({"type": "Point", "coordinates": [8.4, 49.0]}, building="entrance"),
    )
    ours = read_buildings(path, ORIGIN)[1]
    assert [b.osm_id for b in ours.buildings] == [b.osm_id for b in theirs.buildings] == ["way/7", "relation/5"]
    assert ours.buildings[0].height == 6.5
    for a, b in zip(ours.buildings, theirs.buildings, strict=True):
        for one, other in zip(a.footprints[0].rings, b.footprints[0].rings, strict=True):
            np.testing.assert_allclose(
                sorted(np.round(one, 2).tolist()), sorted(np.round(other, 2).tolist()), atol=0.011
            )
    assert ours.attribution == ATTRIBUTION


def test_outlines_without_tags_are_all_buildings(tmp_path: Path) -> None:
    parts = {"type": "MultiPolygon", "coordinates": [[ring(0, 0, 10)], [ring(30, 0, 10)]]}
    path = written(
        tmp_path / "footprints.json", feature(parts, id=3), feature(polygon(ring(60, 0, 5))), attribution="The city"
    )
    extract = read_buildings(path, ORIGIN)[1]
    assert sorted(len(b.footprints) for b in extract.buildings) == [1, 2]
    assert all(b.osm_id.split("/")[1].startswith("-") for b in extract.buildings)
    assert extract.attribution == "The city"
    bare = tmp_path / "bare.geojson"
    bare.write_text(json.dumps(polygon(ring(0, 0, 10))))
    np.testing.assert_allclose(read_buildings(bare, ORIGIN)[1].buildings[0].area, 100.0, rtol=1e-3)


def test_one_number_for_two_outlines_is_kept_once(tmp_path: Path) -> None:
    path = written(
        tmp_path / "a.geojson", *(feature(polygon(ring(x, 0, 9)), building="yes", osm_id=4) for x in (0, 20))
    )
    assert len({b.osm_id for b in read_buildings(path, ORIGIN)[1].buildings}) == 2


def test_a_building_on_the_antimeridian_is_in_one_piece(tmp_path: Path) -> None:
    across = [[179.9999, -17.0], [-179.9999, -17.0], [-179.9999, -16.9998], [179.9999, -16.9998], [179.9999, -17.0]]
    _, extract = read_buildings(written(tmp_path / "a.geojson", feature(polygon(across), building="yes")))
    (building,) = extract.buildings
    assert abs(abs(extract.origin[1]) - 180) < 1e-6
    np.testing.assert_allclose(building.area, 21.3 * 22.1, rtol=0.02)


def test_swapped_degrees_are_said_to_be_swapped_whichever_side_has_them_so(tmp_path: Path) -> None:
    corners = ring(0, 0, 10)
    hint = r"latitude and longitude are swapped, in --origin \(%s; latitude first\) or in the file \(GeoJSON has the longitude"
    right = written(tmp_path / "right.geojson", feature(polygon(corners), building="yes"))
    with pytest.raises(InputError, match=hint % "8.42290,49.01120"):
        read_buildings(right, ORIGIN[[1, 0, 2]])
    wrong = written(tmp_path / "wrong.geojson", feature(polygon([[lat, lon] for lon, lat in corners]), building="yes"))
    with pytest.raises(InputError, match=hint % "49.01120,8.42290"):
        read_buildings(wrong, ORIGIN)
    with pytest.raises(InputError, match="check --origin"):
        read_buildings(right, np.array([-ORIGIN[0], 108.4, 0.0]))


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        (
            {"type": "FeatureCollection", "crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}, "features": []},
            "its coordinates are in .*25832.*ogr2ogr",
        ),
        (polygon([[456000.0, 5428000.0], [456010.0, 5428000.0], [456010.0, 5428010.0], [456000.0, 5428000.0]]),
         "456000, 5.428e.06 are no degrees of longitude and latitude: turn it into longitude"),
        (polygon([[35.6, 139.7], [35.7, 139.7], [35.7, 139.8], [35.6, 139.7]]),
         "35.6, 139.7 are no degrees of longitude and latitude: GeoJSON has the longitude first"),
        (polygon([[8.0, 49.0], [8.1, 49.0], [8.0, 49.0]]), "fewer than four positions"),
        (polygon([[8.0, 49.0], ["east"], [8.1, 49.1], [8.0, 49.0]]), "is no position"),
        ({"type": "Polygon"}, "a Polygon without a list of rings"),
        ({"type": "FeatureCollection", "features": 1.5}, "a FeatureCollection without a list of features"),
        ({"type": ["Feature"], "geometries": 1}, "no list of elements"),
        ({"type": "FeatureCollection", "features": [feature({"type": "Point", "coordinates": [8, 49]})]},
         "holds no building outline"),
    ],
)  # fmt: skip
def test_what_is_no_outline_in_degrees_is_one_sentence(tmp_path: Path, document: dict[str, Any], sentence: str) -> None:
    path = tmp_path / "broken.geojson"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=sentence) as caught:
        read_buildings(path, ORIGIN)
    assert str(path) in str(caught.value)
