"""`lslam view`: a run as a recording for the rerun viewer."""

from __future__ import annotations

from pathlib import Path

import click

from lslam.cli import options
from lslam.cli.console import setup_logging, show
from lslam.core.extras import install_command

HELP = f"""Write trajectory, odometry before the pose graph, and map of a run as a recording for the rerun viewer.

\b
It needs rerun: {install_command("view")}
"""
EPILOG = """\b
Examples:
  lslam view runs/first
  rerun runs/first/run.rrd
"""


@click.command(help=HELP, epilog=EPILOG)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="Recording  [RUN/run.rrd].")
@click.option("--overwrite", is_flag=True, help="Replace a recording that is there.")
@options.verbosity
def command(run: Path, out: Path | None, overwrite: bool, verbose: bool, quiet: bool) -> None:
    """Write the recording; what users read is HELP."""
    setup_logging(verbose, quiet)
    from lslam.core.errors import OutputError, OutputExistsError
    from lslam.pipeline.run_folder import require_run
    from lslam.reports.recording import require_rerun, write_recording

    require_rerun()
    path = run / "run.rrd" if out is None else out
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists; name another file with --out or replace it with --overwrite")
    require_run(run)
    from lslam.pipeline.rebuild import viewed_run

    viewed = viewed_run(run)
    if not path.parent.is_dir():
        raise OutputError(f"{path} cannot be written: the folder {path.parent} does not exist")
    write_recording(path, viewed)
    show(f"{path}\n")
