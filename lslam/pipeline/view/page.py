"""The page that is served: the run's report, which may talk to the server where its script is this version's."""

from __future__ import annotations

import logging
from pathlib import Path

from lslam.core.errors import InputError, input_errors
from lslam.pipeline.map_files import read_json
from lslam.pipeline.run_folder import MANIFEST
from lslam.pipeline.view.server import Answer
from lslam.reports.shell import RUN, policy, script_of

log = logging.getLogger("lslam")
REPORT, TRAJECTORY = "report.html", "trajectory.tum"
TALKS = "connect-src 'self'"
SERVED = '<script type="application/json" id="served">{}</script>\n'  # tells the page's script


def page_of(folder: Path) -> Answer:
    """The report of a run.

    A page of another version, or whoever wrote it, is shown by itself: its script reaches nothing here.
    Raises InputError when it cannot be read.
    """
    with input_errors(folder / REPORT):
        text = (folder / REPORT).read_text(encoding="utf-8")
    if not is_ours(text):
        return _page(text, "sandbox allow-scripts allow-downloads")
    own = policy(script_of(RUN))
    text = text.replace(own, f"{own}; {TALKS}", 1)
    text = text.replace("<main>", SERVED + "<main>", 1)
    return _page(text, f"{own}; {TALKS}")


def is_ours(text: str) -> bool:
    """Whether a page has the script of this version."""
    return policy(script_of(RUN)) in text


def require_one_run(folder: Path) -> None:
    """Raise InputError for the folder of a merge, or of a run that ended without a pose: there is nothing to correct."""
    if read_json(folder / MANIFEST).get("kind") == "merge":
        raise InputError(
            f"{folder} is a merge of several runs: open {folder / REPORT} in a browser, or name one of its runs"
        )
    if not (folder / TRAJECTORY).is_file():
        raise InputError(
            f"{folder} has no {TRAJECTORY}: the run ended before it had a pose, so there is nothing to show"
        )


def require_page(folder: Path) -> None:
    """Raise InputError where a run has no report; say so where it is of another version."""
    if not (folder / REPORT).is_file():
        raise InputError(f"{folder} has no {REPORT}: make one with lslam graph {folder}")
    with input_errors(folder / REPORT):
        text = (folder / REPORT).read_text(encoding="utf-8", errors="replace")
    if not is_ours(text):
        log.warning(
            "%s is of another version of lslam: it is shown without tiles and corrections; lslam graph %s makes a new one",
            folder / REPORT,
            folder,
        )


def _page(text: str, rules: str) -> Answer:
    return Answer("text/html; charset=utf-8", text.encode(), headers=(("Content-Security-Policy", rules),))
