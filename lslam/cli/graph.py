"""`lslam graph`: the pose graph of a run again, without its odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging
from lslam.core.errors import UsageError


@click.command(
    epilog="\b\nExamples: lslam graph runs/first --loops edits.csv\n"
    "          lslam graph runs/first --control points.csv --out runs/surveyed\n"
    "          lslam graph runs/first --loops edits.csv --only-known --out runs/known --json"
)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--loops",
    "loops_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="CSV of pairs of scans that are loops, or must not be: scan_a,scan_b,verdict (known, forbidden); loops.csv of the "
    "run with these words in it will do.",
)
@click.option("--only-known", is_flag=True, help="Close the known pairs alone, search no others.")
@click.option(
    "--control",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="CSV of control points, surveyed positions that hold the poses: scan,x,y,z,sigma,crs.",
)
@options.refine
@options.fixes_as_factors
@options.fixes_at_the_end
@options.coordinates
@options.truth
@options.moved_sequence
@click.option("--no-map", is_flag=True, help="Only trajectory and report.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Run folder [default: RUN-graph].")
@click.option("--resume", is_flag=True, help="Go on where it was killed or interrupted.")
@options.replaced
@options.reading
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="Set one configuration key of what follows odometry; repeatable.",
)
@options.as_json
@options.verbosity
def command(run: Path, **given: Any) -> None:
    """Optimise the pose graph of a run again, without odometry, into a run folder of its own.

    Known pairs and control points hold the poses: nothing rejects them, and what they contradict is said.
    """
    setup_logging(given["verbose"], given["quiet"])
    if given["overwrite"] and given["resume"]:
        raise UsageError("--overwrite does everything anew and --resume keeps finished parts: give one of them")
    options.require_there(given["loops_file"], given["control"], given["gt"])
    from lslam.cli.one_run import arguments_of, read_truth
    from lslam.pipeline.resume import open_again, read_for_graph, reading_of, require_another
    from lslam.pipeline.run import run as make_run
    from lslam.pipeline.run_folder import check_target

    named = run if run.name not in ("", "..") else run.resolve()
    out = given["out"] or named.with_name(f"{named.name}-graph")
    require_another(run, out)
    if not given["resume"]:
        check_target(out, given["overwrite"])
    known = read_for_graph(run, _settings(given))
    opened = open_again(known, given["sequence"], **options.reading_of(given))
    truth = read_truth(given["gt"], opened)
    reading = reading_of(known, given["sequence"], **options.reading_of(given))
    with arguments_of(out, given) as arguments:
        make_run(opened, known.config, earlier=known, reading=reading, ground_truth=truth, **arguments)


def _settings(given: dict[str, Any]) -> list[str]:
    """Flags over --set, as settings."""
    flags = options.manual_settings(given["loops_file"], given["control"])
    flags |= {
        "loops.use": "false" if given["only_known"] else None,
        "gnss.mode": given["gnss"],
        "graph.refine": "true" if given["refine"] else None,
        **options.crs_settings(given["crs"], given["geoid"]),
        "map.write": "false" if given["no_map"] else None,
    }
    return [*given["settings"], *(f"{key}={value}" for key, value in flags.items() if value is not None)]
