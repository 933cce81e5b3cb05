"""Everything a person sees besides results: log and progress on stderr, coloured on a terminal, sparse lines elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

log = logging.getLogger("lslam")


def setup_logging(verbose: bool = False, quiet: bool = False) -> None:
    """Send lslam's log to stderr."""
    level = logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO
    handler: logging.Handler
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.logging import RichHandler

        handler = RichHandler(console=Console(stderr=True), show_path=False, show_time=False, markup=False)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    log.handlers[:] = [handler]
    log.setLevel(level)
    log.propagate = False


class Advance(Protocol):
    """Called after each unit of work with what to show beside the bar."""

    def __call__(self, note: str = "") -> None:
        """One unit is done."""
        ...


@contextmanager
def progress(title: str, total: int, unit: str = "scans") -> Iterator[Advance]:
    """A progress bar with rate and ETA on a terminal; a plain line at most every 10 s elsewhere."""
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
        if now - last >= 10:
            last = now
            rate = done / (now - began)
            log.info(
                "%s %d/%d, %.1f %s/s, %.0f s left %s",
                title,
                done,
                total,
                rate,
                unit,
                (total - done) / rate,
                note,
            )

    yield plain


@contextmanager
def _bar(title: str, total: int, unit: str) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total, rate="")
        began = time.monotonic()
        done = 0

        def advance(note: str = "") -> None:
            nonlocal done
            done += 1
            rate = done / max(time.monotonic() - began, 1e-9)
            bar.update(task, advance=1, rate=f"{rate:.1f} {unit}/s {note}")

        yield advance
