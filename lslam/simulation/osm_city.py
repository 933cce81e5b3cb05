"""A city raised from the buildings of a map, on uneven ground, with roads and what stands beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.simulation.city import KERB, MARGIN, City, Layout, Lots, add_garden_trees, add_street_furniture
from lslam.simulation.curve import RouteCurve
from lslam.simulation.extrusion import extrude, likely_height
from lslam.simulation.scene_mesh import MeshBuilder, Surface, grid_faces
from lslam.simulation.terrain import Terrain
from lslam.simulation.town import CAR_LENGTH, Network, Places, add_road
from lslam.types.building import Building

Floats = NDArray[np.float64]

CELL = 1.0  # m, of the ground
MOST_CELLS = 1_500_000
BESIDE_KERB = 0.05  # m that the grass ends below the pavement
UNDER_ROAD = 0.2  # m that the ground lies lower where a road covers it
AIR = {True: 1.0, False: 0.5}  # m between walls and a parked car, or anything else


@dataclass(frozen=True)
class OsmCity(City):
    """A `City` that knows its buildings; x is east and y north of the extract's origin.

    buildings : as built, every one with a height; attribution : what outputs made from it must carry (ODbL), if anything
    source : the file it was made from
    """

    buildings: list[Building] = field(default_factory=list)
    attribution: str | None = None
    source: str = "a map"


def build_osm_city(
    buildings: Sequence[Building],
    terrain: Terrain,
    rng: np.random.Generator,
    streets: Sequence[RouteCurve] = (),
    layout: Layout | None = None,
    attribution: str | None = None,
    source: str = "a map",
) -> OsmCity:
    """Raise `buildings` (m, x east, y north) on `terrain`. The same generator state gives the same city.

    A building looks the same whichever others stand around it. Heights that the map does not know are drawn.
    `streets` : middles of the roads to pave and furnish by `layout`, the main one first; without, all ground is lawn.
    Raises InputError when there are no buildings.
    """
    if not buildings:
        raise InputError("a city needs at least one building: the OpenStreetMap extract gives none here")
    builder, layout, roads = MeshBuilder(), layout or Layout(), list(streets)
    built = _raise_buildings(builder, buildings, terrain, int(rng.integers(2**32)))
    network = Network(roads) if roads else None
    _add_ground(builder, built, terrain, network, layout.band, rng)
    outlines = [(footprint.outer, building.height or 0.0) for building in built for footprint in building.footprints]
    if network is not None:
        _furnish(builder, network, outlines, terrain, layout, rng)
    return OsmCity(
        builder.build(),
        terrain,
        roads[0] if roads else None,
        [outer for outer, _ in outlines],
        [height for _, height in outlines],
        roads,
        buildings=built,
        attribution=attribution,
        source=source,
    )


def _raise_buildings(
    builder: MeshBuilder, buildings: Sequence[Building], terrain: Terrain, seed: int
) -> list[Building]:
    built = []
    for building in buildings:
        kind, number = building.osm_id.split("/")
        own = np.random.default_rng([seed, kind == "relation", int(number) < 0, abs(int(number))])
        height = building.height if building.height is not None else building.base + likely_height(building, own)
        building = replace(building, height=height)
        corners = np.concatenate([ring for footprint in building.footprints for ring in footprint.rings])
        ground = terrain.height(corners)
        extrude(builder, building, float(ground.min()), float(ground.max()), own)
        built.append(building)
    return built


def _add_ground(
    builder: MeshBuilder,
    buildings: list[Building],
    terrain: Terrain,
    network: Network | None,
    band: float,
    rng: np.random.Generator,
) -> None:
    """A grid of grass under everything and round it, lower where a road covers it; cells grow under a whole district."""
    places = [footprint.outer for building in buildings for footprint in building.footprints]
    places += [street.position(street.sample(2.0)) for street in (network.streets if network else ())]
    everything = np.concatenate(places)
    low, high = everything.min(0) - MARGIN, everything.max(0) + MARGIN
    cell = max(CELL, float(np.sqrt(np.prod(high - low) / MOST_CELLS)))
    x, y = (np.arange(low[k], high[k] + cell, cell) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = terrain.height(xy) + rng.normal(0, 0.01, xy.shape[:2])
    if network is not None:
        # No hole is cut, so that no ray falls through where the strips of two roads meet at an angle.
        z += KERB - BESIDE_KERB - UNDER_ROAD * (network.distance(xy) < band - 0.3)
    vertices = np.concatenate([xy, z[..., None]], -1).reshape(-1, 3)
    builder.add(vertices, grid_faces(len(x), len(y)), Surface.LAWN)


def _furnish(
    builder: MeshBuilder,
    network: Network,
    outlines: list[tuple[Floats, float]],
    terrain: Terrain,
    layout: Layout,
    rng: np.random.Generator,
) -> None:
    """Roads with kerbs, and beside them cars, trees, poles and bins wherever no building is in the way."""
    for street in network.streets:
        add_road(builder, street, network, terrain, layout, rng)
    allowed = _Gaps(network, layout, [outer for outer, _ in outlines])
    for street in network.streets:
        for side in (1, -1):
            add_street_furniture(builder, street, terrain, layout, rng, side, allowed)
    lots = Lots(network.streets, layout)
    for outer, height in outlines:
        lots.take(outer, height)
    add_garden_trees(builder, lots, terrain, layout, rng)


class _Gaps:
    """Whether a place beside a road is free of other roads, of what stands there already, and of walls."""

    def __init__(self, network: Network, layout: Layout, outlines: list[Floats]) -> None:
        from shapely import Polygon, STRtree

        self._places, self._road = Places(network, layout), layout.road
        self._walls = STRtree([Polygon(outer) for outer in outlines])

    def __call__(self, xy: Floats, offset: float, yaw: float) -> bool:
        from shapely import points

        is_car = offset < self._road
        half = 0.5 * CAR_LENGTH * is_car * np.array([np.cos(yaw), np.sin(yaw)])
        ends = points(np.stack([xy - half, xy, xy + half]))
        near = self._walls.query(ends, predicate="dwithin", distance=AIR[is_car])
        return near.size == 0 and self._places(xy, offset, yaw)
