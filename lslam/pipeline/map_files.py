"""Map files: the points, in map coordinates if georeferenced, and a note in JSON that describes them."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core import __version__
from lslam.core.config.outputs import MapConfig
from lslam.core.errors import output_errors
from lslam.core.types.cloud import ArrayCloud, Cloud, in_memory
from lslam.core.types.gnss import Georeference
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import atomic_write, write_text
from lslam.io.formats.geojson import write_line
from lslam.io.formats.ply_files import write_ply_mesh
from lslam.io.formats.point_files import MAP_SUFFIXES, write_cloud, write_ply
from lslam.maps.colour import ColourCounts
from lslam.maps.floor_plan import TopView, floor_plan
from lslam.maps.georeference import ProjectedCloud, Projection, to_lat_lon
from lslam.maps.mesh import surface
from lslam.maps.occupancy import OccupancyGrid
from lslam.reports.evaluations import strict
from lslam.reports.png import grey_png

Note = dict[str, Any]
SCHEMA = "lslam-map"
LOCAL = "world of trajectory.tum"


def read_json(path: Path) -> dict[str, Any]:
    """Content of a JSON file; empty when there is none that can be read."""
    try:
        tree = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, *MISFIT):
        return {}
    return tree if isinstance(tree, dict) else {}


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write strict JSON, indented, atomically; NaN and infinities become null. Raises OutputError."""
    write_text(path, json.dumps(strict(document), indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def note_of(path: Path) -> Note:
    """Content of the note beside a map about this map; empty when it has none."""
    return _notes(path).get(path.name, {})


def noted_last(path: Path) -> Path | None:
    """Map beside `path`, with its stem, that was written last according to the note; None when it lists none."""
    return next((path.with_name(name) for name in _notes(path)), None)


def is_note(path: Path) -> bool:
    """Whether `path` may be written as a note: it is a note, missing, or unreadable."""
    return bool(read_json(path).get("schema", SCHEMA) == SCHEMA)


def note_with(path: Path, about: Note) -> Note:
    """Note beside `path` that lists this map first, then the other existing maps of its stem."""
    return _join({path.name: about, **{name: note for name, note in _notes(path).items() if name != path.name}})


def drop_note(path: Path) -> None:
    """Remove the entry of map `path` from the note, so that none describes it while it is replaced. Raises OutputError."""
    notes, target = _notes(path), path.with_suffix(".json")
    if notes.pop(path.name, None) is None:
        return
    if notes:
        write_json(target, _join(notes))
        return
    with output_errors(target):
        target.unlink(missing_ok=True)


def _notes(path: Path) -> dict[str, Note]:
    """Notes by file name, the last written first, without missing files and names that no map has."""
    tree = read_json(path.with_suffix(".json"))
    others = tree.pop("others", None)
    entries = {str(tree.get("file")): tree, **(others if isinstance(others, dict) else {})}
    return {
        name: note
        for name, note in entries.items()
        if isinstance(note, dict) and _is_of(path, name) and path.with_name(name).is_file()
    }


def _is_of(path: Path, name: str) -> bool:
    """Whether `name` is that of a map with the stem of `path`."""
    other = Path(name)
    return other.name == name and other.stem == path.stem and other.suffix.lower() in MAP_SUFFIXES


def _join(notes: dict[str, Note]) -> Note:
    """The first note with all others under `others`."""
    first, *others = notes
    return notes[first] | ({"others": {name: notes[name] for name in others}} if others else {})


@dataclass(frozen=True)
class BuiltMap:
    """Result of building a map: the merged cloud, its top view, and a sample of its points for pages.

    Also the processing steps, in words, the occupancy if requested, the numbers of a coloured map, and the meaning of each
    attribute of its points.
    """

    cloud: Cloud
    view: TopView
    sample: ArrayCloud
    steps: tuple[str, ...] = ()
    occupancy: OccupancyGrid | None = None
    colour: ColourCounts | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class MapNote:
    """Facts that a map file cannot hold: source sequence, voxel edge, m, and processing steps.

    world : its coordinates in words, where they are those of the trajectory; attributes : meaning of each, by name
    """

    sequence: str
    voxel: float
    steps: tuple[str, ...] = ()
    world: str = LOCAL
    attributes: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, sequence: str, config: MapConfig, built: BuiltMap, world: str) -> MapNote:
        """Note for the map of a run, by its configuration, in its `world`."""
        return cls(sequence, config.voxel, built.steps, f"{LOCAL}: {world}", built.attributes)

    def facts(self, projection: Projection | None, georeference: Georeference | None) -> dict[str, Any]:
        """Facts for JSON; projection : to the coordinates of the file, None where they are those of the world."""
        return {
            "frame": self.world if projection is None else projection.frame,
            "crs": None if projection is None else projection.name,
            "georeference": None if georeference is None else georeference_note(georeference),
            "voxel": self.voxel,
            "done": list(self.steps),
            **({"attributes": dict(self.attributes)} if self.attributes else {}),
            "sequence": self.sequence,
            "lslam": __version__,
        }


def write_run_map(
    path: Path,
    built: BuiltMap,
    config: MapConfig,
    sequence: str,
    trajectory: Trajectory,
    world: str,
    georeference: Georeference | None,
) -> None:
    """Write the run's map, and as configured mesh, occupancy and trajectory as GeoJSON; raises as `write_map`."""
    note = MapNote.of(sequence, config, built, world)
    write_map(path, built.cloud, note, georeference)
    if config.mesh:
        write_mesh(path.with_name(f"{path.stem}_mesh.ply"), built.cloud, note, trajectory)
    if built.occupancy is not None:
        write_occupancy(path.parent, built.occupancy, note.world)
    if georeference is not None:
        write_geojson(path.parent / "trajectory.geojson", trajectory, georeference, sequence)


def projection_of(georeference: Georeference | None, suffix: str) -> Projection | None:
    """Projection to the coordinates of a file of a georeferenced map, None for one in the world of the run.

    LAS and LAZ are in its coordinate reference system; PLY and PCD hold float32, which is too coarse for that.
    Raises UsageError when the coordinate reference system is not one of metres.
    """
    if georeference is None or suffix.lower() not in (".las", ".laz"):
        return None
    projection = Projection(georeference)
    projection.check()
    return projection


def write_map(path: Path, cloud: Cloud, note: MapNote, georeference: Georeference | None = None) -> None:
    """Write the cloud, world frame, m, in the format of the suffix, and its note `<stem>.json` beside it.

    Coordinates are those of `projection_of`; the note has the transform. Raises as `write_cloud` and `projection_of`.
    """
    projection = projection_of(georeference, path.suffix)
    if projection is None:
        where = "not georeferenced" if georeference is None else "local"
        write_cloud(path, cloud, comment=f"lslam {__version__} map, {where}; {note.world}")
    else:
        write_cloud(path, ProjectedCloud(cloud, projection.apply), wkt=projection.wkt)
    about = {
        "schema": SCHEMA,
        "version": 1,
        "file": path.name,
        "points": len(cloud),
        "unit": "m",
        "intensity": cloud.has_intensity,
        **note.facts(projection, georeference),
    }
    write_json(path.with_suffix(".json"), note_with(path, about))


def write_geojson(path: Path, trajectory: Trajectory, georeference: Georeference, sequence: str) -> None:
    """Write the trajectory as a GeoJSON line, lon, lat (deg), height (m)."""
    about = {
        "sequence": sequence,
        "lslam": __version__,
        "stamp_first_ns": int(trajectory.stamps_ns[0]),
        "stamp_last_ns": int(trajectory.stamps_ns[-1]),
        "heights": "m above the WGS84 ellipsoid",
    }
    write_line(path, to_lat_lon(trajectory.positions, georeference), about)


def write_occupancy(folder: Path, grid: OccupancyGrid, world: str) -> None:
    """Write occupancy.npz and .ply, every observed cell, and floor_plan.png with floor_plan.yaml for ROS' map_server.

    The PLY holds the middles of the cells, m, with `log_odds` in hundredths: above 0 occupied, below free.
    """
    stream = io.BytesIO()
    np.savez_compressed(
        stream, cells=grid.cells, log_odds=grid.log_odds, voxel=np.float64(grid.voxel), frame=np.array(world)
    )
    with atomic_write(folder / "occupancy.npz") as target:
        target.write(stream.getbuffer())
    comment = f"lslam {__version__} occupancy, cells of {grid.voxel:g} m; {world}"
    write_ply(folder / "occupancy.ply", grid.centres, scalars={"log_odds": grid.log_odds}, comment=comment)
    plan = floor_plan(grid)
    with atomic_write(folder / "floor_plan.png") as target:
        target.write(grey_png(plan.image))
    with atomic_write(folder / "floor_plan.yaml") as target:
        target.write(plan.yaml("floor_plan.png").encode())


def write_mesh(path: Path, cloud: Cloud, note: MapNote, trajectory: Trajectory) -> None:
    """Write a surface through the map as PLY, world frame, m."""
    mesh = surface(in_memory(cloud), note.voxel, trajectory.positions)
    write_ply_mesh(path, mesh.vertices, mesh.triangles, f"lslam {__version__} map surface; {note.world}")


def georeference_note(georeference: Georeference) -> dict[str, Any]:
    """Georeference as plain values for JSON."""
    return {
        "origin_lat_lon_height": [float(v) for v in georeference.origin],
        "T_enu_world": georeference.T_enu_world.tolist(),
        "enu": "transverse Mercator at the origin, scale 1, WGS84: east, north, height above the origin, m",
        "epsg": Projection(georeference).epsg,
        "method": georeference.method,
        # The zero level of the heights, where it is neither the ellipsoid nor that of the coordinate reference system.
        **({"height_epsg": georeference.height_epsg} if georeference.height_epsg else {}),
        **({"geoid": georeference.geoid} if georeference.geoid else {}),
    }


def georeference_of(note: Any) -> Georeference | None:
    """Georeference from the values of `georeference_note` or a manifest; None when there is none."""
    try:
        origin = np.array(note["origin_lat_lon_height"], np.float64).reshape(3)
        T_enu_world = np.array(note["T_enu_world"], np.float64).reshape(4, 4)
        if not (np.isfinite(T_enu_world).all() and (np.abs(origin) <= [90, 180, 1e5]).all()):
            return None
        return Georeference(
            origin,
            T_enu_world,
            None if note.get("epsg") is None else int(note["epsg"]),
            note["method"],
            height_epsg=None if note.get("height_epsg") is None else int(note["height_epsg"]),
            geoid=str(note.get("geoid", "")),
        )
    except MISFIT:
        return None
