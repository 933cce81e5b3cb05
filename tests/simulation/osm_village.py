"""A small extract to drive through: a main street with a bend, a side street, houses along both, and ways nobody drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry.geodesy import from_local
from lslam.core.types.building import Building, Footprint
from lslam.io.formats.osm_data import ATTRIBUTION, OsmData, Way
from lslam.io.formats.osm_files import write_osm
from lslam.simulation.osm_extract import osm_from_buildings

ORIGIN = np.array([49.0112, 8.4229, 0.0])
MAIN = [(-130.0, 0.0), (-40.0, 0.0), (60.0, 0.0), (60.0, 110.0)]
SIDE = [(-40.0, 0.0), (-40.0, 70.0)]


def box(x: float, y: float, width: float = 12.0, depth: float = 9.0) -> NDArray[np.float64]:
    return np.array([[x, y], [x + width, y], [x + width, y + depth], [x, y + depth]])


def houses() -> list[Building]:
    """Rows on both sides of the main street, one far away from everything, one across the end of the alley."""
    corners = [box(x, y) for x in np.arange(-125.0, 40.0, 18.0) for y in (9.0, -18.0) if not (y > 0 and -60 < x < -25)]
    corners += [box(x, y) for x in (38.0, 70.0) for y in np.arange(30.0, 110.0, 16.0)]
    corners.append(box(-60.0, 130.0, 80.0, 6.0))
    return [Building(f"way/{k}", (Footprint(c),), 7.5, tags={"building": "house"}) for k, c in enumerate(corners, 1)]


def village(streets: bool = True) -> OsmData:
    """The extract, everything in metres from `ORIGIN`."""
    data = osm_from_buildings(houses(), ORIGIN, ATTRIBUTION)
    ways = [
        (MAIN, {"highway": "residential"}),
        (SIDE, {"highway": "service"}),
        # Longer than any street, but under the ground, for feet, or through a house.
        ([(-130.0, 0.0), (-130.0, 400.0)], {"highway": "residential", "tunnel": "yes"}),
        ([(60.0, 110.0), (60.0, 500.0)], {"highway": "steps"}),
        ([(-20.0, 0.0), (-20.0, 140.0), (-20.0, 160.0)], {"highway": "service"}),
    ]
    numbers: dict[tuple[float, float], int] = {}
    for k, (line, tags) in enumerate(ways if streets else []):
        for corner in line:
            if corner not in numbers:
                numbers[corner] = 10_000 + len(numbers)
                lat, lon, _ = from_local(np.array([[*corner, 0.0]]), ORIGIN)[0]
                data.add_node(numbers[corner], round(float(lat), 7), round(float(lon), 7))
        data.add_way(Way(20_000 + k, tuple(numbers[corner] for corner in line), tags))
    return data


def write_village(path: Path, streets: bool = True) -> Path:
    """The extract as a file."""
    write_osm(path, village(streets))
    return path
