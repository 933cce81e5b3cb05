"""A scene's extract: the exact map is where the walls are, the perturbed one is the exact one plus what the record says."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building_errors import map_errors
from numpy.typing import NDArray
from shapely import LineString, MultiPolygon, STRtree, affinity, get_num_coordinates, union_all

from lslam.core.errors import InputError, OutputError
from lslam.core.types.building import Building, Footprint, footprint_polygon
from lslam.io.formats.osm_buildings import buildings_of
from lslam.io.formats.osm_data import ATTRIBUTION
from lslam.io.formats.osm_files import read_osm, write_osm
from lslam.simulation.city import City
from lslam.simulation.curve import flat, rolling
from lslam.simulation.osm_city import build_osm_city
from lslam.simulation.osm_extract import (
    Change,
    Extracts,
    MapFaults,
    city_buildings,
    draw_perturbation,
    osm_from_buildings,
    perturb,
    read_perturbation,
    write_extracts,
    write_perturbation,
)
from lslam.simulation.osm_place import read_extract
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import Surface

ORIGIN = np.array([49.0112, 8.4229, 112.8])
CM = 0.01
NONE = MapFaults(0.0, shift_share=0, turn_share=0, simplify_share=0, merge_share=0, missing=0, new=0)


def rectangle(x: float, y: float, width: float, depth: float) -> NDArray[np.float64]:
    return np.array([[x, y], [x + width, y], [x + width, y + depth], [x, y + depth]], np.float64)


def village() -> list[Building]:
    """Forty buildings: pairs 1 m apart, every fourth with a bay to lose, one with a courtyard."""
    found = []
    for k in range(40):
        x, y = 45.0 * (k % 10) + (11.0 if k % 2 else 30.0), 40.0 * (k // 10)
        outline = rectangle(x, y, 25.0, 12.0)
        if k % 4 == 0:
            outline = np.insert(outline, 1, [[x + 8, y], [x + 8, y - 0.6], [x + 12, y - 0.6], [x + 12, y]], axis=0)
        found.append(Building(f"way/{100 + k}", (Footprint(outline),), 6.0, tags={"building": "yes"}))
    court = Footprint(rectangle(0, 200, 40, 40), (rectangle(10, 210, 10, 10)[::-1],))
    return [*found, Building("relation/7", (court,), 12.0)]


@pytest.fixture(scope="module")
def block() -> City:
    return simulate("block").city


def polygon(building: Building) -> Any:
    return MultiPolygon([footprint_polygon(f) for f in building.footprints])


def distance_to_walls(city: City, outlines: list[NDArray[Any]]) -> NDArray[np.float64]:
    """From points every 0.25 m of the outlines to the nearest upright wall of the mesh, seen from above."""
    mesh = city.mesh
    upright = (mesh.surfaces == Surface.WALL) & (np.abs(mesh.normals[:, 2]) < 1e-3)
    corners = mesh.vertices[mesh.faces[upright], :2].astype(np.float64)
    # An upright triangle is a line from above, between the two corners farthest apart.
    spans = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmax(axis=1)
    rows = np.arange(len(corners))
    ends = np.stack([corners[rows, spans], corners[rows, (spans + 1) % 3]], axis=1)
    walls = STRtree([LineString(pair) for pair in ends])
    samples = []
    for ring in outlines:
        line = LineString([*ring, ring[0]])
        samples += [line.interpolate(s) for s in np.arange(0, line.length, 0.25)]
    return np.asarray(walls.query_nearest(samples, return_distance=True, all_matches=False)[1])


def read_map(path: Path) -> list[Building]:
    return buildings_of(read_osm(path), ORIGIN).buildings


def rings_of(buildings: list[Building]) -> list[NDArray[Any]]:
    return [ring for b in buildings for f in b.footprints for ring in f.rings]


def test_walls_of_a_generated_town_stand_on_its_map(block: City, tmp_path: Path) -> None:
    extracts = write_extracts(tmp_path, block, ORIGIN, np.random.default_rng(0))
    exact = read_map(extracts.exact)
    assert len(exact) == len(block.footprints)
    assert distance_to_walls(block, rings_of(exact)).max() < CM
    assert [b.height for b in exact] == [round(h, 1) for h in block.heights]
    off = distance_to_walls(block, rings_of(read_map(extracts.perturbed)))
    assert np.median(off) > 0.3


def test_walls_of_a_city_raised_from_a_map_stand_on_its_map(tmp_path: Path) -> None:
    city = build_osm_city(village(), rolling(np.random.default_rng(0)), np.random.default_rng(1))
    exact = read_map(write_extracts(tmp_path, city, ORIGIN, np.random.default_rng(0)).exact)
    assert [b.osm_id for b in exact] == [b.osm_id for b in village()]
    assert distance_to_walls(city, rings_of(exact)).max() < CM


def reproduced(extracts: Extracts, folder: Path) -> bytes:
    """The perturbed file made again from the exact one and the record alone."""
    data = read_osm(extracts.exact)
    again = perturb(buildings_of(data, ORIGIN).buildings, read_perturbation(extracts.record))
    write_osm(folder / "again.osm", osm_from_buildings(again, ORIGIN, data.attribution))
    return (folder / "again.osm").read_bytes()


@pytest.mark.parametrize("seed", range(4))
def test_the_record_makes_the_perturbed_map_from_the_exact_one(block: City, tmp_path: Path, seed: int) -> None:
    raised = build_osm_city(village(), flat(), np.random.default_rng(1), attribution=ATTRIBUTION)
    for name, city in (("block", block), ("village", raised)):
        extracts = write_extracts(tmp_path / name, city, ORIGIN, np.random.default_rng(seed))
        assert reproduced(extracts, tmp_path) == extracts.perturbed.read_bytes()
        assert extracts.perturbed.read_bytes() != extracts.exact.read_bytes()
        assert read_perturbation(extracts.record).changes == extracts.perturbation.changes


def test_same_seed_same_bytes(block: City, tmp_path: Path) -> None:
    def written(name: str, seed: int) -> list[bytes]:
        e = write_extracts(tmp_path / name, block, ORIGIN, np.random.default_rng(seed))
        return [path.read_bytes() for path in (e.exact, e.perturbed, e.record)]

    first = written("a", 5)
    assert written("b", 5) == first
    assert written("a", 5) == first, "written over itself"
    other = written("c", 6)
    assert other[0] == first[0]
    assert other[1] != first[1]


def test_every_kind_of_fault_is_there_and_each_building_is_on_record() -> None:
    p = draw_perturbation(village(), MapFaults(), np.random.default_rng(2))
    assert [c.id for c in p.changes] == [b.osm_id for b in village()]
    assert np.hypot(*p.shift_m) == pytest.approx(1.5)
    counts = {
        "missing": sum(c.missing for c in p.changes),
        "merged": sum(bool(c.merged_with) for c in p.changes),
        "swallowed": sum(c.merged_into is not None for c in p.changes),
        "simplified": sum(c.simplify_m > 0 for c in p.changes),
        "turned": sum(c.turn_rad != 0 for c in p.changes),
        "shifted": sum(c.shift_m != (0, 0) for c in p.changes),
        "new": len(p.future_buildings),
    }
    assert counts.pop("simplified") in range(3, 7)
    assert counts == {"missing": 3, "merged": 2, "swallowed": 2, "turned": 5, "shifted": 10, "new": 2}
    assert all(0 < abs(c.turn_rad) <= np.radians(4) for c in p.changes if c.turn_rad)
    assert all(0 < np.hypot(*c.shift_m) <= 1.5 for c in p.changes if c.shift_m != (0, 0))


def test_without_faults_the_copy_is_the_original(block: City, tmp_path: Path) -> None:
    extracts = write_extracts(tmp_path, block, ORIGIN, np.random.default_rng(0), NONE)
    assert extracts.perturbed.read_bytes() == extracts.exact.read_bytes()


def test_a_shifted_map_is_shifted_and_nothing_else() -> None:
    p = draw_perturbation(village(), replace(NONE, offset=2.0), np.random.default_rng(0))
    for before, after in zip(village(), perturb(village(), p), strict=True):
        for a, b in zip(rings_of([before]), rings_of([after]), strict=True):
            np.testing.assert_allclose(b - a, np.broadcast_to(p.shift_m, a.shape), atol=1e-9)


def test_turned_shifted_and_simplified_buildings_against_shapely() -> None:
    """shapely's own rotation, translation and simplification give the same outlines."""
    faults = replace(NONE, turn_share=0.5, shift_share=0.5, simplify_share=0.2)
    p = draw_perturbation(village(), faults, np.random.default_rng(1))
    assert any(c.turn_rad and c.simplify_m for c in p.changes)
    after = {b.osm_id: polygon(b) for b in perturb(village(), p)}
    for building, change in zip(village(), p.changes, strict=True):
        expected = polygon(building).simplify(change.simplify_m)
        lost = get_num_coordinates(polygon(building)) - get_num_coordinates(expected)
        assert (lost > 0) == (change.simplify_m > 0)
        expected = affinity.rotate(expected, change.turn_rad, origin="center", use_radians=True)
        expected = affinity.translate(expected, *change.shift_m)
        assert after[building.osm_id].symmetric_difference(expected).area < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_what_moves_a_drawn_building_back_moves_it_to_where_it_stands(seed: int) -> None:
    exact = village()
    drawn = draw_perturbation(exact, MapFaults(2.0, simplify_share=0, merge_share=0), np.random.default_rng(seed))
    on_map, errors = {b.osm_id: b for b in perturb(exact, drawn)}, map_errors(exact, drawn)
    assert set(errors) == {c.id for c in drawn.changes if not c.missing}
    assert sum(abs(e[2]) > 0.001 for e in errors.values()) > 1
    for building in exact:
        if building.osm_id in errors:
            back = on_map[building.osm_id].displace(errors[building.osm_id])
            for ring, wanted in zip(rings_of([back]), rings_of([building]), strict=True):
                np.testing.assert_allclose(ring, wanted, atol=1e-9)


