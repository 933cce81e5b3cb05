"""Drives through a real place: along its streets, along way-points, with a shape laid where it fits."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from osm_builders import ExtractMaker
from osm_village import MAIN, ORIGIN, SIDE, houses, village, write_village
from shapely import LineString, MultiPolygon, Point, contains_xy, distance, points

from lslam.core.errors import InputError, UsageError
from lslam.core.geometry.geodesy import from_local, to_local
from lslam.core.types.building import footprint_polygon
from lslam.io.formats.osm_buildings import buildings_of
from lslam.io.formats.osm_data import ATTRIBUTION
from lslam.io.formats.osm_files import read_osm, write_osm
from lslam.osm.overpass import from_overpass
from lslam.simulation.built_scenario import whole_map
from lslam.simulation.osm_city import OsmCity
from lslam.simulation.osm_place import DRIVABLE, WALKABLE, buildings_near, find_route, highways, read_extract
from lslam.simulation.record import record
from lslam.simulation.routes import WayPoints
from lslam.simulation.scenario_files import find_scenario
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.scene_mesh import Surface

WALLS = MultiPolygon([footprint_polygon(f) for b in houses() for f in b.footprints])


@pytest.fixture(scope="module")
def extract(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_village(tmp_path_factory.mktemp("map") / "village.osm")


@pytest.fixture(scope="module")
def drive(extract: Path) -> SimulatedDrive:
    return simulate(
        "residential", osm=extract, origin=ORIGIN[:2], seed=2, lidar="vlp16", settings=["traffic.people=200"]
    )


def city_of(drive: SimulatedDrive) -> OsmCity:
    assert isinstance(drive.city, OsmCity)
    return drive.city


def test_a_drive_follows_the_longest_street_on_its_right(drive: SimulatedDrive) -> None:
    line = drive.city_poses[:, :2, 3]
    main = LineString(MAIN)
    away = np.asarray(distance(points(line), main))
    # In its lane, but for the bend that is rounded.
    assert np.median(away) == pytest.approx(drive.scenario.path.lane, abs=0.05)
    assert away.max() < 4
    # From one end of the main street to the other, whichever comes first.
    assert drive.ground_truth is not None
    assert drive.ground_truth.path_lengths[-1] > 0.9 * main.length
    ahead = drive.city_poses[:, :2, 0]
    for T, right in zip(line[20:-1:20], np.column_stack([ahead[:, 1], -ahead[:, 0]])[20:-1:20], strict=True):
        assert main.distance(Point(T + 0.5 * right)) > main.distance(Point(T))


def test_only_open_streets_are_taken() -> None:
    data = village()
    assert len(highways(data, ORIGIN, DRIVABLE)) == 3, "neither tunnel nor steps"
    found = find_route(highways(data, ORIGIN, DRIVABLE), houses(), 2.0, 5.0)
    assert found is not None
    assert np.abs(found).max() < 140
    # Missing nodes cut a way in two, an unknown kind leaves nothing.
    broken = village()
    del broken.nodes[10_001]
    assert sorted(
        len(xy) for nodes, xy in highways(broken, ORIGIN, DRIVABLE) if 10_000 in nodes or 10_002 in nodes
    ) == [2]
    assert find_route(highways(data, ORIGIN, ("motorway",)), houses(), 2.0, 5.0) is None
    assert set(DRIVABLE) < set(WALKABLE)


def test_a_route_ends_before_a_wall() -> None:
    """The alley through the long house is left where it comes too near."""
    alley = [(nodes, xy) for nodes, xy in highways(village(), ORIGIN, DRIVABLE) if len(nodes) == 3 and xy[1, 0] < 0]
    assert len(alley) == 1
    assert find_route(alley, houses(), 2.0, 5.0) is None, "all of it in one segment through the house"
    ways = [((1, 2), np.array([[-20.0, 22.0], [-20.0, 128.5]]))]
    found = find_route(ways, houses(), 4.0, 5.0)
    assert found is not None
    assert np.asarray(distance(points(found), WALLS)).min() > 4.0


def test_everything_beside_the_road_keeps_clear_of_walls_and_of_the_way(drive: SimulatedDrive) -> None:
    city = city_of(drive)
    present = set(np.unique(city.mesh.surfaces).tolist())
    assert {Surface.CAR, Surface.TRUNK, Surface.POLE, Surface.ROAD, Surface.PAVEMENT} <= present
    assert len(city.streets) == 4, "main street, side street, the alley up to the long house and behind it"
    line = LineString(drive.city_poses[:, :2, 3])
    for surface in (Surface.CAR, Surface.POLE, Surface.TRUNK):
        corners = city.mesh.vertices[city.mesh.faces[city.mesh.surfaces == surface]].reshape(-1, 3)
        assert not contains_xy(WALLS, corners[:, :2]).any(), surface
        # A lamp may reach over the road, high up.
        low = corners[corners[:, 2] - city.terrain.height(corners[:, :2]) < 3.0]
        assert np.asarray(distance(points(low[:, :2]), line)).min() > 1.0, surface


def test_roads_have_kerbs_and_the_ground_no_holes(drive: SimulatedDrive) -> None:
    city = city_of(drive)
    x, y = np.meshgrid(np.arange(-150.2, 90, 0.9), np.arange(-40.3, 140, 0.9))
    xy = np.column_stack([x.ravel(), y.ravel()])
    down = np.tile(np.float32([0, 0, -1]), (len(xy), 1))
    far, face = drive.scene.cast(np.column_stack([xy, np.full(len(xy), 50.0)]).astype(np.float32), down)
    assert (face >= 0).all()
    surface, height = city.mesh.surfaces[face], 50.0 - far - city.terrain.height(xy)
    beside = np.asarray(distance(points(xy), LineString(MAIN)))
    straight = (beside < 4.5) & (np.abs(xy[:, 0]) < 30) & (xy[:, 1] < 8)
    road = straight & (surface == Surface.ROAD)
    assert road.sum() > 0.6 * straight.sum(), "the rest is cars and trees"
    assert np.abs(height[road]).max() < 0.03
    assert np.median(height[surface == Surface.PAVEMENT]) == pytest.approx(0.12, abs=0.02)


def test_nobody_walks_through_walls(drive: SimulatedDrive) -> None:
    assert len(drive.movers) > 10
    times = np.arange(0, drive.vehicle.duration, 0.1)
    for mover in drive.movers:
        assert not contains_xy(WALLS, mover.poses(times)[:, :2, 3]).any()


def test_side_streets_join(drive: SimulatedDrive) -> None:
    side = LineString(SIDE)
    lines = [LineString(street.position(street.sample(1.0))) for street in drive.city.streets[1:]]
    assert any(line.hausdorff_distance(side) < drive.scenario.layout.road + 1 for line in lines)


def test_all_files_know_where_on_earth_they_are_and_whose_map_it_was(
    drive: SimulatedDrive, extract: Path, tmp_path: Path
) -> None:
    short = simulate("residential", osm=extract, count=3, lidar="vlp16", imu="ideal")
    done = record(short, tmp_path / "out")
    said = json.loads((done.sequence / "manifest.json").read_text(encoding="utf-8"))
    assert said["attribution"] == ATTRIBUTION
    assert (said["name"], said["place"]["source"]) == ("village-0", "village.osm")
    assert ATTRIBUTION in (done.sequence / "map.osm").read_text(encoding="utf-8")
    # Without --origin, the middle of all buildings.
    outlines = np.concatenate([f.outer for b in city_of(short).buildings for f in b.footprints])
    np.testing.assert_allclose((outlines.min(0) + outlines.max(0)) / 2, 0, atol=0.02)
    assert said["place"]["origin_lat_lon_alt"] == short.readings.origin.tolist()
    exact = {w.id: w for w in read_osm(done.sequence / "map.osm").ways.values()}
    original = read_osm(extract)
    assert set(exact) == {w.id for w in original.ways.values() if "building" in w.tags}
    # Both drives go through one place: the middle of its main street.
    fixes = np.array([original.nodes[n] for n in original.ways[20_000].nodes])
    for made in (short, drive):
        start = from_local(made.city_poses[:1, :3, 3], made.readings.origin)
        ends = to_local(np.column_stack([fixes[[0, -1]], [0, 0]]), start[0])
        assert np.linalg.norm(ends[:, :2], axis=1).min() < 5


def test_way_points_are_metres_of_the_map_and_geojson_degrees(extract: Path, tmp_path: Path) -> None:
    line = np.array([[-100.0, 1.0], [40.0, 1.0]])
    (tmp_path / "way.csv").write_text("-100,1\n40,1\n")
    fixes = from_local(np.column_stack([line, [0, 0]]), ORIGIN)
    shape = {"type": "LineString", "coordinates": fixes[:, [1, 0]].tolist()}
    (tmp_path / "way.geojson").write_text(json.dumps(shape))
    for name in ("way.csv", "way.geojson"):
        made = simulate("residential", osm=extract, origin=ORIGIN, way_points=tmp_path / name, count=5)
        np.testing.assert_allclose(made.city_poses[0, :2, 3], line[0], atol=0.3)
    # The degrees stay where they are, wherever the origin is put.
    moved = simulate("residential", osm=extract, way_points=tmp_path / "way.geojson", count=5)
    start = from_local(moved.city_poses[:1, :3, 3], moved.readings.origin)
    np.testing.assert_allclose(to_local(start, ORIGIN)[0, :2], line[0], atol=0.3)


def test_a_generated_town_lies_where_its_degrees_or_the_origin_say(tmp_path: Path) -> None:
    file = tmp_path / "way.geojson"
    file.write_text(json.dumps({"type": "LineString", "coordinates": [[18.07, 59.35], [18.072, 59.35]]}))
    bare = ["world.levels=0", "traffic.cars=0"]
    own = simulate("residential", way_points=file, count=2, settings=bare)
    np.testing.assert_allclose(own.readings.origin, [59.35, 18.07, 0.0], atol=1e-12)
    other = simulate("block", count=2, origin=(10.0, 20.0, 30.0))
    np.testing.assert_array_equal(other.readings.origin, [10.0, 20.0, 30.0])


def test_a_shape_is_laid_between_the_houses(extract: Path) -> None:
    bend = WayPoints(np.array([[0.0, 0.0], [150.0, 0.0], [150.0, 100.0]]), has_place=False)
    made = simulate("residential", osm=extract, way_points=bend, count=20, settings=["path.smoothing=6"])
    line = made.city_poses[:, :2, 3]
    assert np.asarray(distance(points(line), WALLS)).min() > 2.0
    assert np.asarray(distance(points(line), WALLS)).max() < 60
    comb = np.array(
        [[x, y] for k, x in enumerate(np.arange(0.0, 300.0, 15.0)) for y in ((0, 90) if k % 2 else (90, 0))]
    )
    with pytest.raises(UsageError, match=r"fits nowhere between the buildings of .*village\.osm"):
        simulate("residential", osm=extract, way_points=WayPoints(comb, has_place=False))


def test_a_flight_crosses_any_ground_but_no_house(extract: Path) -> None:
    across = WayPoints(np.array([[-100.0, -60.0], [-10.0, 60.0], [60.0, 150.0]]))
    high = simulate("open", osm=extract, origin=ORIGIN, way_points=across, count=10, settings=["path.heights=[15, 15]"])
    assert high.city_poses[:, 2, 3].min() > 14
    with pytest.raises(UsageError, match=r"crosses a building, \d+ m along at x = "):
        simulate("open", osm=extract, origin=ORIGIN, way_points=across, settings=["path.heights=[5, 5]"])


def test_the_whole_map_is_drawn_with_or_without_streets(extract: Path, tmp_path: Path) -> None:
    scenario = find_scenario("residential")
    city, line = whole_map(scenario, 0, read_extract(extract))
    assert len(city.buildings) == len(houses())
    assert len(line) > 100
    bare = write_village(tmp_path / "bare.osm", streets=False)
    city, line = whole_map(scenario, 0, read_extract(bare))
    assert len(city.buildings) == len(houses())
    assert line.shape == (0, 3)
    assert city.streets == []
    with pytest.raises(UsageError, match=r"bare\.osm has no street to go along: give --path FILE .* --plan"):
        simulate("residential", osm=bare)


def test_what_is_no_place_is_said(extract: Path, tmp_path: Path) -> None:
    for origin, sentence in (
        ((91.0, 8.0), "--origin 91,8 is out of range"),
        ((49.0, 181.0), "--origin 49,181 is out of range"),
        ((49.0,), "expected LAT,LON"),
        ((float("nan"), 8.0), "expected LAT,LON"),
    ):
        with pytest.raises(UsageError, match=sentence):
            simulate("residential", osm=extract, origin=origin)
    with pytest.raises(InputError, match=r"nearest building is 4\d\.\d km away from the origin .* check --origin"):
        simulate("residential", osm=extract, origin=ORIGIN + np.array([0.4, 0, 0]))
    with pytest.raises(InputError, match=r"village\.osm lies .* away from the origin"):
        simulate("residential", osm=extract, origin=ORIGIN + np.array([2.0, 0, 0]))
    far = WayPoints(np.array([[0.0, -900.0], [100.0, -900.0]]))
    with pytest.raises(InputError, match=r"no building within 150 m of the path, the nearest is 8\d\d m away"):
        simulate("residential", osm=extract, origin=ORIGIN, way_points=far)
    through = WayPoints(np.array([[-50.0, 0.0], [-50.0, -40.0]]))
    with pytest.raises(UsageError, match=r"crosses a building, \d+ m along at x = -50\.\d, y = -9\.\d"):
        simulate("residential", osm=extract, origin=ORIGIN, way_points=through)
    empty = tmp_path / "empty.osm"
    data = village()
    data.ways = {k: w for k, w in data.ways.items() if "building" not in w.tags}
    write_osm(empty, data)
    with pytest.raises(InputError, match=r"empty\.osm holds no building outline"):
        simulate("residential", osm=empty)


def test_the_real_extract_is_driven_through(recordings: Callable[[str], Path]) -> None:
    path = recordings("mcd_kth_day_06") / "mcd_kth_day_06" / "kth.osm"
    made = simulate("urban", osm=path, count=40, lidar="vlp16")
    assert len(made.scan(20)) > 0.6 * made.lidar.rays
    assert len(city_of(made).buildings) > 30
    assert len(made.city.streets) > 5


def test_buildings_far_from_the_path_are_an_error_that_says_how_far() -> None:
    maker = ExtractMaker()
    maker.square(1, 100, 0, 10, building="yes")
    maker.square(2, -20, -400, 800, building="yes")  # its corners are far, its west wall is near
    maker.square(3, 0, 3000, 10, building="yes")
    extract = buildings_of(from_overpass(maker.tree()), ORIGIN)
    path = np.array([[-50.0, 0, 1.7], [-45, 0, 1.7]])
    assert [b.osm_id for b in buildings_near(extract, path, 26)] == ["way/2"]
    assert [b.osm_id for b in buildings_near(extract, path, 146)] == ["way/1", "way/2"]
    with pytest.raises(
        InputError, match=r"no building within 20 m of the path, the nearest is 25 m away: check --origin"
    ):
        buildings_near(extract, path, 20)
    with pytest.raises(InputError, match=r"the nearest is 7\.0 km away"):
        buildings_near(extract, path - [0, 7400, 0], 100)
    # Inside a building is near it.
    assert len(buildings_near(extract, np.array([[300.0, 100]]), 1)) == 1
