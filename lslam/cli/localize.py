"""`lslam localize`: a run whose poses come from a map that exists."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli import run as main_job


@click.command(
    epilog="\b\nExamples: lslam localize tuesday --map runs/monday\n"
    "          lslam localize tuesday --map survey.laz --start 412.5,-80,95 --imu\n"
    "          lslam localize tuesday.bag --map runs/monday --gnss --method fast-lio2 --json"
)
@click.argument("sequence")
@options.path(
    "--map", "map_path", "MAP", "Run folder, folder of tiles, or a cloud: PLY, PCD, LAS or LAZ.", required=True
)
@options.option(
    "--start",
    "X,Y,HEADING",
    "Place of the first scan in the map, m, and heading, deg counter-clockwise from its x axis [default: searched].",
)
@options.flag("--gnss", "Search the start about the first satellite fix, in a georeferenced map.")
@options.method
@options.preset
@options.poses
@options.imu
@options.truth
@options.refine
@options.flag("--save-map", "Write a map of this drive too, in the frame of the old one.")
@options.option(
    "--out", "DIR|URL", "Run folder [default: runs/NAME-METHOD-in-map-TIME].", type=options.Place(path_type=Path)
)
@options.resume
@options.overwrite
@options.integer("--first", "N", "First scan used.")
@options.integer("--count", "N", "Number of scans used.")
@options.integer("--skip-frames", "N", "Use every N-th scan.")
@options.threads
@options.flag("--strict", "Exit 4 when anything was degraded: a scan that the map does not hold.")
@options.dry_run
@options.reading
@options.data_root
@options.configuration
@options.as_json
@options.verbosity
def command(sequence: str, map_path: Path, **given: Any) -> None:
    """Locate a drive in a map that exists: trajectory.tum is in the map's frame.

    Any odometry method carries the poses from scan to scan, and each scan is registered on the map, which never changes.
    Where the map has changed or ends, odometry carries on; localization.csv says where. Exit 1 when the drive is not found
    in the map.
    """
    options.require_there(map_path)
    flags = {
        "localize.map": options.file_setting(map_path),
        "loops.use": "false",
        "localize.start": None if given["start"] is None else json.dumps(_start_of(given["start"])),
        "map.write": None if given["save_map"] else "false",
    }
    about = {"start": given["first"], "gnss": "fit" if given["gnss"] else None}
    about["settings"] = tuple(options.settings_of(flags, given["settings"]))
    click.get_current_context().invoke(main_job.command, sequence=sequence, **{**given, **about})


def _start_of(text: str) -> list[float]:
    """Values of --start: x, y, m, and heading, deg; raises click.UsageError for others."""
    if text.isdecimal():
        raise click.UsageError(
            f"--start {text}: a place in the map, X,Y,HEADING; to begin at that scan say --first {text}"
        )
    return options.numbers("--start", text, (3,), "X,Y,HEADING, for example 412.5,-80,95")
