"""Index of tiles as a virtual point cloud (VPC): STAC items of the files, which QGIS opens as one layer."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.types.cloud import TIME_NS, ArrayCloud
from lslam.io.formats.atomic import write_text
from lslam.io.formats.las_files import is_extra
from lslam.io.formats.text_tables import utc_of
from lslam.maps.georeference import Projection, to_wgs84

VPC = "tiles.vpc"
_EXTENSIONS = ("pointcloud/v1.0.0", "projection/v1.1.0")
_KINDS = {"f": "floating", "u": "unsigned", "i": "signed"}
# Names of PDAL for the columns that have a field in LAS.
_DIMENSIONS: dict[str, tuple[str, np.dtype[Any]]] = {
    TIME_NS: ("GpsTime", np.dtype(np.float64)),
    "scan": ("PointSourceId", np.dtype(np.uint16)),
    "class": ("Classification", np.dtype(np.uint8)),
    **{name.lower(): (name, np.dtype(np.uint16)) for name in ("Red", "Green", "Blue")},
}
_UNKNOWN = "1970-01-01T00:00:00Z"  # as the header of the LAS files


def vpc_item(name: str, tile: ArrayCloud, projection: Projection) -> dict[str, Any]:
    """STAC item of the file `name`, whose points are in the coordinates of the projection, m."""
    low, high = tile.points.min(axis=0), tile.points.max(axis=0)
    box = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]]
    corners = [np.column_stack([box, np.full(5, z)]) for z in (low[2], high[2])]
    georeference = projection.georeference
    places = to_wgs84(np.concatenate(corners), projection.epsg, georeference.height_epsg, georeference.geoid)
    places = places[:, [1, 0, 2]]
    utc = utc_of(tile.columns[TIME_NS]) if TIME_NS in tile.columns else None
    schemas = [_schema(axis, np.dtype(np.float64)) for axis in "XYZ"] + [_schema("Intensity", np.dtype(np.uint16))]
    for column, kind in tile.column_types.items():
        if column in _DIMENSIONS:
            schemas.append(_schema(*_DIMENSIONS[column]))
        if column not in _DIMENSIONS or is_extra(column, kind):
            schemas.append(_schema(column, kind))
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": [f"https://stac-extensions.github.io/{one}/schema.json" for one in _EXTENSIONS],
        "id": name.split(".")[0],
        "geometry": {"type": "Polygon", "coordinates": [places[:5, :2].tolist()]},
        "bbox": [*places.min(0).tolist(), *places.max(0).tolist()],
        "properties": {
            "datetime": _UNKNOWN if utc is None else f"{min(utc):%Y-%m-%dT%H:%M:%S}Z",
            "pc:count": len(tile),
            "pc:type": "lidar",
            "pc:encoding": "LASzip",
            "pc:schemas": schemas,
            "proj:bbox": [*low.tolist(), *high.tolist()],
            "proj:wkt2": projection.wkt2,
        },
        "links": [],
        "assets": {"data": {"href": f"./{name}", "roles": ["data"]}},
    }


def _schema(name: str, kind: np.dtype[Any]) -> Mapping[str, Any]:
    return {"name": name, "size": kind.itemsize, "type": _KINDS[kind.kind]}


def write_vpc(folder: Path, items: list[dict[str, Any]]) -> None:
    """Write the index of the items. Raises OutputError."""
    write_text(folder / VPC, json.dumps({"type": "FeatureCollection", "features": items}, indent=1) + "\n")