def test_long_buildings_are_turned_by_less() -> None:
    hall = Building("way/1", (Footprint(rectangle(0, 0, 200, 20)),), 9.0)
    p = draw_perturbation([hall], replace(NONE, turn_share=1.0), np.random.default_rng(0))
    (after,) = perturb([hall], p)
    moved = np.linalg.norm(after.footprints[0].outer - hall.footprints[0].outer, axis=1)
    assert 0.4 < moved.max() < 2.0


def test_missing_and_merged_buildings_are_gone_and_their_ground_is_accounted_for() -> None:
    faults = replace(NONE, missing=0.2, merge_share=0.2)
    p = draw_perturbation(village(), faults, np.random.default_rng(0))
    known = {b.osm_id: b for b in village()}
    after = {b.osm_id: b for b in perturb(village(), p)}
    merged = [c for c in p.changes if c.merged_with]
    assert len(merged) == 8
    for change in p.changes:
        assert (change.id in after) == (not change.missing and change.merged_into is None)
    for change in merged:
        (other,) = change.merged_with
        together = union_all([polygon(known[change.id]), polygon(known[other])])
        joined = polygon(after[change.id])
        assert joined.buffer(0.05).contains(together)
        # The 1 m gap between them is closed and hardly anything more.
        assert joined.area - together.area == pytest.approx(12.0, abs=1.5)
        assert next(c for c in p.changes if c.id == other).merged_into == change.id


