"""Changes between two runs through one place, from the raw scans and final poses of both."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from lslam.core import __version__
from lslam.core.arrays import Floats
from lslam.core.errors import OutputExistsError, UsageError, output_errors
from lslam.core.geometry import se3
from lslam.core.geometry.geodesy import frame_change
from lslam.core.stopping import asking
from lslam.core.types.gnss import Georeference
from lslam.core.types.sequence import Sequence
from lslam.io.formats.geojson import write_areas
from lslam.io.formats.point_files import write_ply
from lslam.maps.changes import ChangedCells, MapChange, changed_cells
from lslam.maps.clean import Cleaner, PosedScan
from lslam.maps.georeference import to_lat_lon
from lslam.maps.occupancy import Evidence, OccupancyMapper
from lslam.pipeline.map_files import read_json
from lslam.pipeline.map_pass import posed_scans
from lslam.pipeline.rebuild import EarlierRun, results_of
from lslam.pipeline.run_folder import MANIFEST
from lslam.pipeline.watch import SILENT, Watch
from lslam.registration.preprocessing.ground import world_up_of

log = logging.getLogger("lslam")

CLOUD, AREAS = "changes.ply", "changes.geojson"
INTERRUPTION = "interrupted while the drives were compared: nothing is written"
# Red, green, blue of what vanished, is the same, and appeared; the scalar `change` is -1, 0 and 1.
_COLOURS = np.array([[214, 69, 65], [150, 150, 150], [46, 134, 193]], np.uint8)


def frame_between(new: EarlierRun, old: EarlierRun) -> Floats:
    """(4, 4) T_old_new from the world of the new run to that of the old one, m.

    Their worlds are one when one was located in the map of the other, or both in the same map; else their georeferences
    lead from one to the other. Raises UsageError when neither does.
    """
    if _frame_of(new) == _frame_of(old):
        return np.eye(4)
    if new.georeference is None or old.georeference is None:
        raise UsageError(
            f"{new.folder} and {old.folder} lie in frames of their own: locate the new drive in the map of the old one with "
            f"lslam localize {new.sequence_path} --map {old.folder}"
        )
    log.warning(
        "only their places on the Earth tie %s to %s: where these are off by more than a cell all walls seem changed; lslam "
        "localize ties drives by their scans",
        new.folder,
        old.folder,
    )
    T_old_new = frame_change(new.georeference.origin, old.georeference.origin)
    return np.asarray(se3.inverse(old.georeference.T_enu_world) @ T_old_new @ new.georeference.T_enu_world)


def _frame_of(run: EarlierRun) -> Path:
    """Run folder, or map file of another program, whose coordinate frame the run uses."""
    here, manifest, passed = run.folder.resolve(), run.manifest, set[Path]()
    while here not in passed:
        passed.add(here)
        about = manifest.get("localization")
        if not isinstance(about, dict) or not about.get("map"):
            break
        here = Path(str(about["map"])).resolve()
        if here.is_file() and (here.parent / MANIFEST).is_file():
            here = here.parent
        manifest = read_json(here / MANIFEST)
    return here


def compare_runs(
    new: tuple[EarlierRun, Sequence],
    old: tuple[EarlierRun, Sequence],
    T_old_new: Floats,
    *,
    spool: Path | None = None,
    watch: Watch = SILENT,
) -> ChangedCells:
    """Changes between both runs, in the world of the old one.

    Moving objects are removed from each drive separately. Cells and their range are those of the new run's configuration.
    Data too large for memory are kept in a temporary folder in `spool`. Raises InterruptedRunError when `watch` says so.
    """
    section = new[0].config.map
    origin = np.floor(old[0].trajectory.positions[0] / section.occupancy_voxel).astype(np.int64)

    def cast(run: EarlierRun, sequence: Sequence, T: Floats) -> Evidence:
        voxel, near, far = section.occupancy_voxel, run.config.map.range_min, section.occupancy_range
        up = world_up_of(run.config.preprocess, run.trajectory.poses[0])
        mapper, cleaner = OccupancyMapper(voxel, near, far, spool=spool, origin=origin), Cleaner(up)

        def enter(scans: list[PosedScan]) -> None:
            for scan in scans:
                mapper.add(scan.points, T @ scan.T_world_lidar)

        for _, scan in posed_scans(sequence, results_of(run), run.config, watch, INTERRUPTION):
            if scan is not None:
                enter(cleaner.add(scan))
        enter(cleaner.finish())
        return mapper.evidence()

    with asking(watch.should_stop, INTERRUPTION):
        before = cast(*old, np.eye(4))
        return changed_cells(cast(*new, T_old_new), before)


@contextmanager
def output_folder(folder: Path, overwrite: bool) -> Iterator[None]:
    """Make `folder` before any work is done; remove it again when the block fails.

    Raises OutputExistsError for a folder that may not be replaced, OutputError for a folder that cannot be made.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputExistsError(f"{folder} is no folder; name another one with --changes")
    for name in (CLOUD, AREAS):
        if (folder / name).exists() and not overwrite:
            raise OutputExistsError(
                f"{folder / name} exists; name another folder with --changes or replace it with --overwrite"
            )
    is_new = not folder.exists()
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        if is_new:
            with suppress(OSError):
                folder.rmdir()
        raise


