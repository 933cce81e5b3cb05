"""A city raised from the buildings of an OpenStreetMap extract, on uneven ground, along a street where one is driven."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.osm_buildings import buildings_near, read_buildings
from lslam.simulation.city import MARGIN, City
from lslam.simulation.curve import Curve
from lslam.simulation.extrusion import extrude, likely_height
from lslam.simulation.mesh import MeshBuilder, Surface, grid_faces
from lslam.simulation.terrain import Terrain
from lslam.types.building import Building

Floats = NDArray[np.float64]

ROAD, PAVEMENT = 4.5, 6.5  # m from the middle of a street to their edges
CELL = 1.0  # m, of the ground
MOST_CELLS = 1_500_000
REACH = 150.0  # m from the path: what stands farther away, no LiDAR here sees


@dataclass(frozen=True)
class OsmCity(City):
    """A `City` that knows its buildings; x is east and y north of the extract's origin.

    buildings : as built, every one with a height; attribution : what outputs made from it must carry (ODbL), if anything
    """

    buildings: list[Building] = field(default_factory=list)
    attribution: str | None = None


def build_osm_city(
    buildings: Sequence[Building],
    terrain: Terrain,
    rng: np.random.Generator,
    street: Curve | None = None,
    attribution: str | None = None,
) -> OsmCity:
    """Raise `buildings` (m, x east, y north) on `terrain`. The same generator state gives the same city.

    A building looks the same whichever others stand around it. Heights that the map does not know are drawn.
    `street` : middle of the road to pave; else all ground is lawn. Raises InputError when there are no buildings.
    """
    if not buildings:
        raise InputError("a city needs at least one building: the OpenStreetMap extract gives none here")
    builder = MeshBuilder()
    seed = int(rng.integers(2**32))
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
    _add_ground(builder, built, terrain, street, rng)
    outlines = [(footprint.outer, building.height or 0.0) for building in built for footprint in building.footprints]
    return OsmCity(
        builder.build(),
        terrain,
        street,
        [outer for outer, _ in outlines],
        [height for _, height in outlines],
        [] if street is None else [street],
        buildings=built,
        attribution=attribution,
    )


def city_from_osm(
    path: Path,
    origin: NDArray[Any],
    terrain: Terrain,
    rng: np.random.Generator,
    positions: NDArray[Any] | None = None,
    street: Curve | None = None,
) -> OsmCity:
    """A city from the extract `path`, x = y = 0 at `origin` (3,) lat, lon (deg), height (m).

    positions : (N, 2) m of the path; only buildings within 150 m of it are raised (default: all)

    Raises InputError, one sentence naming the file: unreadable, without buildings, far from the origin or from the path.
    """
    extract = read_buildings(path, origin)
    buildings = extract.buildings if positions is None else buildings_near(extract, positions, REACH)
    return build_osm_city(buildings, terrain, rng, street, extract.attribution)


def _add_ground(
    builder: MeshBuilder, buildings: list[Building], terrain: Terrain, street: Curve | None, rng: np.random.Generator
) -> None:
    """A grid of ground under everything and round it; cells grow where a whole district is built."""
    places = [footprint.outer for building in buildings for footprint in building.footprints]
    middle = None if street is None else street.position(street.sample(0.5))
    everything = np.concatenate(places if middle is None else [*places, middle])
    low, high = everything.min(0) - MARGIN, everything.max(0) + MARGIN
    cell = max(CELL, float(np.sqrt(np.prod(high - low) / MOST_CELLS)))
    x, y = (np.arange(low[k], high[k] + cell, cell) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = terrain.height(xy) + rng.normal(0, 0.01, xy.shape[:2])
    faces = grid_faces(len(x), len(y))
    vertices = np.concatenate([xy, z[..., None]], -1).reshape(-1, 3)
    kinds = np.full(len(faces), Surface.LAWN, np.uint8)
    if middle is not None:
        from scipy.spatial import cKDTree

        centres = vertices[faces, :2].mean(axis=1)
        beside = np.asarray(cKDTree(middle).query(centres, distance_upper_bound=PAVEMENT)[0])
        kinds[beside < PAVEMENT] = Surface.PAVEMENT
        kinds[beside < ROAD] = Surface.ROAD
    builder.add(vertices, faces, kinds)
