"""`lslam graph`: the pose graph of a run again, without its odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging


@click.command(
    epilog="\b\nExamples: lslam graph runs/first --loops edits.csv\n"
    "          lslam graph runs/first --control points.csv --out runs/surveyed\n"
    "          lslam graph runs/first --loops edits.csv --only-known --out runs/known --json"
)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@options.path(
    "--loops",
    "loops_file",
    "FILE",
    "CSV of pairs of scans that are loops, or must not be: scan_a,scan_b,verdict (known, forbidden); loops.csv of the run "
    "with these words in it will do.",
)
@options.flag("--only-known", "Close the known pairs alone, search no others.")
@options.path(
    "--control", "FILE", "CSV of control points, surveyed positions that hold the poses: scan,x,y,z,sigma,crs."
)
@options.refine
@options.fixes_as_factors
@options.fixes_at_the_end
@options.coordinates
@options.truth
@options.new_sequence
@options.flag("--no-map", "Only trajectory and report.")
@options.path("--out", "DIR", "Run folder [default: RUN-graph].")
@options.flag("--resume", "Go on where it was killed or interrupted.")
@options.overwrite
@options.reading
@options.settings("SECTION.KEY=VALUE", "Set one configuration key of what follows odometry; repeatable.")
@options.as_json
@options.verbosity
def command(run: Path, **given: Any) -> None:
    """Optimise the pose graph of a run again, without odometry, into a run folder of its own.

    Known pairs and control points hold the poses: nothing rejects them, and what they contradict is said.
    """
    setup_logging(given["verbose"], given["quiet"])
    options.check_resume(given)
    options.require_there(given["loops_file"], given["control"], given["gt"])
    from lslam.cli.one_run import arguments_of, read_truth
    from lslam.pipeline.again import open_again, read_for_graph, reading_of, require_another
    from lslam.pipeline.run import run as make_run
    from lslam.pipeline.run_folder import check_target

    whole = run if run.name not in ("", "..") else run.resolve()
    out = given["out"] or whole.with_name(f"{whole.name}-graph")
    require_another(run, out)
    if not given["resume"]:
        check_target(out, given["overwrite"])
    flags = {
        "loops.file": options.file_setting(given["loops_file"]),
        "graph.control": options.file_setting(given["control"]),
        "loops.use": "false" if given["only_known"] else None,
        "gnss.mode": given["gnss"],
        "graph.refine": options.true_if(given["refine"]),
        **options.crs_settings(given),
        "map.write": "false" if given["no_map"] else None,
    }
    earlier = read_for_graph(run, options.settings_of(flags, given["settings"]))
    new_reading = options.reading_of(given)
    recording = open_again(earlier, given["sequence"], **new_reading)
    truth = read_truth(given["gt"], recording)
    reading = reading_of(earlier, given["sequence"], **new_reading)
    with arguments_of(out, given) as arguments:
        make_run(recording, earlier.config, earlier=earlier, reading=reading, ground_truth=truth, **arguments)