def write_changes(folder: Path, result: ChangedCells, new: EarlierRun, old: EarlierRun) -> None:
    """Write changes.ply, changed and unchanged cells, and changes.geojson, an outline of each object.

    The cloud, m, is in the world of the old run; outlines are in longitude and latitude when it is georeferenced, else in
    metres of that world, as the file notes. Raises OutputError.
    """
    kinds = [np.full(len(c.cells), 1 if c.kind == "appeared" else -1) for c in result.changes]
    change = np.concatenate([*kinds, np.zeros(len(result.same), np.int64)])
    thing = np.repeat(np.arange(len(kinds) + 1), [*(len(k) for k in kinds), len(result.same)])
    cells = np.concatenate([*(c.cells for c in result.changes), result.same])
    write_ply(
        folder / CLOUD,
        (cells + 0.5) * result.voxel,
        colours=_COLOURS[change + 1],
        scalars={"change": change, "thing": np.where(change == 0, 0, thing + 1)},
        comment=f"lslam {__version__} changes from {old.folder} to {new.folder}, cells of {result.voxel:g} m; {old.world}",
    )
    place = old.georeference
    about = {"old": str(old.folder), "new": str(new.folder), "voxel_m": result.voxel, "lslam": __version__}
    if place is None:
        about["frame"] = f"m in the world of {old.folder}: {old.world}"
    areas = [_outline(change, place) for change in result.changes]
    write_areas(folder / AREAS, areas, [properties(k, c) for k, c in enumerate(result.changes, 1)], about)


def _outline(change: MapChange, place: Georeference | None) -> Floats:
    """Outline (C, 2) for GeoJSON: longitude and latitude, deg, or x and y, m."""
    if place is None:
        return change.outline
    corners = np.column_stack([change.outline, np.full(len(change.outline), change.base)])
    return np.asarray(to_lat_lon(corners, place)[:, 1::-1])


def properties(number: int, change: MapChange) -> dict[str, str | int | float]:
    """Properties of a changed object for GeoJSON; `thing` is its number in the cloud, `base_m` in the world of the old run."""
    x, y, _ = change.centres.mean(axis=0)
    length, width = change.extent
    measures = {
        "x_m": x,
        "y_m": y,
        "base_m": change.base,
        "height_m": change.height,
        "length_m": length,
        "width_m": width,
        "volume_m3": change.volume,
    }
    values = {name: round(float(value), 3) for name, value in measures.items()}
    return {"thing": number, "kind": change.kind, "cells": len(change.cells), **values}
