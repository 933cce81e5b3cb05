"""Data for the figures of a run, from its folder and, if needed, from its recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lslam.core.errors import UsageError
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry import create_odometry
from lslam.odometry.base import FeatureSource
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.pipeline.feature_map_pass import view_features
from lslam.pipeline.job import choose_scans
from lslam.pipeline.rebuild import is_gone, read_run, results_of, viewed_run
from lslam.pipeline.resume import open_again
from lslam.reports.figures import ON_THE_MAP, WIDTHS, PlottedRun, draw_figure, require_figure
from lslam.reports.picture import check_plot_path, house_style, picture


def plotted_run(
    folder: Path,
    what: str,
    sequence: Path | None = None,
    truth_of: Callable[[Sequence], Trajectory | None] = lambda sequence: None,
    **reading: Any,
) -> PlottedRun:
    """Parts of the run that the figure `what` needs.

    sequence : where the raw scans have moved; truth_of : gives what replaces the recording's truth, None for nothing
    reading : as `open_sequence`

    Raises InputError naming what is missing, UsageError for an unknown figure.
    """
    require_figure(what)
    run = read_run(folder)
    about: dict[str, Any] = {"georeference": run.georeference}
    if what in ON_THE_MAP:
        about["cloud"] = viewed_run(folder).cloud
    if what == "trajectory" and (folder / "trajectory_odometry.tum").is_file():
        about["odometry"] = read_trajectory(folder / "trajectory_odometry.tum", "tum")
    if what == "buildings" and (folder / "buildings.geojson").is_file():
        about["buildings"] = read_buildings_geojson(folder / "buildings.geojson")
    if what not in ON_THE_MAP and not (what == "trajectory" and sequence is None and is_gone(run)):
        opened = open_again(run, sequence, **reading)
        given = truth_of(opened) or opened.ground_truth
        if given is not None and what in ("trajectory", "errors"):
            about["evaluation"] = evaluate(run.trajectory, given, run.config.eval, calibration=opened.calibration)
        if what == "imu":
            about["imu"] = opened.imu
        if what == "features":
            odometry = create_odometry(run.config)
            if isinstance(odometry, FeatureSource):
                chosen = choose_scans(opened, odometry, run.config)
                about["features"] = view_features(chosen, odometry, results_of(run))
    name = str(run.manifest.get("sequence", {}).get("name", folder.name))
    return PlottedRun(f"{name} ({folder.name})", run.trajectory, **about)


def write_figure(run: PlottedRun, what: str, path: Path, width: float, font: float) -> None:
    """Draw a figure into `path`, .png, .svg or .pdf, atomically; width : mm; font : points.

    Raises UsageError for another suffix or a size that no page has, OutputError when it cannot be written.
    """
    check_plot_path(path)
    if not 20 <= width <= 2000 or not 3 <= font <= 72:
        raise UsageError(f"--width {width:g} --font {font:g}: 20 to 2000 mm, 3 to 72 points")
    with house_style(font):
        drawn = picture(draw_figure(run, what, width), path.suffix.lstrip(".").lower(), dpi=300)
        with atomic_write(path) as stream:
            stream.write(drawn)


def width_of(text: str) -> float:
    """Width of a figure, mm, from `column`, `page` or a number. Raises UsageError."""
    if text in WIDTHS:
        return WIDTHS[text]
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--width {text}: column, page, or mm") from None
