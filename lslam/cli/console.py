"""Log and progress on stderr, in colour on a terminal, as JSON for scripts, as few plain lines elsewhere; results on stdout."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from statistics import fmean, median
from typing import TYPE_CHECKING, Any, Protocol

from lslam.core.printable import lasting

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lslam.core.types.study import StudyRow
    from lslam.studies.runner import StudyProgress


class RemainingTime:
    """Estimate of the remaining time of `total` steps; `at_once` are made together, and one begins when another ends.

    A running step counts with the usual duration less its elapsed time. Steps are taken to end in the order they began: a swap
    leaves the sum of their times unchanged. The first steps, which wait for kernels that are compiled, do not count later.
    """

    def __init__(self, total: int, at_once: int = 1, clock: Callable[[], float] | None = None) -> None:
        self.at_once = max(1, min(at_once, total))
        self._total, self._clock = total, clock or time.monotonic
        self._count = 0
        self._took: list[float] = []
        self._starts = [self._clock()] * self.at_once

    def step(self) -> None:
        """Record the end of a step and the start of the next, if there is one."""
        now = self._clock()
        self._count += 1
        if self._starts:
            self._took.append(now - self._starts.pop(0))
        if self._count + len(self._starts) < self._total:
            self._starts.append(now)

    @property
    def _durations(self) -> list[float]:
        return self._took[self.at_once :] or self._took

    @property
    def usual(self) -> float:
        """Duration of a step, s: the median of the means of nine equal parts of all; nan before the first is done.

        So a few steps that wait for something else do not count, and many that take longer than most do.
        """
        took = self._durations
        if not took:
            return math.nan
        parts = min(len(took), _PARTS)
        return median(fmean(took[k * len(took) // parts : (k + 1) * len(took) // parts]) for k in range(parts))

    @property
    def seconds(self) -> float:
        """Remaining time of all steps, s, if the others take the usual one; nan before a second of them is seen.

        Scans that were held back at the start come all at once: they say nothing.

        >>> now = [0.0]
        >>> remaining = RemainingTime(5, 2, lambda: now[0])
        >>> now[0] = 10.0
        >>> remaining.step(); remaining.step()
        >>> remaining.seconds  # two now, and then the fifth
        20.0
        """
        if sum(self._durations) < _LEAST_S:
            return math.nan
        now, usual = self._clock(), self.usual
        rest = sorted(max(usual - (now - began), 0.0) for began in self._starts)
        if not rest:
            return 0.0
        rounds, last = divmod(self._total - self._count - len(rest), len(rest))
        return rest[last - 1] + (rounds + 1) * usual if last else rest[-1] + rounds * usual

    @property
    def pace(self) -> str:
        """Text of the time per step, and of the number at once."""
        usual = self.usual
        text = f"{usual:.1f} s each" + (f", {self.at_once} at once" if self.at_once > 1 else "")
        return "" if math.isnan(usual) else text

    @property
    def text(self) -> str:
        """Text of the remaining time; empty before it is known."""
        seconds = self.seconds
        return "" if math.isnan(seconds) else f"about {lasting(seconds)} left"


log = logging.getLogger("lslam")
_PARTS = 9  # of the steps that are done, for the time left
_LEAST_S = 1.0  # of steps, before a word on the time left
_EVERY_S = 1.0  # between two events of a stage


class Events(logging.Handler):
    """Handler of lslam's log for `--progress json`: a JSON object a line, in one call, so that who is killed leaves whole lines.

    A record is an event of its level's name, `info`, `warning` or `error`, unless it brings another in `extra`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._began = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the event of a record."""
        facts = {"event": record.levelname.lower(), "text": record.getMessage(), **getattr(record, "event", {})}
        self.tell(**facts)

    def tell(self, event: str, **facts: Any) -> None:
        """Write an event; `elapsed_s` counts from the start of the command. A pipe that is closed does not end a run."""
        line = {"event": event, "elapsed_s": round(time.monotonic() - self._began, 3), **facts}
        assert self.lock is not None
        with self.lock, suppress(OSError, ValueError):
            sys.stderr.write(json.dumps(line, default=str) + "\n")
            sys.stderr.flush()


def events() -> Events | None:
    """The handler, where `--progress json` was given."""
    first = log.handlers[0] if log.handlers else None
    return first if isinstance(first, Events) else None


def begin_events() -> None:
    """Write events from now on."""
    log.handlers[:] = [Events()]


def setup_logging(verbose: bool = False, quiet: bool = False) -> None:
    """Send lslam's log to stderr. The log.txt of a run is written by another handler, which `quiet` does not limit."""
    handler: logging.Handler | None = events()
    if handler is not None:
        pass
    elif sys.stderr.isatty():
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


def show_json(document: dict[str, Any], **how: Any) -> None:
    """Write a result to stdout as one JSON object, which has no NaN; how : as of `json.dumps`."""
    show(json.dumps(document, allow_nan=False, **how) + "\n")


def show_rows(rows: Iterable[tuple[str, object]], width: int = 10) -> None:
    """Write a result to stdout as a line for each name and value; width : of the names."""
    show("".join(f"{name:<{width}} {value}".rstrip() + "\n" for name, value in rows))


