"""`lslam deliver`: what a surveyor hands over of a run."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import progress, setup_logging, show

EPILOG = """\b
Examples:
  lslam deliver runs/town --out handover
  lslam deliver runs/town --crs EPSG:25832+7837 --out handover
  lslam deliver runs/town --crs EPSG:25832 --geoid geoid.gtx --check points.csv --out handover
"""


@click.command(epilog=EPILOG)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), metavar="FOLDER", required=True, help="Folder to write.")
@click.option("--crs", metavar="EPSG:N[+M]", help="Coordinates, +M of heights  [as the run].")
@click.option("--geoid", metavar="GRID", help="Heights above this geoid (.gtx, .tif)  [as the run].")
@click.option(
    "--check",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="CSV of surveyed points that the run did not use, as --control has them.",
)
@click.option("--anyway", is_flag=True, help="Deliver a run that diverged or was interrupted, too, and say so in it.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier delivery.")
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
    words = shlex.join(["lslam", *sys.argv[1:]])
    with progress("deliver", STEPS, "parts") as advance:
        made = deliver(survey, given["out"], overwrite=given["overwrite"], command=words, on_step=advance)
    if given["as_json"]:
        document = {
            "folder": str(made.folder),
            "frame": survey.frame.frame,
            "crs": None if survey.frame.epsg is None else survey.frame.name,
            "status": survey.status,
            "files": dict(made.files),
            "points": {p.kind: {"count": len(p.names), "rms_m": p.rms, "largest_m": p.worst} for p in survey.points},
            "accuracy": made.accuracy,
            "notes": made.notes,
        }
        show(json.dumps(document) + "\n")
        return
    rows = [("delivered", str(made.folder)), ("coordinates", survey.frame.frame), ("status", survey.status)]
    rows += [*made.files.items(), *(("accuracy" if k == 0 else "", said) for k, said in enumerate(made.accuracy))]
    rows += [("note", said) for said in made.notes]
    show("".join(f"{name:<14} {text}\n" for name, text in rows))
