"""Towns round a line: roads that are open, ground without holes, houses that stand apart, paths that are free."""

from __future__ import annotations

from functools import cache
from typing import cast

import numpy as np
import pytest

from lslam.core.errors import UsageError
from lslam.core.types.scan import Scan
from lslam.simulation.built_scenario import check_bends, check_path
from lslam.simulation.city import KERB, City
from lslam.simulation.curve import Terrain
from lslam.simulation.scenario_files import scenario_names
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, Surface
from lslam.simulation.town import Network

SHARES_TOWNS = True
GROUND = (Surface.ROAD, Surface.PAVEMENT, Surface.LAWN)


@cache
def drive(name: str) -> SimulatedDrive:
    """Its whole way, and the town that is built round that."""
    return simulate(name)


def ground_below(city: City, scene: RayScene, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What rays from 0.35 m above the ground meet downwards: distance below the level of the terrain, and surface."""
    start = np.column_stack([xy, city.terrain.height(xy) + 0.35]).astype(np.float32)
    far, face = scene.cast(start, np.broadcast_to(np.array([0, 0, -1], np.float32), start.shape))
    return 0.35 - far.astype(float), np.where(face >= 0, scene.mesh.surfaces[face], 255)


@pytest.mark.parametrize("name", ["residential", "small-eight", "climbing", "urban"])
def test_roads_are_level_from_kerb_to_kerb_and_nothing_is_open_below(name: str) -> None:
    made = drive(name)
    city, layout = made.city, made.scenario.layout
    rng = np.random.default_rng(2)
    middle = np.concatenate([street.position(street.sample(2.0)) for street in city.streets])
    xy = middle.repeat(4, axis=0) + rng.uniform(-14, 14, (4 * len(middle), 2))
    height, surface = ground_below(city, made.scene, xy)
    on_ground = np.isin(surface, GROUND)
    assert np.isfinite(height).all(), "no hole in the ground"
    away = Network(city.streets).distance(xy)
    # A dead end is closed by grass over its last metres.
    ends = np.concatenate([street.position(np.array([0.0, street.length])) for street in city.streets])
    from scipy.spatial import cKDTree

    inner = np.asarray(cKDTree(ends).query(xy)[0]) > layout.band + 2
    road = on_ground & inner & (away < layout.road - 0.8)
    assert np.mean(surface[road] == Surface.ROAD) > 0.995
    assert np.abs(height[road]).max() < 0.06
    walk = on_ground & inner & (away > layout.road + 0.9) & (away < layout.band - 0.3)
    assert abs(np.median(height[walk]) - KERB) < 0.01
    assert road.sum() > 300
    assert walk.sum() > 100


@pytest.mark.parametrize("name", ["residential", "closed"])
def test_streets_meet_streets(name: str) -> None:
    """Side streets begin on another street, and houses line them without standing on any road or in each other."""
    from shapely import Polygon, STRtree, points

    city = drive(name).city
    assert len(city.streets) > 6
    for k, street in enumerate(city.streets[1:], 1):
        others = Network(city.streets[:k])
        assert others.distance(street.position(np.array([0.0])))[0] < 0.7
    houses = [Polygon(f) for f in city.footprints]
    assert len(houses) == len(city.heights) > 60
    assert min(city.heights) > 3
    tree = STRtree(houses)
    pairs = tree.query(houses, predicate="overlaps")
    assert not np.any(pairs[0] != pairs[1])
    band = drive(name).scenario.layout.band
    middle = np.concatenate([street.position(street.sample(0.5)) for street in city.streets])
    near = tree.query(points(middle), predicate="dwithin", distance=band - 0.1)
    assert near.shape[1] == 0


@pytest.mark.parametrize("name", [n for n in scenario_names() if n not in ("block", "street")])
def test_paths_keep_clear_of_everything_at_their_height(name: str) -> None:
    """Nothing that stands comes within half a metre of the line of the LiDAR."""
    from scipy.spatial import cKDTree

    made = drive(name)
    mesh = made.city.mesh
    # Each corner once, of all the faces that meet there.
    stands = np.zeros(len(mesh.vertices), np.bool_)
    stands[mesh.faces[~np.isin(mesh.surfaces, GROUND)]] = True
    corners = mesh.vertices[stands].astype(float)
    times = np.arange(0, made.end, 0.05)
    line = made.vehicle.poses(times)[:, :3, 3]
    near = np.asarray(cKDTree(line).query(corners, distance_upper_bound=3.0)[0])
    assert near.min() > 0.5
    if made.scenario.carrier == "car":
        low = corners[corners[:, 2] - made.city.terrain.height(corners[:, :2]) < 1.6]
        beside = np.asarray(cKDTree(line[:, :2]).query(low[:, :2], distance_upper_bound=3.0)[0])
        assert beside.min() > 1.0


def test_identical_houses_are_identical() -> None:
    city = drive("identical").city
    assert len(set(np.round(city.heights, 6))) == 1
    sides = {tuple(np.round(np.linalg.norm(np.diff(f, axis=0), axis=1), 6)) for f in city.footprints}
    assert len(sides) == 1


def edges(scan: Scan) -> int:
    """Neighbours on a ring, within a degree of each other, between which the range jumps by more than half a metre."""
    assert scan.rings is not None
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    order = np.lexsort((azimuth, scan.rings))
    ranges, azimuth, ring = np.linalg.norm(scan.points, axis=1)[order], azimuth[order], scan.rings[order]
    beside = (np.diff(ring) == 0) & (np.diff(azimuth) < np.radians(1))
    return int(np.sum(beside & (np.abs(np.diff(ranges)) > 0.5)))


def test_features_become_scarce_with_height_on_the_climb() -> None:
    made = drive("climbing")
    low, middle, high = ([made.scan(i) for i in range(first, first + 40, 10)] for first in (0, 250, 500))
    points = [float(np.mean([len(scan) for scan in scans])) for scans in (low, middle, high)]
    assert points[0] > points[1] > points[2] > 500
    assert points[2] < 0.4 * points[0]
    found = [float(np.mean([edges(scan) for scan in scans])) for scans in (low, middle, high)]
    assert found[0] > found[1] > found[2] > 10
    assert found[2] < 0.5 * found[0]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_corridor_is_bare_for_long_and_then_opens(seed: int) -> None:
    """Rays sideways along the line: smooth walls for 100 m and more, openings between; one of them at the start."""
    made = simulate("corridor", seed=seed, count=1)
    street = made.city.street
    assert street is not None
    s = np.arange(100.0, street.length - 100.0, 1.0)
    start = np.column_stack([street.position(s), np.full(len(s), 5.0)]).astype(np.float32)
    aside = np.column_stack([street.beside(s, 1.0) - street.position(s), np.zeros(len(s))]).astype(np.float32)
    far, face = made.scene.cast(start, aside)
    is_bare = (made.scene.mesh.surfaces[face] == Surface.WALL) & (far < 6)
    changes = np.flatnonzero(np.diff(is_bare))
    lengths = np.diff(changes)
    assert np.all((lengths < 35) | (lengths > 95)), "an opening or a bare wall"
    assert (lengths < 35).any()
    assert (lengths > 95).any()
    away = np.linalg.norm(street.position(s) - made.city_poses[0, :2, 3], axis=1)
    assert not is_bare[np.argsort(away)[:20]].all(), "it begins where there is something to see"


def test_a_path_through_a_building_is_refused() -> None:
    made = drive("residential")
    house = made.city.footprints[0].mean(axis=0)
    away = made.vehicle.poses(np.array([0.0]))[0, :3, 3]
    beyond = away + 1.3 * (np.array([*house, away[2]]) - away)

    def poses(times: np.ndarray) -> np.ndarray:
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, :3, 3] = away + (times / 5.0)[:, None] * (beyond - away)
        T[:, 2, 3] = made.city.terrain.height(T[:, :2, 3]) + 1.7  # whatever hill lies between
        return T

    check_path(made.scene, made.city, made.vehicle.poses, made.end)
    with pytest.raises(UsageError, match=r"crosses a building, \d+ m along at x = .*: move its way-points"):
        check_path(made.scene, made.city, poses, 5.0)


class Flat:
    """Ground at z = 0."""

    def height(self, xy: np.ndarray) -> np.ndarray:
        return np.zeros(xy.shape[:-1])


@pytest.mark.parametrize("side", [1, -1])
def test_a_body_is_wider_than_its_path(side: int) -> None:
    """A wall 0.5 m beside the path is scraped, one 0.9 m away is not."""

    def poses(times: np.ndarray) -> np.ndarray:
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, 0, 3], T[:, 2, 3] = 10.0 * times, 1.7
        return T

    for gap, is_free in ((0.9, True), (0.5, False)):
        builder = MeshBuilder()
        near, far = sorted((side * gap, side * 6.0))
        builder.add_box([8.0, near, -1.0], [12.0, far, 5.0], Surface.WALL)
        mesh = builder.build()
        scene, city = RayScene(mesh), City(mesh, cast(Terrain, Flat()))
        if is_free:
            check_path(scene, city, poses, 2.0)
            continue
        with pytest.raises(UsageError, match=r"crosses a building, [78] m along at x = [78]\.\d, y = 0\.0"):
            check_path(scene, city, poses, 2.0)


def test_a_flight_into_the_ground_is_refused() -> None:
    with pytest.raises(UsageError, match=r"comes within 0\.3 m of the ground"):
        simulate("climbing", settings=["path.heights=[3, -4]"])


def test_a_start_inside_a_building_is_refused() -> None:
    made = drive("residential")
    house = made.city.footprints[0].mean(axis=0)
    T = np.eye(4)
    T[:3, 3] = [*house, float(made.city.terrain.height(house)) + 1.5]
    with pytest.raises(UsageError, match="starts inside a building"):
        check_path(made.scene, made.city, lambda times: np.tile(T, (len(times), 1, 1)), 1.0)


def test_bends_name_the_place_and_the_way_out() -> None:
    s = np.linspace(0, 100, 101)
    curvature = np.where(s == 40, 0.1, 0.0)
    check_bends(curvature, s, 5.0, 2.6)
    with pytest.raises(UsageError, match=r"radius of 10\.0 m at 40 m along: 10 m/s needs 10\.0 m/s2 there"):
        check_bends(curvature, s, 10.0, 6.0)
