"""`lslam plot`: one figure of a run, for a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging, show


@click.command(
    epilog="\b\nExamples: lslam plot runs/first --what trajectory --out trajectory.pdf\n"
    "          lslam plot runs/first --what map --width page --out map.png\n"
    "          lslam plot runs/loam --what features --font 7 --out features.svg"
)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@options.option("--what", "NAME", "map, trajectory, errors, features, imu or buildings.", required=True)
@options.path("--out", "FILE", "A .png, .svg or .pdf.", required=True)
@options.option("--width", "WORD|MM", "column (89 mm), page (182 mm) or mm  [column].", default="column")
@options.real("--font", "PT", "Size of the text  [8].", default=8.0)
@options.truth
@options.new_sequence
@options.flag("--overwrite", "Replace an existing file.")
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
    from lslam.pipeline.plot_run import gather_figure, width_of, write_figure
    from lslam.pipeline.run_folder import require_new
    from lslam.reports.figures import require_figure
    from lslam.reports.picture import check_plot_path

    what = given["what"]
    require_figure(what)
    check_plot_path(out)
    width = width_of(given["width"])
    require_new(out, given["overwrite"])
    reading = options.reading_of(given)
    parts = gather_figure(run, what, given["sequence"], lambda recording: read_truth(given["gt"], recording), **reading)
    write_figure(parts, what, out, width, given["font"])
    show(f"{out}\n")
