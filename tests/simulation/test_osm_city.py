"""Cities raised from footprints: walls stand on outlines, roofs close them, heights are the map's; shot at with rays."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import MultiPolygon, contains_xy, points

from lslam.core.errors import InputError
from lslam.core.types.building import Building, Footprint, footprint_polygon
from lslam.simulation.curve import flat, rolling, smooth_curve
from lslam.simulation.osm_city import OsmCity, build_osm_city, extrude
from lslam.simulation.osm_place import read_extract
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, Surface

ORIGIN = np.array([49.0112, 8.4229, 112.8])


def box_at(x: float, y: float, width: float, depth: float) -> NDArray[np.float64]:
    return np.array([[x, y], [x + width, y], [x + width, y + depth], [x, y + depth]], np.float64)


ELL = np.array([[0, 0], [24, 0], [24, 10], [10, 10], [10, 30], [0, 30]], np.float64)
BUILDINGS = [
    Building("way/1", (Footprint(ELL),), 12.0, tags={"building": "apartments"}),
    Building("way/2", (Footprint(box_at(60, 0, 10, 14)),), 9.0, tags={"roof:shape": "gabled"}),
    Building("way/3", (Footprint(box_at(60, 40, 10, 14)),), 9.0, tags={"roof:shape": "flat"}),
    Building("relation/4", (Footprint(box_at(0, 60, 50, 40), (box_at(15, 75, 20, 10)[::-1],)),), 15.0),
    Building("way/5", (Footprint(box_at(100, 0, 5, 6)),), None, tags={"building": "garage"}),
    Building("way/6", (Footprint(box_at(100, 40, 20, 15)),), None),
    Building("way/7", (Footprint(box_at(100, 80, 12, 8)),), 5.0, tags={"building": "roof"}),
    Building("way/8", (Footprint(box_at(140, 0, 8, 20)),), 9.0, base=3.0),
]


def build(buildings: list[Building] = BUILDINGS, seed: int = 3, level: bool = False) -> OsmCity:
    terrain = flat() if level else rolling(np.random.default_rng(1))
    return build_osm_city(buildings, terrain, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def city() -> OsmCity:
    return build()


def shoot(city: OsmCity, origins: Any, directions: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Distances and surfaces (-1: nothing) met by rays."""
    distance, face = RayScene(city.mesh).cast(np.asarray(origins, np.float32), np.asarray(directions, np.float32))
    return distance, np.where(face >= 0, city.mesh.surfaces[face].astype(int), -1)


def rays_at_walls(city: OsmCity, building: Building, away: float = 2.0) -> tuple[NDArray[Any], NDArray[Any]]:
    """Level rays from `away` m outside, every 0.3 m along all rings at several heights above the highest ground."""
    assert building.height is not None
    rings = [ring for footprint in building.footprints for ring in footprint.rings]
    ground = city.terrain.height(np.concatenate(rings)).max()
    origins, directions = [], []
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            length = np.linalg.norm(b - a)
            along = (b - a) / length
            outward = np.array([along[1], -along[0]])
            for u in np.arange(0.15, length, 0.3):
                for z in np.linspace(building.base + 0.3, 0.55 * building.height, 6):
                    origins.append([*(a + u * along + away * outward), ground + z])
                    directions.append([*-outward, 0.0])
    return np.array(origins), np.array(directions)


@pytest.mark.parametrize("number", [0, 1, 2, 3, 4, 5, 7])
def test_walls_stand_on_their_outlines_and_windows_just_behind(city: OsmCity, number: int) -> None:
    distance, surface = shoot(city, *rays_at_walls(city, city.buildings[number]))
    glass = surface == Surface.GLASS
    recess = distance - 2.0
    assert np.isin(surface, [Surface.WALL, Surface.GLASS]).all()
    assert (recess > -1e-3).all()
    assert np.abs(recess[~glass & (recess < 0.05)]).max() < 1e-3
    # What is not flush is a pane, or one of the sides of its recess.
    assert recess.max() < 0.31
    assert np.mean(recess < 1e-3) > 0.6
    if number in (0, 3, 5):
        assert 0.1 < glass.mean() < 0.4


