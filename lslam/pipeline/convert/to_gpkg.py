"""A georeferenced run as a GeoPackage: its trajectory, the status of each scan, and the corrected buildings, with styles."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, OutputError, UsageError, cause
from lslam.core.extras import importing, install_hint
from lslam.core.types.gnss import OutputCrs
from lslam.io.formats.text_tables import utc_of
from lslam.maps.georeference import LocalFrame, Projection, in_crs
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.pipeline.convert import stage
from lslam.pipeline.convert.convert_trajectory import georeference_beside
from lslam.pipeline.rebuild import EarlierRun, covariances_of, read_run, results_of
from lslam.pipeline.run_folder import require_new, require_run

Shape = Literal["points", "lines", "polygons"]
Value = int | float | str | datetime | None
_SYMBOLS = {"points": ("marker", "SimpleMarker"), "lines": ("line", "SimpleLine"), "polygons": ("fill", "SimpleFill")}
_GREEN, _ORANGE, _GREY, _BLUE, _RED = "#2e7d32", "#ef6c00", "#9e9e9e", "#1565c0", "#c62828"
_SCANS = {"ok": _GREEN, "bridged": _ORANGE, "skipped": _GREY}
_BUILDINGS = {"seen": _GREEN, "unseen": _GREY, "absent": _RED}
SUFFIX = ".gpkg"


@dataclass(frozen=True)
class GeoLayer:
    """One layer of a GeoPackage.

    shape : points at (3,), lines along (K, 3), or lists of polygons, each a list of rings (K, 2) whose last corner is the first;
        all in the projected coordinates of the file, m
    features : one place or shape each; columns : as many values by name, of one type or None
    about : what a user of the file should know; colours : of each value of `status`, or by "" of all
    """

    name: str
    shape: Shape
    features: Sequence[Any]
    columns: Mapping[str, Sequence[Value]]
    about: str = ""
    colours: Mapping[str, str] = field(default_factory=dict)


def write_gpkg(path: Path, layers: Sequence[GeoLayer], projection: Projection | LocalFrame) -> None:
    """Write the layers to `path`, a new file ending in .gpkg, with QGIS' styles. It is not atomic; the caller renames it.

    Layers in a local frame have the undefined Cartesian reference system of the standard. Raises OutputError when it cannot be
    written, InputError without fudgeo.
    """
    with importing("fudgeo", install_hint("geo")):
        from fudgeo import GeoPackage, SpatialReferenceSystem
    code = ("NONE", -1, "undefined") if projection.epsg is None else ("EPSG", projection.epsg, projection.plane_wkt)
    system = SpatialReferenceSystem(projection.plane, *code)
    try:
        package = GeoPackage.create(path, flavor="EPSG")
        try:
            if projection.epsg is not None:
                package.add_spatial_reference(system)
            for layer in layers:
                _write_layer(package, layer, system)
            _write_styles(package, layers)
        finally:
            package.connection.close()
    except (OSError, sqlite3.Error) as error:
        raise OutputError(f"{path} cannot be written: {cause(error)}") from None


def _write_layer(package: Any, layer: GeoLayer, system: Any) -> None:
    """Create a feature table of the GeoPackage `package` in the reference system `system`, with features and columns."""
    from fudgeo import Field
    from fudgeo.enumeration import ShapeType
    from fudgeo.geometry import LineStringZ, MultiPolygon, PointZ

    kinds = {
        "points": (ShapeType.point, lambda place: PointZ(x=place[0], y=place[1], z=place[2], srs_id=system.srs_id)),
        "lines": (ShapeType.linestring, lambda line: LineStringZ(line, srs_id=system.srs_id)),
        "polygons": (ShapeType.multi_polygon, lambda parts: MultiPolygon(parts, srs_id=system.srs_id)),
    }
    shape, make = kinds[layer.shape]
    made = package.create_feature_class(
        layer.name,
        system,
        shape,
        z_enabled=layer.shape != "polygons",
        fields=[Field(name, _type_of(values)) for name, values in layer.columns.items()],
        description=layer.about,
        spatial_index=False,
        geom_name="geom",
    )
    rows = zip(map(make, layer.features), *(map(_plain, values) for values in layer.columns.values()), strict=True)
    names = ", ".join(f'"{name}"' for name in ("geom", *layer.columns))
    marks = ", ".join("?" * (1 + len(layer.columns)))
    with package.connection as connection:
        connection.executemany(f'INSERT INTO "{layer.name}" ({names}) VALUES ({marks})', rows)
    if len(layer.features):
        made.extent = _extent(layer)
    made.add_spatial_index()


def _type_of(values: Sequence[Value]) -> str:
    """Column type of a GeoPackage for the values."""
    from fudgeo.enumeration import FieldType

    known = {int: FieldType.integer, float: FieldType.double, datetime: FieldType.datetime}
    return str(known.get(next((type(v) for v in values if v is not None), str), FieldType.text))


def _plain(value: Value) -> int | float | str | None:
    """Values for the file; dates as the standard requires, UTC, to the millisecond."""
    return f"{value:%Y-%m-%dT%H:%M:%S}.{value.microsecond // 1000:03d}Z" if isinstance(value, datetime) else value


def _extent(layer: GeoLayer) -> tuple[float, float, float, float]:
    """Limits x_min, y_min, x_max, y_max."""
    parts: list[Floats] = []
    for feature in layer.features:
        parts += (
            [ring for polygon in feature for ring in polygon] if layer.shape == "polygons" else [np.atleast_2d(feature)]
        )
    corners = np.concatenate([part[:, :2] for part in parts])
    (west, south), (east, north) = corners.min(0).tolist(), corners.max(0).tolist()
    return west, south, east, north


def _write_styles(package: Any, layers: Sequence[GeoLayer]) -> None:
    """Write the table layer_styles, from which QGIS takes the default style of each layer."""
    names = ("f_table_catalog", "f_table_schema", "f_table_name", "f_geometry_column", "styleName", "styleQML", "owner")
    rows = [("", "", layer.name, "geom", "lslam", _style(layer), "lslam", 1) for layer in layers if layer.colours]
    with package.connection as connection:
        connection.execute(
            f"CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, {' TEXT, '.join(names)} TEXT, "
            "useAsDefault BOOLEAN, styleSLD TEXT, description TEXT, ui TEXT, update_time DATETIME)"
        )
        connection.executemany(
            f"INSERT INTO layer_styles ({', '.join(names)}, useAsDefault) VALUES ({', '.join('?' * 8)})", rows
        )
        connection.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('layer_styles', 'attributes', 'layer_styles')"
        )


def _style(layer: GeoLayer) -> str:
    """QML style of a layer for QGIS: one colour, or a colour per status."""
    kind, drawn_as = _SYMBOLS[layer.shape]
    is_single = "" in layer.colours
    about = {"type": "singleSymbol"} if is_single else {"type": "categorizedSymbol", "attr": "status"}
    root = Element("qgis", version="3.22", styleCategories="Symbology")
    renderer = SubElement(root, "renderer-v2", about)
    categories = None if is_single else SubElement(renderer, "categories")
    symbols = SubElement(renderer, "symbols")
    for k, (value, colour) in enumerate(layer.colours.items()):
        if categories is not None:
            SubElement(categories, "category", symbol=str(k), value=value, label=value, render="true")
        symbol = SubElement(symbols, "symbol", type=kind, name=str(k), alpha="0.5" if kind == "fill" else "1")
        drawn = SubElement(symbol, "layer", {"class": drawn_as}, enabled="1")
        own = {"color": colour, "line_color": colour, "outline_color": colour, "line_width": "0.6", "size": "1.6"}
        for name, text in own.items():
            SubElement(drawn, "prop", k=name, v=text)
    return "<!DOCTYPE qgis>" + tostring(root, encoding="unicode")


def convert_to_gpkg(
    folder: Path, out: Path, *, crs: OutputCrs | None = None, overwrite: bool = False
) -> list[GeoLayer]:
    """Write the available layers of the run in `folder` to `out`, whole or not at all.

    `trajectory` is one line, `scans` a point each with number, stamp, UTC where stamps are Unix time, status and the standard
    deviation where it is largest, `buildings` and `new_walls` what the run found of OpenStreetMap. Coordinates are those of the
    run's map, or of `crs`. QGIS draws scans and buildings in a colour of their status.
    Raises UsageError: the run is not georeferenced, or `out` has another suffix. OutputExistsError, OutputError: as named.
    InputError: `folder` is no folder of a run, its files are damaged, or fudgeo is missing.
    """
    if out.suffix != SUFFIX:
        raise UsageError(f"--out {out}: a GeoPackage is one file, its name ends in {SUFFIX}")
    require_new(out, overwrite)
    require_run(folder)
    projection = Projection(in_crs(georeference_beside(folder, "--to gpkg"), crs))
    projection.check()
    run = read_run(folder)
    if not len(run.trajectory):
        raise InputError(f"{folder / 'trajectory.tum'} has no pose")
    layers = pose_layers({run.name: run}, projection) + building_layers(folder, projection)
    with stage(out) as path:
        write_gpkg(path, layers, projection)
    return layers


def pose_layers(drives: Mapping[str, EarlierRun], projection: Projection | LocalFrame) -> list[GeoLayer]:
    """Layers of runs in one world, by name: a line each, and a point for each of their scans."""
    about = "; ".join(filter(None, [f"{projection.frame}; by lslam", projection.attribution]))
    whole: dict[str, list[Any]] = {name: [] for name in ("sequence", "scans", "length_m", "begin", "end")}
    names = ("sequence", "scan", "stamp_ns", "utc", "status", "sigma_m", "sigma_deg")
    columns: dict[str, list[Any]] = {name: [] for name in names}
    lines, points = [], []
    for name, run in drives.items():
        places = projection.apply(run.trajectory.positions)
        stamps, nothing = run.trajectory.stamps_ns, [None] * len(places)
        times = utc_of(stamps) or nothing
        covariances = covariances_of(run)
        in_deg = None if covariances is None else np.degrees(1) ** 2 * covariances[:, 3:, 3:]
        own: tuple[Sequence[Any], ...] = (
            [name] * len(places),
            [result.index for result in results_of(run)],
            stamps.tolist(),
            times,
            run.statuses,
            nothing if covariances is None else _sigmas(covariances[:, :3, :3]),
            nothing if in_deg is None else _sigmas(in_deg),
        )
        for column, values in zip(columns.values(), own, strict=True):
            column.extend(values)
        points += list(places)
        # A line has two points.
        lines.append(places if len(places) > 1 else np.repeat(places, 2, axis=0))
        facts = (name, len(places), float(run.trajectory.path_lengths[-1]), times[0], times[-1])
        for column, value in zip(whole.values(), facts, strict=True):
            column.append(value)
    return [
        GeoLayer("trajectory", "lines", lines, whole, about, {"": _BLUE}),
        GeoLayer("scans", "points", points, columns, about, _SCANS),
    ]


def _sigmas(covariances: Floats) -> list[float | None]:
    """Square root of the largest eigenvalue of each (N, 3, 3); None where it is not known."""
    known = np.asarray(np.isfinite(covariances).all((1, 2)))
    largest = np.linalg.eigvalsh(np.where(known[:, None, None], covariances, 0.0))[:, -1]
    return [float(np.sqrt(max(v, 0.0))) if k else None for v, k in zip(largest, known, strict=True)]


def building_layers(folder: Path, projection: Projection) -> list[GeoLayer]:
    """Layers of corrected buildings and new walls at their georeferenced positions, from buildings.geojson; none without it."""
    if not (folder / "buildings.geojson").is_file():
        return []
    corrections = read_buildings_geojson(folder / "buildings.geojson")
    # Buildings lie in the local frame of their own origin.
    there = Projection(
        replace(projection.georeference, origin=corrections.origin, T_enu_world=np.eye(4), epsg=projection.epsg)
    )
    about = f"{corrections.attribution}; corrected by lslam" if corrections.attribution else "corrected by lslam"
    buildings = corrections.buildings
    polygons = [
        [[_close_ring(ring, there) for ring in footprint.rings] for footprint in c.real_building.footprints]
        for c in buildings
    ]
    columns: dict[str, Any] = {
        "osm_id": [c.building.osm_id for c in buildings],
        "status": [c.status for c in buildings],
        "displacement_east_m": [float(c.displacement[0]) for c in buildings],
        "displacement_north_m": [float(c.displacement[1]) for c in buildings],
        "turn_deg": [float(np.degrees(c.displacement[2])) for c in buildings],
        "confidence": [c.confidence for c in buildings],
        "height_m": [c.building.height for c in buildings],
        "name": [c.building.tags.get("name") for c in buildings],
    }
    walls = [_project(wall, there) for wall in corrections.new_walls]
    lengths = np.linalg.norm(corrections.new_walls[:, 1] - corrections.new_walls[:, 0], axis=1).tolist()
    return [
        GeoLayer("buildings", "polygons", polygons, columns, about, _BUILDINGS),
        GeoLayer(
            "new_walls",
            "lines",
            walls,
            {"length_m": lengths},
            f"walls where the map has no building; {about}",
            {"": _RED},
        ),
    ]


def _project(points: Floats, projection: Projection) -> Floats:
    """Positions (K, 2), m, as (K, 3) projected coordinates, at the height of the origin."""
    return projection.apply(np.column_stack([points, np.zeros(len(points))]))


def _close_ring(ring: Floats, projection: Projection) -> Floats:
    """Projected corners (K + 1, 2), m, of a ring, the first repeated at the end."""
    return _project(np.concatenate([ring, ring[:1]]), projection)[:, :2]
