"""OpenStreetMap extracts of a scene: an exact one, and one perturbed like real maps, with a record of the changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError, OutputError, cause
from lslam.core.geometry.geodesy import from_local
from lslam.core.types.arrays import Floats
from lslam.core.types.building import Building, footprints_of
from lslam.io.formats.osm_buildings import buildings_of, height_of
from lslam.io.formats.osm_data import DECIMALS, AreaMaker, OsmData, Place
from lslam.io.formats.osm_files import write_osm
from lslam.simulation.city import City
from lslam.simulation.osm_city import OsmCity
from lslam.simulation.osm_perturb import MapFaults, Perturbation, draw_perturbation, perturb, write_perturbation

EXACT, PERTURBED = "map.osm", "map_perturbed.osm"
RECORD = "truth/map_perturbation.json"  # below truth/: no method may read it
ROADSIDE = 7.0  # m from the middle of a street that stay free of houses not yet built


@dataclass(frozen=True)
class Extracts:
    """Paths of the two maps and the record, and the perturbation itself."""

    exact: Path
    perturbed: Path
    record: Path
    perturbation: Perturbation


def write_extracts(
    folder: Path,
    city: City,
    origin: NDArray[Any],
    rng: np.random.Generator,
    faults: MapFaults | None = None,
) -> Extracts:
    """Write `map.osm`, `map_perturbed.osm` and `truth/map_perturbation.json` below `folder`, each atomically.

    Parameters
    ----------
    city : its x is east, its y north of `origin`
    origin : (3,) lat, lon (deg), height (m) of the city frame's x = y = 0
    faults : how wrong the perturbed copy is

    Raises
    ------
    InputError : the city has no buildings; OutputError : `folder` cannot be written

    The perturbation starts from the exact map as it reads back, rounded to 1e-7 deg, so `perturb` of that map and the record
    give the perturbed file again, byte for byte.
    """
    attribution = city.attribution if isinstance(city, OsmCity) else None
    buildings = city_buildings(city)
    if not buildings:
        raise InputError("a scene without buildings has no OpenStreetMap extract")
    data = osm_from_buildings(buildings, origin, attribution)
    exact = buildings_of(data, origin).buildings
    drawn = draw_perturbation(exact, faults or MapFaults(), rng, _streets(city))
    perturbation = replace(drawn, attribution=attribution)
    extracts = Extracts(folder / EXACT, folder / PERTURBED, folder / RECORD, perturbation)
    try:
        extracts.record.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{extracts.record.parent} cannot be made: {cause(error)}") from None
    write_osm(extracts.exact, data)
    write_osm(extracts.perturbed, osm_from_buildings(perturb(exact, perturbation), origin, attribution))
    write_perturbation(extracts.record, perturbation)
    return extracts


def osm_from_buildings(buildings: Sequence[Building], origin: NDArray[Any], attribution: str | None) -> OsmData:
    """Extract of `buildings` (local frame at `origin`), degrees rounded to 7 decimals as in a file.

    Nodes, and rings of multipolygons, get negative numbers, which no element of OpenStreetMap has.
    """
    data = OsmData(attribution=attribution)
    names = [(kind, int(number)) for kind, number in (building.osm_id.split("/") for building in buildings)]
    maker = AreaMaker(data, {number for _, number in names}, shares_nodes=False)
    for name, building in zip(names, buildings, strict=True):
        polygons = [[_places(ring, origin) for ring in footprint.rings] for footprint in building.footprints]
        tags = _written_tags(building)
        maker.add(name, polygons, tags, {"type": "multipolygon", **tags})
    return data


def city_buildings(city: City) -> list[Building]:
    """Buildings of a city, m, in its frame; those of a generated one get negative numbers and heights rounded to 0.1 m."""
    from shapely import Polygon

    if isinstance(city, OsmCity):
        return city.buildings
    heights: list[float | None] = [round(height, 1) for height in city.heights]
    heights = heights or [None] * len(city.footprints)
    return [
        Building(f"way/-{k}", footprints_of(Polygon(outline)), height, tags={"building": "house"})
        for k, (outline, height) in enumerate(zip(city.footprints, heights, strict=True), 1)
    ]


def _places(ring: Floats, origin: NDArray[Any]) -> list[Place]:
    """Corners (K, 2), m, as degrees rounded as in a file."""
    fixes = from_local(np.column_stack([ring, np.zeros(len(ring))]), origin)
    return [(round(lat, DECIMALS), round(lon, DECIMALS)) for lat, lon, _ in fixes.tolist()]


def _written_tags(building: Building) -> dict[str, str]:
    """Tags of a building; its height is added where the tags lack it or differ."""
    tags = {"building": "yes", **building.tags}
    if building.height is not None and height_of(tags) != building.height:
        tags["height"] = f"{building.height:.10g}"
    return tags


def _streets(city: City) -> Any:
    """Area of all streets, None where there are none."""
    from shapely import LineString, union_all

    streets = city.streets or ([] if city.street is None else [city.street])
    lines = [LineString(street.position(street.sample(2.0))).buffer(ROADSIDE) for street in streets]
    return union_all(lines) if lines else None
