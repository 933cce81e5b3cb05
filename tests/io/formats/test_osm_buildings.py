"""Which elements are buildings, with which outlines and heights: hand-made extracts with known answers, shapely as the judge."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osm_builders import ORIGIN, ExtractMaker, square_at
from shapely import LinearRing, MultiPolygon, Polygon, STRtree, box, points

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.building import Building, Footprint, footprint_polygon
from lslam.io.formats.kitti_layout import read_mcd_extrinsics
from lslam.io.formats.osm_buildings import (
    BuildingExtract,
    buildings_of,
    read_buildings,
)
from lslam.io.formats.osm_data import ATTRIBUTION
from lslam.io.formats.osm_files import read_osm, write_osm
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.osm.overpass import from_overpass
from lslam.simulation.osm_extract import osm_from_buildings

CLOSE = 1e-4  # m: the projection there and back is far better than a file's centimetre


def extract_of(maker: ExtractMaker) -> BuildingExtract:
    return buildings_of(from_overpass(maker.tree()), ORIGIN)


def shape_of(building: Building) -> MultiPolygon:
    return MultiPolygon([footprint_polygon(f) for f in building.footprints])


def test_a_closed_way_is_a_polygon_in_metres() -> None:
    maker = ExtractMaker()
    maker.square(7, 20, -30, 12.5, building="house", height="8.5 m")
    (building,) = extract_of(maker).buildings
    assert (building.osm_id, building.height, building.tags["building"]) == ("way/7", 8.5, "house")
    np.testing.assert_allclose(building.footprints[0].outer, square_at(20, -30, 12.5), atol=CLOSE)
    assert building.area == pytest.approx(12.5**2, abs=1e-2)
    np.testing.assert_allclose(building.middle, [26.25, -23.75], atol=CLOSE)


def test_outlines_run_counter_clockwise_whatever_the_way_does() -> None:
    maker = ExtractMaker()
    ids = maker.nodes(square_at(0, 0, 5)[::-1])
    maker.way(1, [*ids, ids[0]], building="yes")
    (building,) = extract_of(maker).buildings
    assert Polygon(building.footprints[0].outer).exterior.is_ccw
    assert building.footprints[0].area == pytest.approx(25, abs=1e-3)


def test_open_ways_are_skipped_and_counted() -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 5, building="yes")
    maker.way(2, maker.nodes(square_at(10, 0, 5)), building="yes")
    maker.way(3, maker.nodes([[0, 30], [9, 30]]), highway="service")
    extract = extract_of(maker)
    assert [b.osm_id for b in extract.buildings] == ["way/1"]
    assert extract.omissions == {"open way": 1}


@pytest.mark.parametrize(
    ("tags", "reason"),
    [
        ({"building": "no"}, "building=no"),
        ({"building": " No "}, "building=no"),
        ({"building": "yes", "layer": "-1"}, "underground"),
        ({"building": "yes", "layer": "-0.5"}, "underground"),
        ({"building": "garage", "location": "underground"}, "underground"),
    ],
)
def test_buildings_that_cannot_be_seen_are_skipped_and_counted(tags: dict[str, str], reason: str) -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 5, **tags)
    maker.square(2, 10, 0, 5)
    maker.relation(3, [(2, "outer")], type="multipolygon", **tags)
    extract = extract_of(maker)
    assert extract.buildings == []
    assert extract.omissions == {reason: 2}


@pytest.mark.parametrize("tags", [{"layer": "0"}, {"layer": "1"}, {"layer": "ground"}, {"location": "roof"}])
def test_what_stands_above_the_ground_stays(tags: dict[str, str]) -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 5, building="yes", **tags)
    assert len(extract_of(maker).buildings) == 1


def test_missing_border_nodes_drop_the_element() -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 5, building="yes")
    ids = maker.nodes(square_at(10, 0, 5))
    maker.way(2, [*ids, 999, ids[0]], building="yes")
    maker.square(3, 20, 0, 5)
    maker.relation(4, [(3, "outer"), (555, "outer")], type="multipolygon", building="yes")
    maker.relation(5, [(2, "outer")], type="multipolygon", building="yes")
    extract = extract_of(maker)
    assert [b.osm_id for b in extract.buildings] == ["way/1"]
    assert extract.omissions == {"nodes missing": 3}


def test_outer_parts_are_joined_whichever_way_they_run_and_inners_subtracted() -> None:
    maker = ExtractMaker()
    n = maker.nodes([[0, 0], [40, 0], [40, 30], [0, 30]])
    maker.way(1, [n[0], n[1]])
    maker.way(2, [n[2], n[1]])  # against the others
    maker.way(3, [n[2], n[3], n[0]])
    maker.square(4, 10, 10, 10)
    i = maker.nodes([[25, 10], [35, 10], [35, 20]])
    maker.way(5, [i[0], i[1]])
    maker.way(6, [i[0], i[2], i[1]])
    members = [(2, "outer"), (4, "inner"), (1, ""), (6, "inner"), (3, "outer"), (5, "inner")]
    maker.relation(9, members, type="multipolygon", building="yes", building__levels="3")
    (building,) = extract_of(maker).buildings
    expected = box(0, 0, 40, 30) - box(10, 10, 20, 20) - Polygon([[25, 10], [35, 10], [35, 20]])
    assert building.height == 9.0
    assert shape_of(building).is_valid
    assert shape_of(building).symmetric_difference(expected).area < 0.01
    assert building.area == pytest.approx(expected.area, abs=0.01)
    assert [len(hole) for hole in building.footprints[0].holes] == [4, 3]
    assert not any(Polygon(hole).exterior.is_ccw for hole in building.footprints[0].holes)
    assert "type" not in building.tags


def test_several_outers_are_one_building_with_each_hole_in_its_own() -> None:
    maker = ExtractMaker()
    for number, x, side in ((1, 0, 20), (2, 50, 20), (3, 55, 10)):
        maker.square(number, x, 5 if number == 3 else 0, side)
    maker.relation(9, [(1, "outer"), (2, "outer"), (3, "inner")], type="multipolygon", building="yes")
    (building,) = extract_of(maker).buildings
    assert [f.area for f in building.footprints] == pytest.approx([400, 300], abs=0.01)


def test_an_inner_ring_that_sticks_out_is_still_subtracted() -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 20)
    maker.square(2, 15, 5, 10)
    maker.relation(9, [(1, "outer"), (2, "inner")], type="multipolygon", building="yes")
    (building,) = extract_of(maker).buildings
    assert shape_of(building).symmetric_difference(box(0, 0, 20, 20) - box(15, 5, 25, 15)).area < 0.01


def test_rings_that_do_not_close_drop_the_multipolygon() -> None:
    maker = ExtractMaker()
    n = maker.nodes(square_at(0, 0, 10))
    maker.way(1, n[:3])
    maker.relation(9, [(1, "outer")], type="multipolygon", building="yes")
    maker.square(2, 50, 0, 5)
    maker.relation(8, [(2, "inner")], type="multipolygon", building="yes")
    extract = extract_of(maker)
    assert extract.buildings == []
    assert extract.omissions == {"rings that do not close": 2}


def test_an_outline_tagged_as_well_is_one_building_not_two() -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 20, building="yes")
    maker.square(2, 5, 5, 4, building="shed")
    maker.relation(9, [(1, "outer"), (2, "inner")], type="multipolygon", building="yes")
    extract = extract_of(maker)
    assert [b.osm_id for b in extract.buildings] == ["way/2", "relation/9"]
    assert extract.omissions == {"outline of a multipolygon already read": 1}


def test_other_relations_and_ways_are_ignored() -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 20, landuse="grass")
    maker.relation(2, [(1, "outer")], type="multipolygon", landuse="grass")
    maker.relation(3, [(1, "outline")], type="building", building="yes")
    extract = extract_of(maker)
    assert extract.buildings == []
    assert extract.omissions == {}


def test_degenerate_outlines_are_counted_and_crossed_ones_repaired() -> None:
    maker = ExtractMaker()
    line = maker.nodes([[0, 0], [5, 0]])
    maker.way(1, [line[0], line[1], line[0]], building="yes")
    flat = maker.nodes([[0, 0], [5, 0], [9, 0]])
    maker.way(2, [*flat, flat[0]], building="yes")
    bow = maker.nodes([[0, 20], [10, 30], [10, 20], [0, 30]])
    maker.way(3, [*bow, bow[0]], building="yes")
    extract = extract_of(maker)
    assert extract.omissions == {"no area": 2}
    (building,) = extract.buildings
    assert shape_of(building).is_valid
    assert [f.area for f in building.footprints] == pytest.approx([25, 25], abs=0.01)


def test_the_error_about_an_extract_without_buildings_lists_its_elements(tmp_path: Path) -> None:
    maker = ExtractMaker()
    maker.way(2, maker.nodes(square_at(10, 0, 5)), building="yes")
    path = maker.write_xml(tmp_path / "roads.osm")
    with pytest.raises(
        InputError, match=r"roads\.osm holds no building outline \(1 ways, 0 relations; left out: 1 x open"
    ):
        read_buildings(path, ORIGIN)


@pytest.mark.parametrize("origin", [[51.0, 8.4, 0], [-33.9, 151.2, 0], [49.0, -171.6, 0], [90.0, 0.0, 0]])
def test_an_origin_in_another_country_is_an_error(tmp_path: Path, origin: list[float]) -> None:
    maker = ExtractMaker()
    maker.square(1, 0, 0, 10, building="yes")
    with pytest.raises(InputError, match=r"a\.osm lies .* away from the origin: check --origin"):
        read_buildings(maker.write_xml(tmp_path / "a.osm"), np.array(origin))


def test_buildings_written_and_read_come_back_within_a_centimetre(tmp_path: Path) -> None:
    court = Footprint(square_at(60, 0, 30), (square_at(70, 10, 10)[::-1],))
    buildings = [
        Building("way/12", (Footprint(square_at(0, 0, 10)),), 7.3, tags={"building": "house", "name": "A & B"}),
        Building("way/-4", (Footprint(square_at(30, 0, 12)),)),
        Building("relation/5", (court, Footprint(square_at(0, 60, 8))), 12.0, tags={"building:levels": "4"}),
        Building("way/13", (court,), 9.0),
    ]
    write_osm(tmp_path / "map.osm", osm_from_buildings(buildings, ORIGIN, ATTRIBUTION))
    read = read_osm(tmp_path / "map.osm")
    assert read == osm_from_buildings(buildings, ORIGIN, ATTRIBUTION)
    assert all(number < 0 for number in read.nodes)
    back = {b.osm_id: b for b in buildings_of(read, ORIGIN).buildings}
    assert len(back) == 4
    for building in buildings[:3]:
        same = back[building.osm_id]
        assert same.height == building.height
        for mine, theirs in zip(building.footprints, same.footprints, strict=True):
            for a, b in zip(mine.rings, theirs.rings, strict=True):
                assert np.abs(a - b).max() < 0.01
    # A courtyard needs a multipolygon, and those have numbers of their own.
    (renamed,) = (b for name, b in back.items() if name.startswith("relation/-"))
    assert renamed.area == pytest.approx(800, abs=0.5)
    again = buildings_of(osm_from_buildings(list(back.values()), ORIGIN, None), ORIGIN)
    assert [b.osm_id for b in again.buildings] == list(back)
    for one, two in zip(back.values(), again.buildings, strict=True):
        np.testing.assert_allclose(one.footprints[0].outer, two.footprints[0].outer, atol=1e-6)


def test_the_real_extract_lies_where_its_readme_says(recordings: Callable[[str], Path]) -> None:
    """Walls of a real scan, placed by ground truth, lie on the outlines (1 deg and 0.5 m off at best, says the README)."""
    folder = recordings("mcd_kth_day_06") / "mcd_kth_day_06"
    extract = read_buildings(folder / "kth.osm", np.array([59.348268650, 18.073204280, 0.0]))[1]
    assert sum(b.osm_id.startswith("way/") for b in extract.buildings) == 71
    assert extract.attribution == ATTRIBUTION
    assert all(shape_of(b).is_valid for b in extract.buildings)
    outlines = STRtree([LinearRing(ring) for b in extract.buildings for f in b.footprints for ring in f.rings])

    def share_on_outlines(shift: tuple[float, float]) -> float:
        at = points(_walls_of_first_scan(folder)[:, :2] + shift)
        distance = outlines.query_nearest(at, return_distance=True, all_matches=False)[1]
        return float(np.mean(distance < 1.0))

    here = share_on_outlines((0, 0))
    assert here > 0.45
    assert all(here > 1.8 * share_on_outlines(shift) for shift in ((4, 0), (-4, 0), (0, 4), (0, -4)))


def _walls_of_first_scan(folder: Path) -> Any:
    """Points (N, 3) above 0.3 m cells that reach up 2.5 m and more, metres east and north of the README's position."""
    T_body_lidar = read_mcd_extrinsics(folder / "hhs_calib.yaml")
    assert T_body_lidar is not None
    T_world_lidar = read_trajectory(folder / "pose_inW.csv").poses[0] @ T_body_lidar
    scan = np.fromfile(folder / "data" / "0000000011.bin", "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    local = se3.apply(T_world_lidar, scan[np.linalg.norm(scan, axis=1) > 2])
    local -= [64.3932532565158, 66.4832330946657, 38.514]
    cells = np.unique(np.floor(local[:, :2] / 0.3), axis=0, return_inverse=True)[1].ravel()
    low, high = np.full(cells.max() + 1, np.inf), np.full(cells.max() + 1, -np.inf)
    np.minimum.at(low, cells, local[:, 2])
    np.maximum.at(high, cells, local[:, 2])
    return local[((high - low)[cells] > 2.5) & (local[:, 2] > 1.0)]