def test_nothing_but_eaves_sticks_out(city: OsmCity) -> None:
    mesh = city.mesh
    ground = np.isin(mesh.surfaces, [Surface.LAWN, Surface.ROAD, Surface.PAVEMENT])
    outlines = MultiPolygon([footprint_polygon(f) for b in city.buildings for f in b.footprints])
    for surfaces, reach in (([Surface.WALL, Surface.GLASS, Surface.POLE], 1e-3), ([Surface.ROOF], 0.43)):
        faces = mesh.faces[np.isin(mesh.surfaces, surfaces) & ~ground]
        corners = mesh.vertices[np.unique(faces), :2].astype(np.float64)
        assert outlines.buffer(reach).contains(points(corners)).all()


def test_rays_from_above_meet_roofs_where_there_are_buildings_and_ground_elsewhere(city: OsmCity) -> None:
    x, y = np.meshgrid(np.arange(-19.7, 160, 0.9), np.arange(-19.7, 120, 0.9))
    xy = np.column_stack([x.ravel(), y.ravel()])
    distance, surface = shoot(city, np.column_stack([xy, np.full(len(xy), 100.0)]), np.tile([0, 0, -1.0], (len(xy), 1)))
    for building in city.buildings:
        assert building.height is not None
        shape = MultiPolygon([footprint_polygon(f) for f in building.footprints])
        inside = contains_xy(shape.buffer(-0.05), xy)
        ground = city.terrain.height(np.concatenate([f.outer for f in building.footprints])).max()
        top = 100.0 - distance[inside] - ground
        assert (surface[inside] == Surface.ROOF).all()
        assert top.max() <= building.height + 1e-3
        assert top.min() > 0.5 * building.height
    outside = ~contains_xy(
        MultiPolygon([footprint_polygon(f) for b in city.buildings for f in b.footprints]).buffer(0.5), xy
    )
    assert (surface[outside] == Surface.LAWN).all()
    assert np.abs(100.0 - distance[outside] - city.terrain.height(xy[outside])).max() < 0.1


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_buildings_are_as_high_as_the_map_says(number: int) -> None:
    alone = build([BUILDINGS[number]])
    ground = alone.terrain.height(np.concatenate([f.outer for f in BUILDINGS[number].footprints])).max()
    assert alone.mesh.vertices[:, 2].max() - ground == pytest.approx(BUILDINGS[number].height, abs=1e-4)
    assert alone.heights == [BUILDINGS[number].height]


def test_a_gable_has_two_slopes_and_a_flat_roof_has_none() -> None:
    for number, sloped in ((1, True), (2, False)):
        alone = build([BUILDINGS[number]], level=True)
        up = np.abs(alone.mesh.normals[alone.mesh.surfaces == Surface.ROOF][:, 2])
        assert ((up < 0.95).all() and len(up) == 4) if sloped else (up > 0.999).all()


def test_heights_nobody_knows_are_drawn_and_kept(city: OsmCity) -> None:
    garage, house = city.buildings[4].height, city.buildings[5].height
    assert garage is not None
    assert house is not None
    assert 2.4 <= garage <= 3.0
    assert house in (6.0, 9.0, 12.0, 15.0)
    assert len({build(seed=k).buildings[5].height for k in range(12)}) > 1
    assert [b.osm_id for b in city.buildings] == [b.osm_id for b in BUILDINGS]


def test_one_passes_below_a_building_on_posts_or_on_another_storey(city: OsmCity) -> None:
    canopy, bridge = city.buildings[6], city.buildings[7]
    for building, x in ((canopy, 106.0), (bridge, 144.0)):
        _, y0, _, y1 = footprint_polygon(building.footprints[0]).bounds
        z = float(city.terrain.height(np.array([x, y0]))) + 1.5
        distance, _ = shoot(city, [[x, y0 - 1, z]], [[0, 1.0, 0]])
        assert distance[0] > y1 - y0 + 2
        above, surface = shoot(city, [[x, (y0 + y1) / 2, z]], [[0, 0, 1.0]])
        assert surface[0] == Surface.ROOF
        assert above[0] < 5
    assert (city.mesh.surfaces == Surface.POLE).any()


