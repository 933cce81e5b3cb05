"""Tiles of a run's map for its page: an octree in the cache, built while the page is looked at already."""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
import threading
from contextvars import copy_context
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lslam.core.errors import InputError, InterruptedRunError, LslamError, OutputError
from lslam.core.kernels.cache import cache_folder
from lslam.core.types.arrays import Floats
from lslam.core.types.cloud import thin_out
from lslam.core.untrusted import parse_json
from lslam.io.formats.point_files import MapCloud
from lslam.maps.georeference import Projection
from lslam.maps.octree import points_of, write_octree
from lslam.pipeline.map_files import georeference_of, note_of, read_json
from lslam.pipeline.map_tiles import INDEX, is_tiles
from lslam.pipeline.rebuild import map_of
from lslam.pipeline.resume import listing_digest
from lslam.reports.png import usual_range

log = logging.getLogger("lslam")
# Of the nodes and of their index; raise VERSION when either means something else. Octrees that are kept, the last used ones.
NODES, TREE, VERSION, KEPT = "nodes.bin", "tree.json", 1, 8
SAMPLE = 400_000  # points whose intensities give the range that is shown


class MapTiles:
    """The octree of a run's map. `start` finds or builds it in a thread, `stop` ends that.

    positions : (N, 3) m, of the trajectory; each point of a tile knows the nearest
    """

    def __init__(self, run: Path, positions: Floats) -> None:
        self._run, self._positions = run, positions
        self._tree: dict[str, Any] = {}
        self._folder = Path()
        self._said: dict[str, Any] = {"share": 0.0}
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=copy_context().run, args=(self._build,), name="lslam-tiles", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End the building, and leave nothing of it."""
        self._is_over.set()
        if self._thread.is_alive():
            self._thread.join()

    def tree(self, words: object = None) -> dict[str, Any]:
        """The index, its nodes with their numbers of points alone; `share` while it is built, `error` where it cannot be."""
        if not self._tree:
            return self._said
        return {**self._tree, "nodes": {name: count for name, (_, count) in self._tree["nodes"].items()}}

    def node(self, name: str) -> bytes | None:
        """A node as `write_octree` has it, and behind it the number of the nearest pose of each point, uint32."""
        begin, count = self._tree.get("nodes", {}).get(name, (0, 0))
        if not count:
            return None
        size = 6 + sum(self._tree["columns"].values())
        with (self._folder / NODES).open("rb") as stream:
            stream.seek(begin)
            data = stream.read(count * size)
        points = points_of(name, data[: 6 * count], self._tree)
        return data + self._nearest.query(points)[1].astype("<u4").tobytes()

    @cached_property
    def _nearest(self) -> cKDTree:
        return cKDTree(np.nan_to_num(self._positions, nan=1e12))

    def _build(self) -> None:
        try:
            cloud, digest = _map_of(self._run)
            base = cache_folder("octrees")
            if base is None:
                raise OutputError("tiles need a folder: name one of your own in XDG_CACHE_HOME")
            folder = base / digest
            if not (folder / TREE).is_file():
                self._write(folder, cloud)
            tree = parse_json((folder / TREE).read_text(encoding="utf-8"))
            os.utime(folder)
            _forget(base, folder)
            self._folder, self._tree = folder, tree
        except InterruptedRunError:
            return
        except (LslamError, OSError, ValueError) as error:
            log.warning("no tiles: %s", error)
            self._said = {"error": str(error)}

    def _write(self, folder: Path, cloud: MapCloud) -> None:
        sample = thin_out(cloud, SAMPLE).intensity
        shades = usual_range(np.zeros(0) if sample is None else sample.astype(np.float64))
        with tempfile.TemporaryDirectory(prefix="part-", dir=folder.parent) as place:
            with (Path(place) / NODES).open("wb") as stream:
                tree = write_octree(stream, Path(place), cloud, shades, self._on_share)
            (Path(place) / TREE).write_text(json.dumps(tree), encoding="utf-8")
            folder.mkdir(exist_ok=True)
            for name in (NODES, TREE):  # the index last: with it the octree is there
                os.replace(Path(place) / name, folder / name)

    def _on_share(self, share: float) -> None:
        if self._is_over.is_set():
            raise InterruptedRunError("interrupted while tiles were built")
        self._said = {"share": share}


def _map_of(run: Path) -> tuple[MapCloud, str]:
    """The map of a run, or its tiles, in its world, and a digest of the files. Raises InputError without one."""
    try:
        paths = [map_of(run)]
        note = note_of(paths[0])
    except InputError:
        folder = run / "tiles"
        if not is_tiles(folder):
            raise
        note = read_json(folder / INDEX)
        paths = [folder / Path(str(tile["file"])).name for tile in note["tiles"]]
    place = georeference_of(note.get("georeference"))
    cloud = MapCloud(paths) if note.get("crs") is None or place is None else MapCloud(paths, Projection(place).invert)
    return cloud, f"{VERSION}-{listing_digest(paths[0] if len(paths) == 1 else paths[0].parent)}"


def _forget(base: Path, used: Path) -> None:
    """Remove octrees that have not been used for longest, and what killed processes left."""
    found = sorted((path for path in base.iterdir() if path.is_dir()), key=lambda path: -path.stat().st_mtime)
    for path in [path for path in found if path != used][KEPT - 1 :]:
        shutil.rmtree(path, ignore_errors=True)
