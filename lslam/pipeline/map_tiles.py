"""Map in square tiles with an index, each a file, of which one is in memory at a time; and a map, tiles or not, as a prior."""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.localization.prior_map import PriorMap, make_prior_map
from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import (
    ConfigError,
    InputError,
    InterruptedRunError,
    OutputError,
    OutputExistsError,
    UsageError,
    output_errors,
)
from lslam.core.types.cloud import TIME_NS, ArrayCloud, Cloud
from lslam.core.types.gnss import Georeference, OutputCrs
from lslam.core.types.sequence import Sequence
from lslam.io.formats.atomic import write_text
from lslam.io.formats.copc_files import SUFFIX as COPC
from lslam.io.formats.las_files import is_extra
from lslam.io.formats.point_files import write_cloud
from lslam.io.formats.text_tables import utc_of
from lslam.maps.georeference import ProjectedCloud, Projection, to_wgs84
from lslam.pipeline.further_passes import build_finished_map
from lslam.pipeline.map_files import MapNote, projection_of, write_json
from lslam.pipeline.map_pass import INTERRUPTED
from lslam.pipeline.merge_runs import read_session
from lslam.pipeline.rebuild import EarlierRun, place_of, results_of
from lslam.pipeline.run_folder import SPOOL
from lslam.pipeline.stored_map import INDEX, is_tiles, map_of
from lslam.pipeline.watch import SILENT, Watch
from lslam.registration.preprocessing.ground import Z

log = logging.getLogger("lslam")
SCHEMA = 1
# Points that wait for their tiles' files, so that a map of any size needs little memory and few open files.
MOST_WAITING = 1 << 22
# Index of the tiles as a virtual point cloud: STAC items of the files, which QGIS opens as one layer.
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
# m; coordinates beyond are those of a projection, which a trajectory in float32 plots and maps would lose centimetres of.
LARGE, KILOMETRE = 1e5, 1000.0


def rebuild_in_tiles(
    run: EarlierRun,
    sequence: Sequence,
    folder: Path,
    size: float,
    *,
    crs: OutputCrs | None = None,
    watch: Watch = SILENT,
) -> dict[str, Any]:
    """Build a run's map again, in tiles of `size` m in the checked `folder`; returns the index. Raises as `rebuild`."""
    georeference = place_of(run, crs)
    built = build_finished_map(sequence, results_of(run), run.config, watch, folder)
    if watch.should_stop():
        raise InterruptedRunError(INTERRUPTED)
    note = MapNote.of(sequence.name, run.config.map, built, run.world)
    return write_tiles(folder, built.cloud, note, size, run.config.map.format, georeference)


def write_tiles(
    folder: Path, cloud: Cloud, note: MapNote, size: float, suffix: str, georeference: Georeference | None = None
) -> dict[str, Any]:
    """Write the cloud as `folder`/tile_X_Y.<suffix> and the index map.json. Returns the index.

    Tiles in LAZ are COPC, `.copc.laz`; of a georeferenced run `tiles.vpc` makes them one layer of QGIS.

    Tile X, Y contains X * size <= x < (X + 1) * size, m, in the coordinates of `projection_of`. Raises OutputError, and
    UsageError for coordinates that no map can be written in.
    """
    projection = projection_of(georeference, f".{suffix}")
    if projection is not None:
        cloud = ProjectedCloud(cloud, projection.apply)
    tiles, items = [], []
    ending = COPC if suffix == "laz" else f".{suffix}"
    with tempfile.TemporaryDirectory(prefix=SPOOL, dir=folder, ignore_cleanup_errors=True) as stage:
        for key, tile in _sorted_into(cloud, size, Path(stage)):
            path = Path(stage) / f"tile_{key[0]}_{key[1]}{ending}"
            write_cloud(path, tile, wkt="" if projection is None else projection.wkt)
            low, high = tile.points.min(axis=0), tile.points.max(axis=0)
            if projection is not None and ending == COPC:
                items.append(vpc_item(path.name, tile, projection))
            tiles.append({"file": path.name, "points": len(tile), "low": low.tolist(), "high": high.tolist()})
        _publish(Path(stage), folder, {tile["file"] for tile in tiles})
    index: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": "tiles",
        "tile_m": size,
        "unit": "m",
        "points": len(cloud),
        "tiles": tiles,
        **note.facts(projection, georeference),
    }
    if items and projection is not None:
        place_items(items, projection)
        write_text(folder / VPC, json.dumps({"type": "FeatureCollection", "features": items}, indent=1) + "\n")
    write_json(folder / INDEX, index)
    return index


def _publish(stage: Path, folder: Path, names: set[str]) -> None:
    """Remove the old index and tiles not in `names`, then move the new tiles to their place. The index follows later."""
    with output_errors(f"the tiles in {folder}"):
        for index in (INDEX, VPC):
            (folder / index).unlink(missing_ok=True)
        for file in folder.glob("tile_*_*.*"):
            if file.name not in names:
                file.unlink()
        for name in sorted(names):
            os.replace(stage / name, folder / name)


