"""GeoJSON (RFC 7946): trajectories as lines, and outlines as polygons."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, cause
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import write_text
from lslam.io.formats.osm_data import DECIMALS


def write_line(path: Path, lat_lon_alt: NDArray[Any], properties: Mapping[str, Any]) -> None:
    """Write a trajectory (N, 3) of lat, lon (deg), height (m), WGS84, as one line feature, atomically; a point if N is 1.

    Degrees have 7 decimals (1 cm), heights 3. Raises OutputError when the file cannot be written.
    """
    places = [
        [round(float(lon), 7), round(float(lat), 7), round(float(height), 3)]
        for lat, lon, height in np.asarray(lat_lon_alt, np.float64).reshape(-1, 3)
        if np.isfinite([lat, lon, height]).all()
    ]
    geometry: dict[str, Any] | None = {"type": "LineString", "coordinates": places}
    if len(places) < 2:
        geometry = {"type": "Point", "coordinates": places[0]} if places else None
    feature = {"type": "Feature", "properties": dict(properties), "geometry": geometry}
    text = json.dumps({"type": "FeatureCollection", "features": [feature]}, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")


def write_areas(
    path: Path, outlines: Iterable[Floats], properties: Iterable[Mapping[str, Any]], about: Mapping[str, Any]
) -> None:
    """Write each outline (C, 2), counter-clockwise, as a polygon with its properties, atomically.

    `about` describes the collection. Coordinates have 7 decimals. They are longitude and latitude, deg, or metres if the
    place is not georeferenced; `about` then says so. Raises OutputError when the file cannot be written.
    """
    features = [
        {
            "type": "Feature",
            "properties": dict(said),
            "geometry": {"type": "Polygon", "coordinates": [np.round([*ring, ring[0]], DECIMALS).tolist()]},
        }
        for ring, said in zip(outlines, properties, strict=True)
    ]
    tree = {"type": "FeatureCollection", **about, "features": features}
    write_text(path, json.dumps(tree, allow_nan=False, ensure_ascii=False) + "\n")


def read_line(path: Path) -> Floats:
    """Read the only line of a file as (N, 3) lat, lon (deg), height (m, 0 where unknown), WGS84. A point gives N = 1.

    Raises InputError naming the file: unreadable, no GeoJSON, without exactly one line, with positions off the Earth.
    """
    try:
        tree = parse_json(path.read_bytes())
        lines = [shape["coordinates"] for shape in _shapes(tree) if shape.get("type") in ("LineString", "Point")]
        rows = lines[0] if len(lines) == 1 and np.ndim(lines[0][0]) else lines
        # Of two lines the rows are lines.
        places = np.array([[*row, 0.0][:3] for row in rows], np.float64).reshape(len(rows), 3)[:, [1, 0, 2]]
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    except MISFIT:
        raise InputError(f"{path} is no GeoJSON of one line in longitude and latitude") from None
    if not (np.isfinite(places).all() and (np.abs(places[:, :2]) <= [90, 180]).all()):
        raise InputError(
            f"{path} is no GeoJSON of one line in longitude and latitude: some of its numbers are no degrees"
        )
    return places


def _shapes(tree: Any) -> Iterator[Any]:
    """Geometries of a GeoJSON document."""
    if tree.get("type") == "FeatureCollection":
        for feature in tree["features"]:
            yield from _shapes(feature)
    elif tree.get("type") == "Feature":
        yield from _shapes(tree.get("geometry") or {})
    else:
        yield tree