def test_buildings_not_yet_built_stand_on_free_ground(block: City, tmp_path: Path) -> None:
    faults = replace(NONE, new=0.3)
    extracts = write_extracts(tmp_path, block, ORIGIN, np.random.default_rng(0), faults)
    new = extracts.perturbation.future_buildings
    assert len(new) >= 3
    exact = union_all([polygon(b) for b in read_map(extracts.exact)])
    assert block.street is not None
    road = LineString(block.street.position(block.street.sample(1.0))).buffer(6.4)
    for k, building in enumerate(new):
        others = union_all([exact, road, *(polygon(b) for b in new[:k])])
        assert not polygon(building).intersects(others)
        assert polygon(building).distance(exact) < 40
    ids = {b.osm_id for b in read_map(extracts.perturbed)} - {b.osm_id for b in read_map(extracts.exact)}
    assert ids == {b.osm_id for b in new}


def test_real_maps_are_credited_in_all_that_is_made_of_them(recordings: Callable[[str], Path], tmp_path: Path) -> None:
    source = recordings("mcd_kth_day_06") / "mcd_kth_day_06" / "kth.osm"
    origin = np.array([59.348268650, 18.073204280, 0.0])
    read = read_extract(source, origin).buildings
    city = build_osm_city(
        read.buildings, rolling(np.random.default_rng(0)), np.random.default_rng(1), attribution=read.attribution
    )
    extracts = write_extracts(tmp_path, city, origin, np.random.default_rng(0))
    assert json.loads(extracts.record.read_text(encoding="utf-8"))["attribution"] == ATTRIBUTION
    for path in (extracts.exact, extracts.perturbed):
        assert ATTRIBUTION in path.read_text(encoding="utf-8")
    exact = buildings_of(read_osm(extracts.exact), origin).buildings
    assert {b.osm_id for b in exact} == {b.osm_id for b in city.buildings}
    walls = [b for b in exact if b.tags["building"] not in ("roof", "carport")]
    assert distance_to_walls(city, rings_of(walls)).max() < CM
    before = buildings_of(read_osm(source), origin).buildings
    for a, b in zip(sorted(before, key=lambda b: b.osm_id), sorted(exact, key=lambda b: b.osm_id), strict=True):
        # The tags as mapped, and the height as built beside them.
        assert a.tags.items() <= b.tags.items()
        assert polygon(a).symmetric_difference(polygon(b)).area < CM * polygon(a).length