def leave_stdout() -> None:
    """Redirect stdout to the null device after its pipe was closed, so that later writes, also at exit, do not fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Advance(Protocol):
    """Callback after each unit of work; `note` is shown beside the bar."""

    def __call__(self, note: str = "") -> None:
        """Report that one unit is done."""
        ...


@contextmanager
def progress(
    title: str, total: int = 0, unit: str = "scans", remaining: RemainingTime | None = None
) -> Iterator[Advance]:
    """A bar with pace and time left on a terminal, events for scripts; else a plain line at most every 10 s and one at the end.

    total : number of steps, 0 for a stage without any, of which there is no plain line
    remaining : estimate for steps that are several at once
    """
    remaining = remaining or RemainingTime(total)
    to = events()
    # The first handler is that of stderr; that of log.txt follows.
    is_quiet = bool(log.handlers) and log.handlers[0].level > logging.INFO
    if to is not None:
        with _tell_steps(to, title, total, unit, remaining) as advance:
            yield advance
    elif is_quiet:
        yield lambda note="": None
    elif sys.stderr.isatty():
        with _bar(title, total, unit, remaining) as advance:
            yield advance
    else:
        yield _plain(title, total, unit, remaining)


def _plain(title: str, total: int, unit: str, remaining: RemainingTime) -> Advance:
    """Function that logs progress at most every ten seconds, and at the end."""
    began = last = time.monotonic()
    done = 0

    def plain(note: str = "") -> None:
        nonlocal done, last
        done += 1
        remaining.step()
        now = time.monotonic()
        if now - last < 10 and done < total:
            return
        last = now
        pace, end = _pace(remaining, unit), f"{now - began:.1f} s"
        if done < total:
            end = "compiling" if done == 1 and unit == "scans" else remaining.text
        elif unit == "scans":
            pace = f"{done / max(now - began, 1e-9):.1f} {unit}/s"
        log.info("%s %d/%d, %s", title, done, total, ", ".join(part for part in (pace, end, note) if part))

    return plain


def _pace(remaining: RemainingTime, unit: str) -> str:
    """Text of the speed: units per second, or seconds per unit if slow."""
    is_fast = unit == "scans" and remaining.usual <= 1
    return f"{1 / max(remaining.usual, 1e-9):.1f} {unit}/s" if is_fast else remaining.pace


@contextmanager
def _tell_steps(to: Events, title: str, total: int, unit: str, remaining: RemainingTime) -> Iterator[Advance]:
    """Write the stage as events: its begin, its end, and at most one a second between."""
    began = last = time.monotonic()
    done = 0
    steps = {"steps": total, "unit": unit} if total else {}

    def tell(event: str, **facts: object) -> None:
        share = {"done": done, "share": round(min(done / total, 1.0), 4)} if total else {}
        to.tell(event, stage=title, **steps, **share, **facts)

    def advance(note: str = "") -> None:
        nonlocal done, last
        done += 1
        remaining.step()
        if time.monotonic() - last >= _EVERY_S and done < total:
            last = time.monotonic()
            seconds = remaining.seconds
            left_s = None if math.isnan(seconds) else round(seconds, 1)
            tell("progress", left_s=left_s, **({"note": note} if note else {}))

    tell("begin")
    try:
        yield advance
    finally:
        tell("end", seconds=round(time.monotonic() - began, 3))


@contextmanager
def _bar(title: str, total: int, unit: str, remaining: RemainingTime) -> Iterator[Advance]:
    """Progress bar on a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    class LeftColumn(ProgressColumn):
        """Column of the remaining time, which counts down between steps."""

        def render(self, task: Task) -> Text:
            """Text of the remaining time."""
            return Text(remaining.text, style="progress.remaining")

    class PaceColumn(ProgressColumn):
        """Column of the pace, cut off on a narrow terminal."""

        def render(self, task: Task) -> Text:
            """Text of the pace and of the last step."""
            return Text(task.fields["rate"], no_wrap=True, overflow="ellipsis")

    whole = Column(no_wrap=True)
    columns = (MofNCompleteColumn(table_column=whole), LeftColumn(table_column=whole), PaceColumn()) if total else ()
    with Progress(TextColumn("{task.description}"), BarColumn(), *columns, console=terminal(), transient=True) as bar:
        task = bar.add_task(title, total=total or None, rate="")

        def advance(note: str = "") -> None:
            remaining.step()
            bar.update(task, advance=1, rate=f"{_pace(remaining, unit)} {note}")

        yield advance


class Stages:
    """The stages of a command, one after the other: where one begins, the one before ends."""

    def __init__(self, stack: ExitStack) -> None:
        self._bar = stack.enter_context(ExitStack())
        self._advance: Advance = lambda note="": None

    def begin(self, title: str, total: int = 0, unit: str = "scans", at_once: int = 1) -> None:
        """Begin a stage; arguments as of `progress`, and how many steps are made at once."""
        self._bar.close()
        self._advance = self._bar.enter_context(progress(title, total, unit, RemainingTime(total, at_once)))

    def step(self, note: str = "") -> None:
        """One step of the present stage is done."""
        self._advance(note)

    def end(self) -> None:
        """End the last stage."""
        self._bar.close()


def bars(stack: ExitStack) -> StudyProgress:
    """Progress bars of the stages of a study."""
    from lslam.studies.runner import StudyProgress

    stages = Stages(stack)
    return StudyProgress(stages.begin, stages.step)


def has_window() -> bool:
    """Whether a browser could show a window: without, one in text would take this terminal."""
    names = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in names)


def open_page(page: Path) -> bool:
    """Open a page in the user's browser; False where there is none with a window of its own."""
    import webbrowser

    try:
        return has_window() and webbrowser.open(page.absolute().as_uri())
    except (webbrowser.Error, OSError):
        return False


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
    if is_quiet or events() is not None or not sys.stderr.isatty():
        yield table
        return
    from rich.live import Live

    with Live(table, console=terminal(), transient=True, refresh_per_second=2):
        yield table
