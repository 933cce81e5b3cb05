"""Map in square tiles with an index, each a file; one tile is in memory at a time."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core import __version__
from lslam.core.errors import (
    InputError,
    InterruptedRunError,
    OutputError,
    OutputExistsError,
    UsageError,
    output_errors,
)
from lslam.core.types.cloud import ArrayCloud, Cloud
from lslam.core.types.gnss import Georeference, OutputCrs
from lslam.core.types.sequence import Sequence
from lslam.io.formats.copc_files import SUFFIX as COPC
from lslam.io.formats.point_files import read_cloud, write_cloud
from lslam.maps.georeference import ProjectedCloud, Projection
from lslam.pipeline.colour_pass import build_finished_map
from lslam.pipeline.map_files import MapNote, georeference_note, read_json, write_json
from lslam.pipeline.map_pass import INTERRUPTED
from lslam.pipeline.rebuild import EarlierRun, place_of, results_of
from lslam.pipeline.run_folder import SPOOL
from lslam.pipeline.tile_index import VPC, vpc_item, write_vpc

INDEX, SCHEMA = "map.json", 1
# Points that wait for their tiles' files, so that a map of any size needs little memory and few open files.
BUFFERED = 1 << 22


def rebuild_in_tiles(
    run: EarlierRun,
    sequence: Sequence,
    folder: Path,
    size: float,
    *,
    crs: OutputCrs | None = None,
    on_step: Callable[[], None] = lambda: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Build the map of a run again, in tiles of `size` m, in `folder`, checked by `check_tiles`. Returns the index.

    Raises as `rebuild` does.
    """
    georeference = place_of(run, crs)
    built = build_finished_map(sequence, results_of(run), run.config, on_step, should_stop, folder)
    if should_stop():
        raise InterruptedRunError(INTERRUPTED)
    note = MapNote.of(sequence.name, run.config.map, built, run.world)
    return write_tiles(folder, built.merged, note, size, run.config.map.format, georeference)


def write_tiles(
    folder: Path, cloud: Cloud, note: MapNote, size: float, suffix: str, georeference: Georeference | None = None
) -> dict[str, Any]:
    """Write the cloud as `folder`/tile_X_Y.<suffix> and the index map.json. Returns the index.

    Tiles in LAZ are COPC, `.copc.laz`; of a georeferenced run `tiles.vpc` makes them one layer of QGIS.

    Tile X, Y holds X * size <= x < (X + 1) * size, m, of the world, or of the coordinate reference system in LAS and LAZ of a
    georeferenced run. Raises OutputError, and UsageError for coordinates that no map can be written in.
    """
    projection = None if georeference is None else Projection(georeference)
    is_projected = projection is not None and suffix in ("las", "laz")
    if projection is not None and is_projected:
        projection.check()
        cloud = ProjectedCloud(cloud, projection.apply)
    tiles, items = [], []
    ending = COPC if suffix == "laz" else f".{suffix}"
    with tempfile.TemporaryDirectory(prefix=SPOOL, dir=folder, ignore_cleanup_errors=True) as stage:
        for key, tile in _sorted_into(cloud, size, Path(stage)):
            path = Path(stage) / f"tile_{key[0]}_{key[1]}{ending}"
            write_cloud(path, tile, wkt=projection.wkt if projection is not None and is_projected else "")
            low, high = tile.points.min(axis=0), tile.points.max(axis=0)
            if projection is not None and is_projected and ending == COPC:
                items.append(vpc_item(path.name, tile, projection))
            tiles.append({"file": path.name, "points": len(tile), "low": low.tolist(), "high": high.tolist()})
        _publish(Path(stage), folder, {tile["file"] for tile in tiles})
    crs = projection.name if projection is not None and is_projected else None
    index: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": "tiles",
        "tile_m": size,
        "unit": "m",
        "points": len(cloud),
        "tiles": tiles,
        "frame": note.world if projection is None or crs is None else projection.frame,
        "crs": crs,
        "georeference": None if georeference is None else georeference_note(georeference),
        "voxel": note.voxel,
        "done": list(note.done),
        **note.attributes_note,
        "sequence": note.sequence,
        "lslam": __version__,
    }
    if items:
        write_vpc(folder, items)
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
    """Points of each tile, tiles in order."""
    record = np.dtype(
        [("points", np.float64, (3,)), ("intensity", np.float32), ("columns", list(cloud.column_types.items()))]
    )
    waiting: dict[tuple[int, int], list[NDArray[Any]]] = {}
    held, keys = 0, set[tuple[int, int]]()
    with output_errors(f"the tiles in {spool.parent}"):
        for block in cloud.blocks():
            table = np.empty(len(block), record)
            table["points"], table["intensity"] = block.points, 0.0 if block.intensity is None else block.intensity
            for name, values in block.columns.items():
                table["columns"][name] = values
            cells = np.floor(block.points[:, :2] / size).astype(np.int64)
            found, of = np.unique(cells, axis=0, return_inverse=True)
            for n, (x, y) in enumerate(found.tolist()):
                waiting.setdefault((x, y), []).append(table[of.ravel() == n])
            held += len(block)
            if held > BUFFERED:
                keys |= _spill(waiting, spool)
                held = 0
        keys |= _spill(waiting, spool)
        for key in sorted(keys):
            path = _part(spool, key)
            table = np.fromfile(path, record)
            path.unlink()
            columns = {name: table["columns"][name] for name in cloud.column_types}
            yield key, ArrayCloud(table["points"], table["intensity"] if cloud.has_intensity else None, columns)


def _spill(waiting: dict[tuple[int, int], list[NDArray[Any]]], spool: Path) -> set[tuple[int, int]]:
    """Append the buffered points to the files of their tiles."""
    for key, parts in waiting.items():
        with ExitStack() as stack:
            stream = stack.enter_context(_part(spool, key).open("ab"))
            for part in parts:
                stream.write(part.data)
    keys = set(waiting)
    waiting.clear()
    return keys


def _part(spool: Path, key: tuple[int, int]) -> Path:
    return spool / f"{key[0]}_{key[1]}.points"


def is_tiles(folder: Path) -> bool:
    """Whether a folder holds tiles with their index."""
    return folder.is_dir() and read_json(folder / INDEX).get("kind") == "tiles"


def read_tiles(folder: Path) -> tuple[ArrayCloud, dict[str, Any]]:
    """All points of the tiles, m, as their files have them, and the index; raises InputError naming what is missing."""
    index = read_json(folder / INDEX)
    names = [str(tile.get("file", "")) for tile in index.get("tiles", []) if isinstance(tile, dict)]
    if not names or any(Path(name).name != name for name in names):
        raise InputError(f"{folder / INDEX} lists no tiles")
    parts = [read_cloud(folder / name) for name in names]
    return ArrayCloud(np.concatenate([part.points for part in parts])), index


def check_tiles(folder: Path, size: float, overwrite: bool) -> None:
    """Raise UsageError, OutputExistsError or OutputError for an impossible output of tiles, before any work is done."""
    if not 1.0 <= size <= 10_000.0:
        raise UsageError(f"--tiles {size:g} is out of range: 1 to 10000 m")
    if folder.exists() and any(folder.iterdir()):
        if not overwrite:
            raise OutputExistsError(f"{folder} exists; name another folder with --out or replace it with --overwrite")
        if not is_tiles(folder):
            raise OutputError(f"{folder} is something else than tiles: name another --out")
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
