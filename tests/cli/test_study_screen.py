"""What a study shows on stderr while it runs."""

from __future__ import annotations

import heapq
import io
import logging
import math
import random
import sys
from contextlib import ExitStack

import pytest
from rich.console import Console

from lslam.cli import console
from lslam.cli.console import BestTable, RemainingTime, bars, best_so_far
from lslam.core.types.study import StudyRow

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
    # The handlers of a quiet command that ran in this process before.
    monkeypatch.setattr(console.log, "handlers", [])
    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        screen = Console(file=stream, width=120, force_terminal=True)
        monkeypatch.setattr(console, "terminal", lambda screen=screen: screen)
        with best_so_far() as table:
            table(ROWS)
        assert ("voxel 0.5" in stream.getvalue()) is shown


def ends(durations: list[float], at_once: int) -> list[float]:
    """When runs end of which so many are made at once, each begun when another ends."""
    free, out = [0.0] * at_once, []
    for duration in durations:
        out.append(heapq.heappop(free) + duration)
        heapq.heappush(free, out[-1])
    return sorted(out)


@pytest.mark.parametrize(("total", "at_once"), [(1, 1), (5, 1), (7, 2), (8, 3), (3, 8)])
def test_the_time_left_of_runs_that_take_as_long_is_exact(total: int, at_once: int) -> None:
    now = [0.0]
    left = RemainingTime(total, at_once, lambda: now[0])
    assert left.text == ""
    made = ends([60.0] * total, at_once)
    for end in made:
        now[0] = end
        left.step()
        if made.count(end) == 1:  # else others of this instant are not told yet
            assert left.seconds == pytest.approx(made[-1] - end)
    assert (left.usual, left.seconds) == (60.0, 0.0)


def test_a_first_run_that_compiles_is_not_the_pace() -> None:
    now = [0.0]
    left = RemainingTime(100, 1, lambda: now[0])
    for now[0] in (40.0, 45.0, 50.0):
        left.step()
    assert (left.usual, left.seconds) == (5.0, 97 * 5.0)


def test_the_time_left_of_unlike_runs_is_never_far_off() -> None:
    """Runs of 40 to 80 s, three at once: after a third of them the estimate is within a run of the truth, and counts down."""
    now, rng = [0.0], random.Random(1)
    made = ends([rng.uniform(40, 80) for _ in range(60)], 3)
    left = RemainingTime(60, 3, lambda: now[0])
    for k, end in enumerate(made):
        now[0] = end
        left.step()
        if k >= 20:
            assert left.seconds == pytest.approx(made[-1] - end, abs=80)
    assert left.usual == pytest.approx(60, abs=5)


def test_the_first_of_many_scans_is_not_the_rate(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr(console.log, "propagate", True)
    monkeypatch.setattr(console.log, "handlers", [])
    with caplog.at_level(logging.INFO, "lslam"), console.progress("odometry", 200) as advance:
        for now[0] in [30.0, *(30.0 + 0.1 * k for k in range(1, 200))]:
            advance()
    assert caplog.messages[0] == "odometry 1/200, 30.0 s each, compiling"
    assert caplog.messages[1] == "odometry 101/200, 10.0 scans/s, about 10 s left"
    assert caplog.messages[-1] == "odometry 200/200, 4.0 scans/s, 49.9 s"


def after(durations: list[float], total: int) -> RemainingTime:
    """The estimate after steps that took so long, one after the other."""
    now = [0.0]
    left = RemainingTime(total, 1, lambda: now[0])
    for duration in durations:
        now[0] += duration
        left.step()
    return left


def test_a_step_that_waited_for_something_else_does_not_count_and_one_in_twenty_that_is_long_does() -> None:
    waited = after([30.0] + [0.1] * 90 + [60.0] + [0.1] * 109, 1201)
    assert waited.seconds == pytest.approx(100.0, rel=0.01)
    often = after([30.0] + ([0.1] * 19 + [2.0]) * 9, 1181)
    assert often.seconds == pytest.approx(1000 * (0.1 * 19 + 2.0) / 20, rel=0.01)


def test_nothing_is_said_of_scans_that_were_held_back_and_come_at_once() -> None:
    for begun in ([5.0], [5.0] + [0.0] * 9, [5.0] + [0.0] * 9 + [0.1] * 9):
        left = after(begun, 1000)
        assert (left.text == "") is (len(begun) > 1), "the first alone is a guess, and the worst"
        assert math.isnan(left.seconds) is (len(begun) > 1)
    left = after([5.0] + [0.0] * 9 + [0.1] * 40, 1050)
    assert left.seconds == pytest.approx(100.0, rel=0.05)


def test_a_plain_line_says_how_long_is_left(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr(RemainingTime.__init__, "__defaults__", (1, lambda: now[0]))
    monkeypatch.setattr(console.log, "propagate", True)
    monkeypatch.setattr(console.log, "handlers", [])
    with caplog.at_level(logging.INFO, "lslam"), ExitStack() as stack:
        progress = bars(stack)
        progress.on_start("studying", 6, "runs", 2)
        for now[0] in (60.0, 62.0, 120.0, 124.0, 180.0, 186.0):
            progress.on_step("icp")
    assert caplog.messages[0] == "studying 1/6, 60.0 s each, 2 at once, about 2.0 min left, icp"
    assert caplog.messages[-1] == "studying 6/6, 61.0 s each, 2 at once, 186.0 s, icp"
