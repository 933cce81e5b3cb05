"""`lslam deliver`: what a surveyor hands over of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import progress, setup_logging, show_json, show_rows

EPILOG = """\b
Examples:
  lslam deliver runs/town --out handover
  lslam deliver runs/town --crs EPSG:25832+7837 --out handover
  lslam deliver runs/town --crs EPSG:25832 --geoid geoid.gtx --check points.csv --out handover
"""


@click.command(epilog=EPILOG)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@options.path("--out", "FOLDER", "Folder to write.", required=True)
@options.option("--crs", "EPSG:N[+M]", "Coordinates, +M of heights  [as the run].")
@options.option("--geoid", "GRID", "Heights above this geoid (.gtx, .tif)  [as the run].")
@options.path("--check", "FILE", "CSV of surveyed points that the run did not use, as --control has them.")
@options.flag("--anyway", "Deliver a run that diverged or was interrupted, too, and say so in it.")
@options.flag("--overwrite", "Replace an earlier delivery.")
@options.as_json
@options.verbosity
def command(run: Path, **given: Any) -> None:
    """Make a folder to hand over: map in LAZ, trajectory as a table, GeoPackage, plans, a page to sign, and a README.

    Coordinates are those of the run, or of --crs; of a run that is not georeferenced its own. The page says what was measured of
    the accuracy: points of --check are surveyed ones that the run did not use. RUN may be the folder of a merge.
    """
    setup_logging(given["verbose"], given["quiet"])
    options.require_there(run, given["check"])
    crs = options.output_crs(given)
    from lslam.pipeline.deliver.deliver_run import STEPS, check_delivery, deliver
    from lslam.pipeline.deliver.survey import read_survey

    check_delivery(run, given["out"], given["overwrite"])
    survey = read_survey(run, crs, given["check"], given["anyway"])
    with progress("deliver", STEPS, "parts") as advance:
        command = options.command_line()
        delivery = deliver(survey, given["out"], overwrite=given["overwrite"], command=command, on_step=advance)
    if given["as_json"]:
        document = {
            "folder": str(delivery.folder),
            "frame": survey.frame.frame,
            "crs": None if survey.frame.epsg is None else survey.frame.name,
            "status": survey.status,
            "files": dict(delivery.files),
            "points": {p.kind: {"count": len(p.names), "rms_m": p.rms, "largest_m": p.worst} for p in survey.points},
            "accuracy": delivery.accuracy,
            "notes": delivery.notes,
        }
        show_json(document)
        return
    rows = [("delivered", str(delivery.folder)), ("coordinates", survey.frame.frame), ("status", survey.status)]
    rows += [*delivery.files.items(), *(("" if k else "accuracy", text) for k, text in enumerate(delivery.accuracy))]
    show_rows([*rows, *(("note", text) for text in delivery.notes)], 14)
