"""A map on disk, whichever way it was written: one file, or tiles with their index; read whole or block by block."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.gnss import Georeference
from lslam.io.formats.point_files import MAP_SUFFIXES, SUFFIXES, MapCloud, read_cloud
from lslam.maps.georeference import LocalFrame, Projection
from lslam.pipeline.map_files import Note, georeference_note, georeference_of, note_of, noted_last, read_json
from lslam.pipeline.run_folder import require_run

INDEX = "map.json"  # of tiles
TILES = "tiles"  # folder of them in a run folder


@dataclass(frozen=True)
class StoredMap:
    """The map in `path`, a file or a folder of tiles: the files of its points, and its note, empty if lslam did not write it."""

    path: Path
    files: tuple[Path, ...]
    note: Note

    @property
    def georeference(self) -> Georeference | None:
        """Where the world of its run lies on the Earth; None where nobody knows."""
        return georeference_of(self.note.get("georeference"))

    @property
    def voxel(self) -> float:
        """Edge of its voxels, m; 0 for a map of every point."""
        return float(self.note.get("voxel") or 0.0)

    def to_world(self, points: Floats) -> Floats:
        """Points (N, 3), m, of the files in the world of the run; those of another program stay in their own coordinates."""
        place = self.georeference
        return points if place is None or self.note.get("crs") is None else Projection(place).invert(points)

    def read(self, in_world: bool = True) -> ArrayCloud:
        """Points and intensities, in the run's world or as in the files. Raises InputError naming a damaged file."""
        parts = [read_cloud(path) for path in self.files]
        values = [part.intensity for part in parts if part.intensity is not None]
        intensity = np.concatenate(values) if len(values) == len(parts) else None
        points = np.concatenate([part.points for part in parts])
        return ArrayCloud(self.to_world(points) if in_world else points, intensity)

    def cloud(self, attributes: Collection[str], frame: Projection | LocalFrame | None = None) -> MapCloud:
        """The points with their colours and these attributes, block by block, in the world of the run or coordinates of it."""
        if frame is None:
            return MapCloud(self.files, attributes, self.to_world)
        own = self.note.get("georeference") if self.note.get("crs") is not None else None
        if isinstance(frame, Projection) and georeference_note(frame.georeference) == own:
            return MapCloud(self.files, attributes, lambda points: points)  # PROJ there and back takes as long as LAZ
        return MapCloud(self.files, attributes, lambda points: frame.apply(self.to_world(points)))


def map_of(target: Path) -> StoredMap:
    """The map of a run, the file that was written last or else its tiles; or that of a file, or a folder of tiles.

    Raises InputError when there is none; points are not read.
    """
    path = target
    if target.is_dir() and not is_tiles(target):
        require_run(target)
        maps = [target / f"map{suffix}" for suffix in MAP_SUFFIXES if (target / f"map{suffix}").is_file()]
        if not maps and not is_tiles(target / TILES):
            raise InputError(f"{target} has no map file; build one with: lslam map {target}")
        path = noted_last(maps[0]) or maps[0] if maps else target / TILES
    elif not target.exists():
        raise InputError(f"the map {target} does not exist")
    if not is_tiles(path):
        if path.suffix.lower() not in (*MAP_SUFFIXES, *SUFFIXES):
            raise InputError(
                f"the map {path} is no run folder and no cloud: known suffixes are {', '.join(MAP_SUFFIXES)}"
            )
        return StoredMap(path, (path,), note_of(path))
    index = read_json(path / INDEX)
    names = [str(tile.get("file", "")) for tile in index.get("tiles", []) if isinstance(tile, dict)]
    if not names or any(Path(name).name != name for name in names):
        raise InputError(f"{path / INDEX} lists no tiles")
    return StoredMap(path, tuple(path / name for name in names), index)


def is_tiles(folder: Path) -> bool:
    """Whether a folder holds tiles with their index."""
    return folder.is_dir() and read_json(folder / INDEX).get("kind") == "tiles"
