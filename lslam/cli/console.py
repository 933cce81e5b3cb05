"""Log and progress on stderr, in colour on a terminal and as few plain lines elsewhere; results on stdout."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console

log = logging.getLogger("lslam")


def setup_logging(verbose: bool = False, quiet: bool = False) -> None:
    """Send lslam's log to stderr. The log.txt of a run is written by another handler, which `quiet` does not limit."""
    handler: logging.Handler
    if sys.stderr.isatty():
        from rich.logging import RichHandler

        handler = RichHandler(console=terminal(), show_path=False, show_time=False, markup=False, highlighter=None)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    handler.setLevel(logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO)
    log.handlers[:] = [handler]
    log.setLevel(logging.DEBUG if verbose else logging.INFO)
    log.propagate = False
    # A terminal or pipe that is closed during a run must not cause tracebacks of the log.
    logging.raiseExceptions = False


@cache
def terminal() -> Console:
    """The console that log and progress bar share, so that a line of the log does not break the bar."""
    from rich.console import Console

    return Console(stderr=True)


def show(text: str) -> None:
    """Write results to stdout. When its reader has closed the pipe (`lslam ... | head`), the rest is discarded."""
    import click

    try:
        click.echo(text, nl=False)
    except BrokenPipeError:
        leave_stdout()


def leave_stdout() -> None:
    """Redirect stdout to the null device after its pipe was closed, so that later writes, also at exit, do not fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Advance(Protocol):
    """Callback after each unit of work; `note` is shown beside the bar."""

    def __call__(self, note: str = "") -> None:
        """One unit is done."""
        ...


@contextmanager
def progress(title: str, total: int, unit: str = "scans") -> Iterator[Advance]:
    """A progress bar with rate and ETA on a terminal; elsewhere a plain line at most every 10 s and one at the end."""
    # The first handler is that of stderr; that of log.txt follows.
    if log.handlers and log.handlers[0].level > logging.INFO:
        yield lambda note="": None
        return
    if sys.stderr.isatty():
        with _bar(title, total, unit) as advance:
            yield advance
        return
    began = last = time.monotonic()
    done = 0

    def plain(note: str = "") -> None:
        nonlocal done, last
        done += 1
        now = time.monotonic()
        if now - last < 10 and done < total:
            return
        last = now
        rate = done / max(now - began, 1e-9)
        left = f"{(total - done) / rate:.0f} s left" if done < total else f"{now - began:.1f} s"
        log.info("%s %d/%d, %s, %s%s", title, done, total, _pace(rate, unit), left, note and f", {note}")

    yield plain


def _pace(rate: float, unit: str) -> str:
    return f"{rate:.1f} {unit}/s" if rate >= 1 else f"{1 / rate:.1f} s each"


@contextmanager
def _bar(title: str, total: int, unit: str) -> Iterator[Advance]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=terminal(), transient=True) as bar:
        task = bar.add_task(title, total=total, rate="")
        began = time.monotonic()
        done = 0

        def advance(note: str = "") -> None:
            nonlocal done
            done += 1
            rate = done / max(time.monotonic() - began, 1e-9)
            bar.update(task, advance=1, rate=f"{_pace(rate, unit)} {note}")

        yield advance
