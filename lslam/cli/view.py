"""`lslam view`: a run in the browser, served on this machine, or as a recording for the rerun viewer."""

from __future__ import annotations

import signal
import threading
import webbrowser
from contextvars import copy_context
from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging, show
from lslam.core.errors import UsageError
from lslam.core.extras import install_command

HELP = f"""Show a run in the browser: its report with all points of the map, and loops and points to correct.

The page is served to this machine alone, at an address that nobody else knows, until Ctrl-C. What is corrected there goes into
edits.csv and points.csv of the run folder, and the graph that is made with them into a new folder beside it.
RUN may be the folder of a merge: its map is shown, and its loops are corrected in the single runs, which are merged again.

\b
--rerun writes a recording for the rerun viewer instead, which it needs: {install_command("view")}
"""
EPILOG = """\b
Examples:
  lslam view runs/first
  lslam view runs/first --no-browser --port 8123
  lslam view runs/first --rerun run.rrd
"""


class Port(click.IntRange):
    """Parameter type: number of a port."""

    def __init__(self) -> None:
        super().__init__(0, 65535)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Number of the value."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"{value!r} is no port: a whole number up to 65535, 0 for any that is free", param, ctx)


@click.command(help=HELP, epilog=EPILOG)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@options.option("--port", "N", "Port of the server  [any that is free].", type=Port())
@options.flag("--no-browser", "Print the address, and open no browser.")
@options.path("--rerun", "FILE", "Write a recording for rerun, and end.")
@options.flag("--overwrite", "Replace a recording that is there.")
@options.verbosity
def command(
    run: Path, port: int | None, no_browser: bool, rerun: Path | None, overwrite: bool, verbose: bool, quiet: bool
) -> None:
    """Serve the run or write the recording; what users read is HELP."""
    setup_logging(verbose, quiet)
    if rerun is not None:
        if port is not None or no_browser:
            raise UsageError("--port and --no-browser are of the server, which --rerun does without: leave them out")
        record(run, rerun, overwrite)
        return
    if overwrite:
        raise UsageError("--overwrite is of a recording: give --rerun FILE, or leave it out")
    serve(run, port or 0, not no_browser)


def record(run: Path, path: Path, overwrite: bool) -> None:
    """Write the recording. Raises OutputError when it cannot be written."""
    from lslam.core.errors import OutputError
    from lslam.pipeline.run_folder import require_new, require_run
    from lslam.reports.figures import require_rerun, write_recording

    require_rerun()
    require_new(path, overwrite, "--rerun")
    require_run(run)
    from lslam.pipeline.plot_run import view_run

    content = view_run(run)
    if not path.parent.is_dir():
        raise OutputError(f"{path} cannot be written: the folder {path.parent} does not exist")
    write_recording(path, content)
    show(f"{path}\n")


def serve(run: Path, port: int, opens: bool) -> None:
    """Serve the run until a signal ends it."""
    from lslam.core.stopping import current
    from lslam.pipeline.run_folder import require_run

    require_run(run)
    from lslam.pipeline.view.server import RunServer
    from lslam.pipeline.view.sites import ViewedSites, require_page

    require_page(run)
    stop = current()
    # The server ends with its terminal, unless nohup says otherwise.
    if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
        signal.signal(signal.SIGHUP, stop.on_signal)
    stop.is_gentle = True
    with RunServer(port) as server:
        sites = ViewedSites(server)
        sites.add(run)
        worker = threading.Thread(
            target=copy_context().run, args=(server.serve_forever,), name="lslam-view", daemon=True
        )
        worker.start()
        try:
            show(f"{server.url}\n")
            if opens:
                webbrowser.open(server.url)
            while not stop():
                worker.join(0.2)
        finally:
            server.shutdown()
            sites.stop()
    stop.is_gentle = False
    stop.check()
