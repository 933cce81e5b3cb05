"""`lslam plot`: one figure of a run, for a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging, show
from lslam.core.errors import OutputExistsError


@click.command(
    epilog="\b\nExamples: lslam plot runs/first --what trajectory --out trajectory.pdf\n"
    "          lslam plot runs/first --what map --width page --out map.png\n"
    "          lslam plot runs/loam --what features --font 7 --out features.svg"
)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--what", metavar="NAME", required=True, help="map, trajectory, errors, features, imu or buildings.")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", required=True, help="A .png, .svg or .pdf.")
@click.option("--width", default="column", metavar="WORD|MM", help="column (89 mm), page (182 mm) or mm  [column].")
@click.option("--font", type=float, default=8.0, metavar="PT", help="Size of the text  [8].")
@options.truth
@options.moved_sequence
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@options.reading
@options.verbosity
def command(run: Path, **given: Any) -> None:
    """Draw one figure of a run, as wide as a column or a page.

    The map by height, the trajectory from above and in space, errors in the axes of the LiDAR, features of a scan and their
    map, IMU and motion, or the map beneath the outlines of buildings.
    """
    setup_logging(given["verbose"], given["quiet"])
    out: Path = given["out"]
    options.require_there(given["gt"])
    from lslam.cli.one_run import read_truth
    from lslam.pipeline.plot_run import plotted_run, width_of, write_figure
    from lslam.reports.figures import require_figure
    from lslam.reports.picture import check_plot_path

    require_figure(given["what"])
    check_plot_path(out)
    width = width_of(given["width"])
    if out.exists() and not given["overwrite"]:
        raise OutputExistsError(f"{out} exists; name another file with --out or replace it with --overwrite")
    reading = options.reading_of(given)
    drawn = plotted_run(
        run, given["what"], given["sequence"], lambda opened: read_truth(given["gt"], opened), **reading
    )
    write_figure(drawn, given["what"], out, width, given["font"])
    show(f"{out}\n")
