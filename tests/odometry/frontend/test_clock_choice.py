"""Clocks of points without times, told by the agreement of scans: right, or left alone."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import SequenceView, StatedTimes
from lslam.odometry.frontend.clock_choice import ClockChoice
from lslam.odometry.frontend.point_times import later_choices, with_point_times
from lslam.registration.preprocessing.sweep_clock import Proposal, SweepClock
from lslam.registration.preprocessing.views import MergedLidars
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import SimulatedDrive, simulate

Change = Callable[[Scan], Scan]
LIDAR = dataclasses.replace(LIDARS["vlp16"], columns=900)
COUNT, SECONDS = 14, 0.1
PREPROCESS = PreprocessConfig()


@cache
def drive(compensated: bool = False) -> SimulatedDrive:
    """A street at 8 m/s."""
    return simulate("street", lidar=LIDAR, count=COUNT, motion_compensated=compensated)


@cache
def scan_of(compensated: bool, index: int) -> Scan:
    return drive(compensated).scan(index)


class Untimed:
    """The drive without the times and rings of its points; what `change` makes of each scan."""

    motion_compensated: bool | None = None

    def __init__(
        self, change: Change = lambda scan: scan, compensated: bool = False, first: int | None = None, **own: Any
    ) -> None:
        self._change, self._compensated, self._first = change, compensated, first
        self.notes: list[str] = []
        vars(self).update(own)

    def __getattr__(self, name: str) -> Any:
        return getattr(drive(self._compensated), name)

    def __len__(self) -> int:
        return COUNT

    def timed(self, index: int) -> Scan:
        """As `change` made it, with its true times."""
        own = scan_of(self._compensated, index if self._first is None else self._first)
        return replace(self._change(own), index=index, stamp_ns=int(self.stamps_ns[index]))

    def scan(self, index: int) -> Scan:
        return replace(self.timed(index), times=None, rings=None)


def columns_first(scan: Scan) -> Scan:
    return scan.select(np.argsort(azimuth_share(scan), kind="stable"))


def azimuth_share(scan: Scan) -> Any:
    """A VLP-16 turns clockwise from ahead."""
    return np.mod(-np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi), 1.0).round(4)


def sorted_from_behind(scan: Scan) -> Scan:
    """In the order of the azimuth from -180 to 180 deg, as some tool may leave them: against the sense, from elsewhere."""
    return scan.select(np.argsort(np.arctan2(scan.points[:, 1], scan.points[:, 0]), kind="stable"))


def wrong_share(sequence: Any, whole: Untimed) -> float:
    """Share of the points whose times are off by more than 5 % of the sweep, apart from one offset for all."""
    scan, true = sequence.scan(5), whole.timed(5)
    off = scan.times - true.times
    return float((np.abs(off - np.median(off)) > 0.05 * SECONDS).mean())


def test_the_order_of_firing_is_told_by_the_agreement_of_scans() -> None:
    untimed = Untimed(columns_first)
    sequence: Any = with_point_times(untimed, PREPROCESS)  # type: ignore[arg-type]
    assert sequence.clock_choice.verdict == "clear"
    assert sequence.sweep_clock.kind == "order"
    assert not sequence.sweep_clock.is_reversed
    assert wrong_share(sequence, untimed) < 0.01
    assert sequence.notes[-1].startswith(
        "point times: by the order of the points, clockwise, from azimuth 0 deg, 0.1 s"
    )
    scores = sequence.clock_choice.scores
    assert scores["order"] < 0.9 * scores["no times"] < 0.9 * scores["order reversed"]
    assert json.loads(json.dumps(sequence.clock_choice.facts()))["clock"]["kind"] == "order"


def test_points_in_reverse_order_are_told_too() -> None:
    untimed = Untimed(lambda scan: columns_first(scan).select(slice(None, None, -1)))
    sequence: Any = with_point_times(untimed, PREPROCESS)  # type: ignore[arg-type]
    assert sequence.sweep_clock.is_reversed
    assert wrong_share(sequence, untimed) < 0.01


def test_an_order_that_is_not_that_of_firing_is_never_taken_for_it() -> None:
    untimed = Untimed(sorted_from_behind)
    sequence: Any = with_point_times(untimed, PREPROCESS)  # type: ignore[arg-type]
    assert sequence.clock_choice.verdict == "unclear" or wrong_share(sequence, untimed) < 0.08


def test_compensated_scans_are_told_and_stay_as_they_are() -> None:
    sequence: Any = with_point_times(Untimed(columns_first, compensated=True), PREPROCESS)  # type: ignore[arg-type]
    assert sequence.clock_choice.verdict == "compensated"
    assert sequence.motion_compensated is True
    assert sequence.scan(3).times is None
    assert "the scans agree best as they are" in sequence.notes[-1]


def test_a_standing_sensor_decides_nothing() -> None:
    sequence: Any = with_point_times(Untimed(columns_first, compensated=True, first=0), PREPROCESS)  # type: ignore[arg-type]
    assert sequence.clock_choice.verdict == "standing"
    assert sequence.motion_compensated is None
    assert sequence.scan(3).times is None
    assert "the sensor does not move enough to decide" in sequence.notes[-1]


def test_nothing_is_registered_where_times_are_there_or_are_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lslam.odometry.frontend.point_times.choose_clock", None)
    timed = drive()
    assert with_point_times(timed, PREPROCESS) is timed
    compensated = Untimed(motion_compensated=True)
    assert with_point_times(compensated, PREPROCESS) is compensated  # type: ignore[arg-type, comparison-overlap]
    merged = MergedLidars.__new__(MergedLidars)
    SequenceView.__init__(merged, Untimed(columns_first))  # type: ignore[arg-type]
    assert with_point_times(merged, PREPROCESS) is merged
    quick = Untimed()
    assert with_point_times(quick, PREPROCESS, is_stated_only=True) is quick  # type: ignore[arg-type, comparison-overlap]


@pytest.mark.parametrize("kind", [None, "field"])
def test_a_first_message_without_times_does_not_speak_for_the_field_of_the_others(
    kind: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lslam.odometry.frontend.point_times.choose_clock", None)
    sequence = SequenceView(drive(), stated_times=StatedTimes(kind))
    read = sequence.scan
    monkeypatch.setattr(sequence, "scan", lambda k: read(k) if k else replace(read(0), times=None))
    assert with_point_times(sequence, PREPROCESS) is sequence


@pytest.mark.parametrize("kind", ["order", "azimuth"])
def test_a_stated_clock_is_taken_without_evidence(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lslam.odometry.frontend.point_times.choose_clock", None)
    untimed = Untimed(columns_first, stated_times=StatedTimes(kind, "end"))
    sequence: Any = with_point_times(untimed, PREPROCESS)  # type: ignore[arg-type]
    assert sequence.sweep_clock.kind == kind
    times, true = sequence.scan(2).times, untimed.timed(2).times
    # Noise puts a few points on the other side of where sweeps begin.
    assert (np.abs(times - (true - SECONDS)) > 0.002).mean() < 0.002
    assert sequence.notes[-1].endswith("stamped at its end, as stated")


def test_stated_none_takes_times_away() -> None:
    timed = Untimed(stated_times=StatedTimes("none"))
    timed.scan = timed.timed  # type: ignore[method-assign]
    assert timed.scan(0).times is not None
    sequence: Any = with_point_times(timed, PREPROCESS)  # type: ignore[arg-type]
    assert sequence.scan(0).times is None
    assert sequence.notes[-1] == "point times: none, as stated"


@pytest.mark.parametrize(("kind", "why"), [("field", "no time field"), ("columns", "not organised in rows")])
def test_what_is_stated_and_not_there_is_refused(kind: str, why: str) -> None:
    untimed = Untimed(columns_first, stated_times=StatedTimes(kind))
    with pytest.raises(InputError, match=why):
        with_point_times(untimed, PREPROCESS)  # type: ignore[arg-type]


class Windows:
    """What `read_window` gives of a recording whose scans agree under a clock of which the last index is `until`."""

    def __init__(self, clocks: list[tuple[int, SweepClock | None]], first: int) -> None:
        self.scans = [Scan(np.random.default_rng(0).normal(size=(64, 3)).astype(np.float32), 0, first)]
        self.is_moving = True
        self._right = [next(clock for end, clock in clocks if i < end) for i in range(first, first + 10)]

    def is_astray(self, clock: SweepClock | None) -> bool:
        return False

    def scores(self, clock: SweepClock | None) -> Any:
        return np.array([0.1 if clock == right else 0.2 for right in self._right]) + 0.001 * np.arange(10)


def test_a_clock_that_no_longer_fits_is_decided_again_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SweepClock("azimuth", SECONDS, sense=1, begin_rad=0.0)
    reverse, elsewhere = replace(clock, is_reversed=True), replace(clock, is_reversed=True, turn=0.5)
    true = [(950, clock), (1700, None), (2300, reverse), (9999, elsewhere)]
    asked: list[int] = []

    def read(sequence: Any, first: int, preprocess: PreprocessConfig) -> Windows:
        asked.append(first)
        return Windows(true, first)

    def decide(first: int) -> ClockChoice:
        right = next(clock for end, clock in true if first + 5 < end)
        return ClockChoice(right, "clear", "")

    monkeypatch.setattr("lslam.odometry.frontend.point_times.read_window", read)
    later = later_choices(range(3000), clock, decide, PREPROCESS)  # type: ignore[arg-type]
    assert [choice.clock for _, choice in later] == [None, reverse, elsewhere]
    assert [first for first, _ in later] == pytest.approx([950, 1700, 2300], abs=8)
    assert len(asked) < 7 + 3 * 8
    assert later_choices(range(800), clock, decide, PREPROCESS) == []  # type: ignore[arg-type]


def test_scans_after_a_change_have_the_times_of_another_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    choices = {0: 1, 9: -1}
    untimed = Untimed(columns_first)

    def choose(sequence: Any, proposal: Proposal, sample: Scan, preprocess: PreprocessConfig) -> ClockChoice:
        first = COUNT - len(sequence)
        return ClockChoice(replace(proposal.clock, is_reversed=choices[first] < 0), "clear", f"told at {first}")

    monkeypatch.setattr("lslam.odometry.frontend.point_times.choose_clock", choose)
    monkeypatch.setattr(
        "lslam.odometry.frontend.point_times.later_choices",
        lambda sequence, clock, decide, preprocess: [(9, decide(9))],
    )
    sequence: Any = with_point_times(untimed, PREPROCESS)  # type: ignore[arg-type]
    assert sequence.notes == ["told at 0", "from scan 9 on the clock no longer fits: told at 9"]
    forward, backward = sequence.scan(8).times, sequence.scan(9).times
    assert np.median(np.diff(forward)) > 0 > np.median(np.diff(backward))
    facts = json.loads(json.dumps(sequence.clock_choice.facts()))
    assert (facts["later"][0]["scan"], facts["later"][0]["clock"]["is_reversed"]) == (9, True)