def test_walls_reach_the_lowest_ground(city: OsmCity) -> None:
    for building in city.buildings[:6]:
        for ring in building.footprints[0].rings:
            # From the middle of each side, 5 cm outside and 2 cm above the ground there, towards the wall.
            a, b = ring, np.roll(ring, -1, axis=0)
            along = (b - a) / np.linalg.norm(b - a, axis=1)[:, None]
            start = (a + b) / 2 + 0.05 * np.column_stack([along[:, 1], -along[:, 0]])
            z = city.terrain.height(start) + 0.1
            directions = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(a))])
            distance, surface = shoot(city, np.column_stack([start, z]), directions)
            assert (surface == Surface.WALL).all()
            assert np.abs(distance - 0.05).max() < 1e-3


def test_a_street_is_paved() -> None:
    street = smooth_curve(np.column_stack([np.arange(-40.0, 61, 5), np.full(21, -20.0)]), closed=False)
    paved = build_osm_city(BUILDINGS, rolling(np.random.default_rng(1)), np.random.default_rng(3), [street])
    y = np.array([-20.0, -23.5, -25.5, -32.0])
    _, surface = shoot(paved, np.column_stack([np.zeros(4), y, np.full(4, 50.0)]), np.tile([0, 0, -1.0], (4, 1)))
    assert surface.tolist() == [Surface.ROAD, Surface.ROAD, Surface.PAVEMENT, Surface.LAWN]
    assert paved.streets == [street]


def test_same_seed_same_city_and_neighbours_change_nothing(city: OsmCity) -> None:
    again = build()
    assert again.mesh.vertices.tobytes() == city.mesh.vertices.tobytes()
    assert again.mesh.faces.tobytes() == city.mesh.faces.tobytes()
    assert build(seed=4).mesh.vertices.tobytes() != city.mesh.vertices.tobytes()
    fewer = build(BUILDINGS[3:])
    walls = city.mesh.vertices[city.mesh.faces[city.mesh.surfaces == Surface.WALL]].reshape(-1, 9)
    kept = fewer.mesh.vertices[fewer.mesh.faces[fewer.mesh.surfaces == Surface.WALL]].reshape(-1, 9)
    assert {tuple(row) for row in kept.tolist()} < {tuple(row) for row in walls.tolist()}


def test_without_buildings_there_is_no_city() -> None:
    with pytest.raises(InputError, match="at least one building"):
        build([])
    with pytest.raises(ValueError, match="no height"):
        extrude(MeshBuilder(), replace(BUILDINGS[0], height=None), 0.0, 0.0, np.random.default_rng(0))


def test_a_real_district_is_raised_in_seconds(recordings: Callable[[str], Path]) -> None:
    path = recordings("mcd_kth_day_06") / "mcd_kth_day_06" / "kth.osm"
    start = time.perf_counter()
    origin = np.array([59.348268650, 18.073204280, 0.0])
    found = read_extract(path, origin).buildings.buildings
    district = build_osm_city(found, rolling(np.random.default_rng(0)), np.random.default_rng(1))
    assert time.perf_counter() - start < 20
    assert len(district.buildings) == 72
    assert all(b.height is not None for b in district.buildings)
    area = sum(b.area for b in district.buildings)
    assert sum(footprint_polygon(Footprint(f)).area for f in district.footprints) >= area
    around = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    rays = np.column_stack([np.cos(around), np.sin(around), np.zeros(720)])
    distance, surface = shoot(district, np.tile([0, 0, 4.0], (720, 1)), rays)
    assert np.isin(surface[distance < 80], [Surface.WALL, Surface.GLASS]).mean() > 0.9
    assert (distance < 80).mean() > 0.3
