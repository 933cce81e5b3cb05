"""`lslam demo`: a small drive simulated, run and shown, for whoever has no recording yet."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli import run as main_job
from lslam.cli import simulate as simulating
from lslam.cli.console import log, open_page, progress, setup_logging, show

# Once round a block of houses, with a loop to close, seen by a VLP-16 on a car.
SCENARIO, LIDAR, SCANS = "block", "vlp16", 95


@click.command(epilog="\b\nExamples: lslam demo\n          lslam demo --no-browser --out tour")
@options.path("--out", "DIR", "Folder of recording and run [default: lslam-demo].", default=Path("lslam-demo"))
@options.flag("--no-browser", "Do not open the page in a browser.")
@options.flag("--overwrite", "Replace an earlier demo in the folder.")
@options.as_json
@options.verbosity
def command(out: Path, no_browser: bool, **given: Any) -> None:
    """Simulate a small drive with a loop, run it, and open its page. A minute at the first time, when kernels are compiled.

    Nothing is asked and nothing is fetched. The last lines are three commands to go on with.
    """
    setup_logging(given["verbose"], given["quiet"])
    recording, folder = out / "recording", out / "run"
    from lslam.core.config import Config
    from lslam.pipeline.precompile import helper_process, start_helper
    from lslam.pipeline.run_folder import check_target
    from lslam.simulation import check_target as check_recording

    check_recording(recording, given["overwrite"], False)
    check_target(folder, given["overwrite"])
    context = click.get_current_context()
    with helper_process():
        # Rays are cast on one core: the other one compiles what the run needs.
        start_helper(Config(), if_cold=True)
        with progress("opening"):
            from lslam.simulation.scenarios import simulate
            from lslam.simulation.sensors import GnssModel, WheelModel

            drive = simulate(
                SCENARIO, lidar=LIDAR, count=SCANS, imu="icm20948", gnss=GnssModel(1.0), wheels=WheelModel()
            )
        log.info("%s", simulating.record_drive(drive, recording, given["overwrite"]).text)
        context.invoke(main_job.command, sequence=str(recording), out=folder, lidar_topic=None, **given)
    page = folder / "report.html"
    is_open = not no_browser and open_page(page)
    if given["as_json"]:
        return
    where = "is open in your browser" if is_open else "is to be opened in a browser"
    show(f"\nThe page {where}: {page.absolute()}\n\nTo go on:\n")
    for words in (
        ("info", recording),
        ("run", recording, "--gnss", "--set", "map.format=laz", "--out", out / "georeferenced"),
        ("compare", recording, "--methods", "icp,gicp", "--out", out / "compared"),
    ):
        show(f"  {shlex.join(['lslam', *map(str, words)])}\n")