def _sorted_into(cloud: Cloud, size: float, spool: Path) -> Iterator[tuple[tuple[int, int], ArrayCloud]]:
    """Key (X, Y) and points of each tile of `size` m, in order of keys; the points are sorted through files in `spool`."""
    record = np.dtype(
        [("points", np.float64, (3,)), ("intensity", np.float32), ("columns", list(cloud.column_types.items()))]
    )
    waiting: dict[tuple[int, int], list[NDArray[Any]]] = {}
    count, keys = 0, set[tuple[int, int]]()
    with output_errors(f"the tiles in {spool.parent}"):
        for block in cloud.blocks():
            table = np.empty(len(block), record)
            table["points"], table["intensity"] = block.points, 0.0 if block.intensity is None else block.intensity
            for name, values in block.columns.items():
                table["columns"][name] = values
            cells = np.floor(block.points[:, :2] / size).astype(np.int64)
            tiles, of = np.unique(cells, axis=0, return_inverse=True)
            for n, (x, y) in enumerate(tiles.tolist()):
                waiting.setdefault((x, y), []).append(table[of.ravel() == n])
            count += len(block)
            if count > MOST_WAITING:
                keys |= _spill(waiting, spool)
                count = 0
        keys |= _spill(waiting, spool)
        for key in sorted(keys):
            path = _part(spool, key)
            table = np.fromfile(path, record)
            path.unlink()
            columns = {name: table["columns"][name] for name in cloud.column_types}
            yield key, ArrayCloud(table["points"], table["intensity"] if cloud.has_intensity else None, columns)


def _spill(waiting: dict[tuple[int, int], list[NDArray[Any]]], spool: Path) -> set[tuple[int, int]]:
    """Append the buffered points to the files of their tiles, empty the buffer, and return its keys."""
    for key, parts in waiting.items():
        with ExitStack() as stack:
            stream = stack.enter_context(_part(spool, key).open("ab"))
            for part in parts:
                stream.write(part.data)
    keys = set(waiting)
    waiting.clear()
    return keys


def _part(spool: Path, key: tuple[int, int]) -> Path:
    """File for the buffered points of a tile."""
    return spool / f"{key[0]}_{key[1]}.points"


def check_tiles(folder: Path, size: float, overwrite: bool) -> None:
    """Make `folder`, before any work is done; tiles that are there are replaced later, if `overwrite` permits that.

    Raises UsageError for tiles that are not of 1 to 10000 m (`size`), OutputExistsError for a folder with content, OutputError
    for one of something else or that cannot be made.
    """
    if not 1.0 <= size <= 10_000.0:
        raise UsageError(f"--tiles {size:g} is out of range: 1 to 10000 m")
    if folder.exists() and any(folder.iterdir()):
        if not overwrite:
            raise OutputExistsError(f"{folder} exists; name another folder with --out or replace it with --overwrite")
        if not is_tiles(folder):
            raise OutputError(f"{folder} is something else than tiles: name another --out")
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)


def place_items(items: list[dict[str, Any]], projection: Projection) -> None:
    """Give STAC items their places on the Earth, all at once: PROJ takes longer to begin than for thousands of tiles."""
    georeference, corners = projection.georeference, []
    for item in items:
        x0, y0, z0, x1, y1, z1 = item["properties"]["proj:bbox"]
        corners += [[x, y, z] for z in (z0, z1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))]
    places = to_wgs84(np.array(corners), projection.epsg, georeference.height_epsg, georeference.geoid)
    for item, own in zip(items, places[:, [1, 0, 2]].reshape(-1, 10, 3), strict=True):
        item["geometry"] = {"type": "Polygon", "coordinates": [own[:5, :2].tolist()]}
        item["bbox"] = [*own.min(0).tolist(), *own.max(0).tolist()]


def vpc_item(name: str, tile: ArrayCloud, projection: Projection) -> dict[str, Any]:
    """STAC item of the file `name`, whose points are in the coordinates of the projection, m; `place_items` completes it."""
    low, high = tile.points.min(axis=0), tile.points.max(axis=0)
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
        "geometry": None,
        "bbox": None,
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
    """Description of a column for a STAC item."""
    return {"name": name, "size": kind.itemsize, "type": _KINDS[kind.kind]}


def read_prior_map(target: Path, config: RegistrationConfig) -> PriorMap:
    """Read the map `target` in the run's coordinates, or those of its file, minus whole kilometres where they are large.

    Raises InputError naming what is missing or damaged.
    """
    stored = map_of(target)
    points, origin = stored.read().points, np.zeros(3)
    if len(points) and float(np.abs(points).max()) > LARGE:
        origin = np.round(np.nanmedian(points, axis=0) / KILOMETRE) * KILOMETRE
        log.info(
            "coordinates of %s are large: the world of this run begins at %s of them", stored.path, origin.tolist()
        )
    return make_prior_map(points, config, stored.georeference, str(stored.path), origin, _up_of(stored.path.parent))


def _up_of(folder: Path) -> Floats:
    """(3,) up in the world of the run in a folder, by the mounting of its sensor; z by default."""
    try:
        return read_session(folder, folder.name)[1].up
    except (InputError, ConfigError):
        return Z
