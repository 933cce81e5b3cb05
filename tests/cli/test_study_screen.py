"""What a study shows on stderr while it runs."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from lslam.cli import study_screen
from lslam.cli.study_screen import BestTable, best_so_far
from lslam.types.study import StudyRow

ROWS = [
    StudyRow(
        "r",
        "s",
        "open",
        0,
        "icp",
        parameters={"map.voxel": 0.5},
        status="done",
        thesis_rmse=0.125,
        metric="thesis_rmse",
    )
]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_best_so_far_is_a_table_once_there_are_rows() -> None:
    stream = io.StringIO()
    console, table = Console(file=stream, width=120), BestTable()
    console.print(table)
    assert not stream.getvalue().strip()
    table(ROWS)
    console.print(table)
    assert "voxel 0.5" in stream.getvalue()
    assert "0.125" in stream.getvalue()


def test_it_is_live_on_a_terminal_and_nothing_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        console = Console(file=stream, width=120, force_terminal=True)
        monkeypatch.setattr(study_screen, "terminal", lambda console=console: console)
        with best_so_far() as table:
            table(ROWS)
        assert ("voxel 0.5" in stream.getvalue()) is shown