def test_made_up_towns_credit_nobody(block: City, tmp_path: Path) -> None:
    extracts = write_extracts(tmp_path, block, ORIGIN, np.random.default_rng(0))
    for path in (extracts.exact, extracts.perturbed, extracts.record):
        assert "openstreetmap" not in path.read_text(encoding="utf-8").lower()
    assert all(int(b.osm_id.split("/")[1]) < 0 for b in city_buildings(block))


def test_bad_records_and_folders_get_one_sentence(block: City, tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    for content in ("", "[]", "{}", '{"schema": "other"}', '{"schema": "lslam-osm-perturbation-1", "buildings": 3}'):
        path.write_text(content)
        with pytest.raises(InputError, match=r"r\.json is no record of a perturbed map"):
            read_perturbation(path)
    p = draw_perturbation(village(), MapFaults(), np.random.default_rng(0))
    with pytest.raises(ValueError, match="other buildings"):
        perturb(village()[1:], p)
    write_perturbation(path, replace(p, changes=(Change("way/1", shift_m=(0.1, 1 / 3)),)))
    assert read_perturbation(path).changes[0].shift_m == (0.1, 1 / 3)
    empty = City(block.mesh, block.terrain)
    with pytest.raises(InputError, match="without buildings has no OpenStreetMap extract"):
        write_extracts(tmp_path, empty, ORIGIN, np.random.default_rng(0))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be made"):
        write_extracts(tmp_path / "file", block, ORIGIN, np.random.default_rng(0))


def test_no_methods_read_the_record(block: City, tmp_path: Path) -> None:
    """It lies below truth/, which may be deleted."""
    extracts = write_extracts(tmp_path, block, ORIGIN, np.random.default_rng(0))
    assert extracts.record.parent == tmp_path / "truth"
    assert {path.name for path in tmp_path.iterdir()} == {"map.osm", "map_perturbed.osm", "truth"}
