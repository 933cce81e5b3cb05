"""Log and progress on stderr, in colour on a terminal and as few plain lines elsewhere; results on stdout."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from statistics import fmean
from typing import TYPE_CHECKING, Any, Protocol

from lslam.core.printable import lasting

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from lslam.core.types.study import StudyRow
    from lslam.studies.runner import StudyProgress


class TimeLeft:
    """Estimate of the remaining time; `at_once` steps are made together, and one begins when another ends.

    A running step counts with the usual duration less its elapsed time. Steps are taken to end in the order they began, since
    a swap leaves the sum of their times unchanged. The first ones wait for kernels that are compiled: once there are others, they
    do not count.
    """

    def __init__(self, total: int, at_once: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.at_once = max(1, min(at_once, total))
        self._total, self._clock = total, clock
        self._done = 0
        self._took: list[float] = []
        self._begun = [clock()] * self.at_once

    def step(self) -> None:
        """Record the end of a step and the start of the next, if there is one."""
        now = self._clock()
        self._done += 1
        if self._begun:
            self._took.append(now - self._begun.pop(0))
        if self._done + len(self._begun) < self._total:
            self._begun.append(now)

    @property
    def usual(self) -> float:
        """Mean duration of a step, s; nan before the first is done."""
        return fmean(self._took[self.at_once :] or self._took or [float("nan")])

    @property
    def seconds(self) -> float:
        """Remaining time of all steps, s, if the others take the usual one; nan before the first is done.

        >>> now = [0.0]
        >>> left = TimeLeft(5, 2, lambda: now[0])
        >>> now[0] = 10.0
        >>> left.step(); left.step()
        >>> left.seconds  # two now, and then the fifth
        20.0
        """
        now, usual = self._clock(), self.usual
        rest = sorted(max(usual - (now - began), 0.0) for began in self._begun)
        if not rest:
            return 0.0
        rounds, last = divmod(self._total - self._done - len(rest), len(rest))
        return rest[last - 1] + (rounds + 1) * usual if last else rest[-1] + rounds * usual

    @property
    def pace(self) -> str:
        """Text of the time per step, and of the number at once."""
        return f"{self.usual:.1f} s each" + (f", {self.at_once} at once" if self.at_once > 1 else "")

    @property
    def text(self) -> str:
        """Text of the remaining time; empty before the first step is done."""
        return f"about {lasting(self.seconds)} left" if self._done else ""


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
    """Write results to stdout. If its reader has closed the pipe (`lslam ... head`), discard the rest."""
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
        """Report that one unit is done."""
        ...


@contextmanager
def progress(title: str, total: int, unit: str = "scans", left: TimeLeft | None = None) -> Iterator[Advance]:
    """A progress bar with rate and time left on a terminal; elsewhere a plain line at most every 10 s and one at the end.

    left : estimate for steps that are long or several at once, where recent rates are useless
    """
    # The first handler is that of stderr; that of log.txt follows.
    if log.handlers and log.handlers[0].level > logging.INFO:
        yield lambda note="": None
        return
    if sys.stderr.isatty():
        with _bar(title, total, unit, left) as advance:
            yield advance
        return
    began = first = last = time.monotonic()
    done = 0

    def plain(note: str = "") -> None:
        nonlocal done, first, last
        done += 1
        if left is not None:
            left.step()
        now = time.monotonic()
        first = now if done == 1 else first
        if now - last < 10 and done < total:
            return
        last = now
        rate = done / max(now - began, 1e-9)
        end = f"{now - began:.1f} s"
        if done < total and left is not None:
            end = left.text
        elif done < total:  # the first may have waited for kernels: it is not the rate
            rate = (done - 1) / max(now - first, 1e-9) if done > 1 else rate
            end = f"{(total - done) / rate:.0f} s left" if done > 1 else "compiling"
        pace = _pace(rate, unit) if left is None else left.pace
        log.info("%s %d/%d, %s, %s%s", title, done, total, pace, end, note and f", {note}")

    yield plain


def _pace(rate: float, unit: str) -> str:
    return f"{rate:.1f} {unit}/s" if rate >= 1 else f"{1 / rate:.1f} s each"


@contextmanager
def _bar(title: str, total: int, unit: str, left: TimeLeft | None) -> Iterator[Advance]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class LeftColumn(ProgressColumn):
        """Column of the remaining time, which counts down between steps."""

        def render(self, task: Task) -> Text:
            """Text of the remaining time."""
            return Text(left.text if left is not None else "", style="progress.remaining")

    class PaceColumn(ProgressColumn):
        """Column of the pace, cut off on a narrow terminal."""

        def render(self, task: Task) -> Text:
            """Text of the pace and of the last step."""
            return Text(task.fields["rate"], no_wrap=True, overflow="ellipsis")

    whole = Column(no_wrap=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(table_column=whole),
        TimeRemainingColumn(table_column=whole) if left is None else LeftColumn(table_column=whole),
        PaceColumn(),
    )
    with Progress(*columns, console=terminal(), transient=True) as bar:
        task = bar.add_task(title, total=total, rate="")
        began = time.monotonic()
        done = 0

        def advance(note: str = "") -> None:
            nonlocal done
            done += 1
            if left is not None:
                left.step()
            pace = left.pace if left is not None else _pace(done / max(time.monotonic() - began, 1e-9), unit)
            bar.update(task, advance=1, rate=f"{pace} {note}")

        yield advance


def bars(stack: ExitStack) -> StudyProgress:
    """Progress bars of several stages, one after the other."""
    from lslam.studies.runner import StudyProgress

    bar = stack.enter_context(ExitStack())
    advance: list[Any] = []

    def on_start(stage: str, total: int, unit: str, at_once: int) -> None:
        bar.close()
        left = None if unit == "scans" else TimeLeft(total, at_once)
        advance[:] = [bar.enter_context(progress(stage, total, unit, left))]

    return StudyProgress(on_start, lambda note: advance[0](note))


class BestTable:
    """Table of the best result of each method so far, below the bar; called with all rows after every run."""

    def __init__(self) -> None:
        self.table: Table | str = ""

    def __call__(self, rows: Sequence[StudyRow]) -> None:
        """Make the table of the rows."""
        from rich import box
        from rich.table import Table

        from lslam.reports.study_table import best_table

        header, *lines = best_table(rows)
        self.table = Table(*header, box=box.SIMPLE_HEAD, pad_edge=False)
        for line in lines:
            self.table.add_row(*line)

    def __rich__(self) -> Table | str:
        return self.table


@contextmanager
def best_so_far() -> Iterator[BestTable]:
    """Live table of the best results on a terminal; nothing elsewhere."""
    table = BestTable()
    is_quiet = bool(log.handlers) and log.handlers[0].level > log.getEffectiveLevel()
    if is_quiet or not sys.stderr.isatty():
        yield table
        return
    from rich.live import Live

    with Live(table, console=terminal(), transient=True, refresh_per_second=2):
        yield table
