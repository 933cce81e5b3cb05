"""Progress of a study on stderr: one bar after the other, and on a terminal the best result of each method so far."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from lslam.cli.console import TimeLeft, log, progress, terminal

if TYPE_CHECKING:
    from rich.table import Table

    from lslam.studies.runner import StudyProgress
    from lslam.types.study import StudyRow


def bars(stack: ExitStack) -> StudyProgress:
    """One progress bar after the other."""
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
    """A live table on a terminal; elsewhere it is not shown."""
    table = BestTable()
    is_quiet = bool(log.handlers) and log.handlers[0].level > log.getEffectiveLevel()
    if is_quiet or not sys.stderr.isatty():
        yield table
        return
    from rich.live import Live

    with Live(table, console=terminal(), transient=True, refresh_per_second=2):
        yield table
