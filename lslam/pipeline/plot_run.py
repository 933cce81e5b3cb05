"""Figures of a finished run for papers: what each needs is read from the run folder, and from the recording."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lslam.core.errors import InputError, UsageError
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry import create_odometry
from lslam.odometry.base import FeatureSource
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.pipeline.again import open_again
from lslam.pipeline.further_passes import view_features
from lslam.pipeline.job import choose_scans
from lslam.pipeline.rebuild import is_missing, read_run, results_of
from lslam.pipeline.stored_map import map_of
from lslam.reports.figures import ON_THE_MAP, WIDTHS, PlottedRun, draw_figure, require_figure
from lslam.reports.picture import check_plot_path, house_style, picture

log = logging.getLogger("lslam")


def gather_figure(
    folder: Path,
    what: str,
    sequence: Path | None = None,
    truth_of: Callable[[Sequence], Trajectory | None] = lambda sequence: None,
    **reading: Any,
) -> PlottedRun:
    """Read the parts of the run that the figure `what` needs.

    sequence : where the raw scans are if they have moved; truth_of : returns the truth to use instead of the recording's, or None
    reading : options of `open_sequence`

    Raises InputError naming what is missing, UsageError for an unknown figure.
    """
    require_figure(what)
    run = read_run(folder)
    about: dict[str, Any] = {"georeference": run.georeference}
    if what in ON_THE_MAP:
        about["cloud"] = view_run(folder).cloud
    if what == "trajectory" and (folder / "trajectory_odometry.tum").is_file():
        about["odometry"] = read_trajectory(folder / "trajectory_odometry.tum", "tum")
    if what == "buildings" and (folder / "buildings.geojson").is_file():
        about["buildings"] = read_buildings_geojson(folder / "buildings.geojson")
    if what not in ON_THE_MAP and not (what == "trajectory" and sequence is None and is_missing(run)):
        recording = open_again(run, sequence, **reading)
        truth = truth_of(recording) or recording.ground_truth
        if truth is not None and what in ("trajectory", "errors"):
            about["evaluation"] = evaluate(run.trajectory, truth, run.config.eval, calibration=recording.calibration)
        if what == "imu":
            about["imu"] = recording.imu
        if what == "features":
            odometry = create_odometry(run.config)
            if isinstance(odometry, FeatureSource):
                scans = choose_scans(recording, odometry, run.config)
                about["features"] = view_features(scans, odometry, results_of(run))
    return PlottedRun(f"{run.name} ({folder.name})", run.trajectory, **about)


def write_figure(run: PlottedRun, what: str, path: Path, width: float, font: float) -> None:
    """Draw a figure into `path`, .png, .svg or .pdf, atomically; width : mm; font : points.

    Raises UsageError for another suffix or an impossible size, OutputError when it cannot be written.
    """
    check_plot_path(path)
    if not 20 <= width <= 2000 or not 3 <= font <= 72:
        raise UsageError(f"--width {width:g} --font {font:g}: 20 to 2000 mm, 3 to 72 points")
    with house_style(font):
        image = picture(draw_figure(run, what, width), path.suffix.lstrip(".").lower(), dpi=300)
        with atomic_write(path) as stream:
            stream.write(image)


def width_of(text: str) -> float:
    """Width of a figure, mm, from `column`, `page` or a number. Raises UsageError."""
    if text in WIDTHS:
        return WIDTHS[text]
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--width {text}: column, page, or mm") from None


def view_run(folder: Path) -> PlottedRun:
    """Trajectory, odometry if there was a back end, and map, all in the run's world.

    Raises InputError naming what is missing or broken; a run without a map is shown without one.
    """
    run = read_run(folder)
    odometry = None
    if (folder / "trajectory_odometry.tum").is_file():
        odometry = read_trajectory(folder / "trajectory_odometry.tum", "tum")
    try:
        stored = map_of(folder)
    except InputError as error:
        log.warning("%s", error)
        stored = None
    cloud = None if stored is None else stored.read()
    return PlottedRun(f"{run.name} ({folder.name})", run.trajectory, odometry, cloud=cloud)
