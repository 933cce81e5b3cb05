"""`lslam map RUN --against RUN --changes DIR`: what appeared and what vanished between two drives."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.cli import options
from lslam.cli.console import progress, show
from lslam.errors import UsageError
from lslam.stopping import heeded

if TYPE_CHECKING:
    from lslam.maps.changes import ChangedCells

# What a map is made with, and how clouds are scored: no part of a comparison of drives.
_OTHERS = (
    "file_format", "crop", "clean", "occupancy", "denoise", "mesh", "crs", "geoid", "out", "is_scored", "threshold", "radius",
)  # fmt: skip
_FLAGS = {"file_format": "format", "is_scored": "score"}
# Rows of the table, at most; the files have all.
_MOST = 20


def compare_drives(target: Path, given: dict[str, Any]) -> None:
    """Compare the drives and write what changed."""
    folder, against = given["changes"], given["against"]
    if against is None:
        raise UsageError("--changes needs the run to compare with: --against RUN")
    for name in _OTHERS:
        if given[name]:
            raise UsageError(f"--{_FLAGS.get(name, name)} has no meaning with --changes: leave one out")
    options.require_there(target, against)
    from lslam.pipeline.change_pass import compare_runs, frame_between, output_folder, write_changes
    from lslam.pipeline.rebuild import open_scans, read_run

    settings = of_the_map(given["settings"])
    if given["voxel"] is not None:
        settings.append(f"map.occupancy_voxel={given['voxel']}")
    new, old = read_run(target, settings), read_run(against)
    T = frame_between(new, old)
    scans = open_scans(new, given["sequence"], **options.reading_of(given))
    earlier = open_scans(old, given["against_sequence"], flag="--against-sequence")
    steps = len(old.trajectory) + len(new.trajectory)
    with output_folder(folder, given["overwrite"]), heeded() as stop, progress("changes", steps) as advance:
        stop.is_gentle = True
        found = compare_runs((new, scans), (old, earlier), T, spool=folder, on_step=advance, should_stop=stop)
        write_changes(folder, found, new, old)
    _print(folder, found, given["as_json"])


def of_the_map(settings: Iterable[str]) -> list[str]:
    """The settings of --set; raises UsageError for one that is none of the map."""
    for setting in settings:
        if not setting.startswith("map."):
            raise UsageError(f"--set {setting}: only keys of the map can be changed after the run")
    return list(settings)


def _print(folder: Path, found: ChangedCells, as_json: bool) -> None:
    from lslam.pipeline.change_pass import AREAS, CLOUD, properties

    things = [properties(number, change) for number, change in enumerate(found.changes, 1)]
    cells = {
        "same": len(found.same), "occupied_new": found.occupied_new, "occupied_old": found.occupied_old,
        "unseen_new": found.unseen_new, "unseen_old": found.unseen_old,
    }  # fmt: skip
    if as_json:
        document = {
            "cloud": str(folder / CLOUD), "areas": str(folder / AREAS), "voxel_m": found.voxel, "cells": cells,
            "appeared": len(found.of("appeared")), "vanished": len(found.of("vanished")), "things": things,
        }  # fmt: skip
        show(json.dumps(document, allow_nan=False) + "\n")
        return
    rows = [
        ("changes", f"{folder / CLOUD}, {folder / AREAS}: cells of {found.voxel:g} m"),
        ("appeared", f"{len(found.of('appeared'))} things"),
        ("vanished", f"{len(found.of('vanished'))} things"),
        ("same", f"{len(found.same)} of {found.occupied_new} occupied cells"),
        ("unseen", f"{found.unseen_new} cells now, {found.unseen_old} before, that the other drive never saw"),
    ]
    lines = [f"{name:<10} {value}\n" for name, value in rows]
    if things:
        lines.append(
            f"\n{'':5} {'kind':<10}{'x':>9} {'y':>9} {'length':>7} {'width':>6} {'height':>6} {'cells':>7}  m\n"
        )
    for thing in things[:_MOST]:
        lines.append(
            f"{thing['thing']:>5} {thing['kind']:<10}{thing['x_m']:>9.1f} {thing['y_m']:>9.1f} {thing['length_m']:>7.1f} "
            f"{thing['width_m']:>6.1f} {thing['height_m']:>6.1f} {thing['cells']:>7}\n"
        )
    if len(things) > _MOST:
        lines.append(f"      and {len(things) - _MOST} more in {folder / AREAS}\n")
    show("".join(lines))
