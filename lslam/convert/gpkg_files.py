"""GeoPackage, what QGIS opens as layers with columns: places in WGS84, by fudgeo, which is a fortieth of GDAL's size."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.errors import OutputError, cause
from lslam.extras import importing, install_hint

Shape = Literal["points", "lines", "polygons"]
Value = int | float | str | datetime | None
_WGS84 = 4326


@dataclass(frozen=True)
class GeoLayer:
    """One layer.

    shape : points at (3,), lines along (K, 3), or lists of polygons, each a list of rings (K, 2) whose last corner is the first;
        all in longitude, latitude (deg) and, of three, height (m)
    features : one place or shape each; columns : as many values by name, of one type or None
    about : what a user of the file should know
    """

    name: str
    shape: Shape
    features: Sequence[Any]
    columns: Mapping[str, Sequence[Value]]
    about: str = ""


def write_gpkg(path: Path, layers: Sequence[GeoLayer]) -> None:
    """Write the layers to `path`, a new file whose name ends in .gpkg; whoever calls makes it appear at once.

    Raises OutputError when it cannot be written, InputError without fudgeo.
    """
    with importing("fudgeo", install_hint("geo")):
        from fudgeo import GeoPackage
    try:
        package = GeoPackage.create(path, flavor="EPSG")
        try:
            for layer in layers:
                _write_layer(package, layer)
        finally:
            package.connection.close()
    except (OSError, sqlite3.Error) as error:
        raise OutputError(f"{path} cannot be written: {cause(error)}") from None


def _write_layer(package: Any, layer: GeoLayer) -> None:
    from fudgeo import Field
    from fudgeo.enumeration import ShapeType
    from fudgeo.geometry import LineStringZ, MultiPolygon, PointZ

    kinds = {
        "points": (ShapeType.point, lambda place: PointZ(x=place[0], y=place[1], z=place[2], srs_id=_WGS84)),
        "lines": (ShapeType.linestring, lambda line: LineStringZ(line, srs_id=_WGS84)),
        "polygons": (ShapeType.multi_polygon, lambda parts: MultiPolygon(parts, srs_id=_WGS84)),
    }
    shape, make = kinds[layer.shape]
    made = package.create_feature_class(
        layer.name, package.spatial_references[_WGS84], shape, z_enabled=layer.shape != "polygons",
        fields=[Field(name, _type_of(values)) for name, values in layer.columns.items()],
        description=layer.about, spatial_index=False, geom_name="geom",
    )  # fmt: skip
    rows = zip(map(make, layer.features), *(map(_plain, values) for values in layer.columns.values()), strict=True)
    names = ", ".join(f'"{name}"' for name in ("geom", *layer.columns))
    marks = ", ".join("?" * (1 + len(layer.columns)))
    with package.connection as connection:
        connection.executemany(f'INSERT INTO "{layer.name}" ({names}) VALUES ({marks})', rows)
    if len(layer.features):
        made.extent = _extent(layer)
    made.add_spatial_index()


def _type_of(values: Sequence[Value]) -> str:
    from fudgeo.enumeration import FieldType

    known = {int: FieldType.integer, float: FieldType.double, datetime: FieldType.datetime}
    return str(known.get(next((type(v) for v in values if v is not None), str), FieldType.text))


def _plain(value: Value) -> int | float | str | None:
    """Dates as the standard has them, to the millisecond, UTC."""
    return f"{value:%Y-%m-%dT%H:%M:%S}.{value.microsecond // 1000:03d}Z" if isinstance(value, datetime) else value


def _extent(layer: GeoLayer) -> tuple[float, float, float, float]:
    """West, south, east, north."""
    parts: list[NDArray[np.float64]] = []
    for feature in layer.features:
        parts += (
            [ring for polygon in feature for ring in polygon] if layer.shape == "polygons" else [np.atleast_2d(feature)]
        )
    corners = np.concatenate([part[:, :2] for part in parts])
    (west, south), (east, north) = corners.min(0).tolist(), corners.max(0).tolist()
    return west, south, east, north
