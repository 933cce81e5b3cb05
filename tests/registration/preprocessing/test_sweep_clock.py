"""Times of points by columns, order and azimuth: what the order of the points proposes, against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.types.scan import Scan
from lslam.registration.preprocessing.sweep_clock import (
    SweepClock,
    azimuth_proposal,
    follow_rings,
    follow_sweep,
    is_same_motion,
    propose_clock,
)

ROWS, COLUMNS, SECONDS = 16, 512, 0.1
NOMINAL = SweepClock("order", SECONDS)
Chosen = NDArray[np.intp]


def spun(begin_deg: float = 0.0, clockwise: bool = True, seed: int = 0, offsets_deg: float = 0.0) -> Scan:
    """A sensor that turns once in a hall with uneven walls, column after column; `offsets_deg` between its lasers."""
    rng = np.random.default_rng(seed)
    share = np.repeat(np.arange(COLUMNS) / COLUMNS, ROWS)
    ring = np.tile(np.arange(ROWS), COLUMNS)
    sense = -1 if clockwise else 1
    azimuth = np.radians(begin_deg) + sense * 2 * np.pi * share + np.radians(offsets_deg) * ((ring % 4) - 1.5) / 3
    elevation = np.radians(15 - 2 * ring)
    distance = 10 + 3 * np.cos(3 * azimuth) + rng.normal(0, 0.01, len(share))
    flat = distance * np.cos(elevation)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)
    return Scan(
        points.astype(np.float32), 0, seed, times=(SECONDS * share).astype(np.float32), rings=ring.astype(np.uint16)
    )


def rows_first(scan: Scan) -> Scan:
    assert scan.rings is not None
    return scan.select(np.lexsort((np.arange(len(scan)), scan.rings)))


def half(scan: Scan) -> Scan:
    return scan.select(np.random.default_rng(scan.index).random(len(scan)) < 0.5)


def front(scan: Scan) -> Scan:
    return scan.select(np.abs(np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))) < 110)


def two_returns(scan: Scan) -> Scan:
    twice = np.flatnonzero(np.random.default_rng(scan.index).random(len(scan)) < 0.3)
    return scan.select(np.sort(np.concatenate([np.arange(len(scan)), twice])))


def second_returns_behind(scan: Scan) -> Scan:
    twice = np.flatnonzero(np.random.default_rng(scan.index).random(len(scan)) < 0.4)
    return scan.select(np.concatenate([np.arange(len(scan)), twice]))


def shuffled(scan: Scan) -> Scan:
    return scan.select(np.random.default_rng(scan.index).permutation(len(scan)))


def wrong_share(clock: SweepClock, scan: Scan) -> float:
    """Share of the points whose times are off by more than 2 % of the sweep, apart from one offset for all."""
    times, why = clock.times_of(scan.points)
    assert not why
    assert scan.times is not None
    off = times - scan.times
    return float((np.abs(off - np.median(off)) > 0.02 * SECONDS).mean())


# Each kind of clock from every azimuth in both senses; what else leads to it, from two.
ROUND = [(begin_deg, clockwise) for begin_deg in (0.0, 100.0, -180.0) for clockwise in (True, False)]
CHANGED = [
    *((lambda scan: scan, "columns", *begun) for begun in ROUND),
    *((half, "order", *begun) for begun in ROUND),
    *((lambda scan: half(rows_first(scan)), "azimuth", *begun) for begun in ROUND),
    *(
        (*change, *begun)
        for change in (
            (rows_first, "columns"), (two_returns, "order"), (second_returns_behind, "azimuth"), (front, "order"),
        )
        for begun in ((100.0, True), (-180.0, False))
    ),
]  # fmt: skip


@pytest.mark.parametrize(("change", "kind", "begin_deg", "clockwise"), CHANGED)
def test_the_order_of_points_proposes_the_times_at_which_they_were_fired(
    change: object, kind: str, begin_deg: float, clockwise: bool
) -> None:
    scans = [change(spun(begin_deg, clockwise, seed)) for seed in range(3)]  # type: ignore[operator]
    proposal = propose_clock(scans, NOMINAL, None)
    assert proposal is not None
    assert not proposal.is_guess
    assert proposal.clock.kind == kind
    assert wrong_share(proposal.clock, scans[1]) < 0.02
    assert wrong_share(replace(proposal.clock, is_reversed=True), scans[1]) > 0.5


def test_offsets_between_lasers_do_not_hide_the_order() -> None:
    scans = [half(spun(30.0, True, seed, offsets_deg=12.0)) for seed in range(3)]
    proposal = propose_clock(scans, NOMINAL, None)
    assert proposal is not None
    assert proposal.clock.kind == "order"
    assert wrong_share(proposal.clock, scans[0]) < 0.02


def test_points_in_no_order_tell_neither_sense_nor_beginning() -> None:
    scans = [shuffled(spun(0.0, True, seed)) for seed in range(3)]
    assert all(follow_sweep(scan.points) is None and follow_rings(scan.points) is None for scan in scans)
    proposal = propose_clock(scans, NOMINAL, None)
    assert proposal is not None
    assert proposal.is_guess
    assert proposal.clock.kind == "azimuth"


def test_a_narrow_view_proposes_nothing() -> None:
    scan = spun()
    ahead = scan.select(np.abs(np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))) < 60)
    assert propose_clock([ahead], NOMINAL, None) is None
    assert propose_clock([], NOMINAL, None) is None


def test_stated_rows_are_stored_row_after_row() -> None:
    scans = [rows_first(spun(0.0, True, seed)) for seed in range(2)]
    # Invalid points keep their column.
    scans[0].points[::7] = np.nan
    proposal = propose_clock(scans, NOMINAL, ROWS)
    assert proposal is not None
    assert replace(proposal.clock, begin_rad=None) == SweepClock("columns", SECONDS, rows=ROWS, sense=-1)
    assert proposal.clock.begin_rad == pytest.approx(0, abs=0.02)
    assert wrong_share(proposal.clock, scans[0]) == 0


def test_a_sweep_that_begins_anywhere_counts_from_its_first_point() -> None:
    scans = [half(spun(begin, True, seed)) for seed, begin in enumerate((0.0, 80.0, 160.0, 240.0, 320.0))]
    proposal = propose_clock(scans, NOMINAL, None)
    assert proposal is not None
    assert proposal.clock.begin_rad is None
    for scan in scans:
        assert wrong_share(proposal.clock, scan) < 0.02


def test_a_late_first_point_does_not_move_the_beginning() -> None:
    """A sector without returns at the beginning of a sweep leaves the times of the other points as they are."""
    scans = [half(spun(0.0, True, seed)) for seed in range(4)]
    assert scans[3].times is not None
    late = scans[3].select(scans[3].times > 0.02)
    proposal = propose_clock([*scans[:3], late], NOMINAL, None)
    assert proposal is not None
    times, _ = proposal.clock.times_of(late.points)
    assert late.times is not None
    np.testing.assert_allclose(times, late.times, atol=0.002)


def test_a_scan_in_another_order_is_timed_by_azimuth_and_named() -> None:
    scans = [half(spun(45.0, False, seed)) for seed in range(3)]
    proposal = propose_clock(scans, NOMINAL, None)
    assert proposal is not None
    other = shuffled(scans[2])
    times, why = proposal.clock.times_of(other.points)
    assert "not in the order of those of the other scans" in why
    assert other.times is not None
    assert (np.abs(times - other.times) > 0.002).mean() < 0.02


def test_turns_reversal_and_stamps_at_the_end() -> None:
    scan = half(spun())
    proposal = azimuth_proposal([scan], NOMINAL)
    clock = proposal.clock
    times = clock.times_of(scan.points)[0]
    np.testing.assert_allclose(
        replace(clock, is_stamp_at_end=True).times_of(scan.points)[0], times - SECONDS, atol=1e-6
    )
    np.testing.assert_allclose(replace(clock, is_reversed=True).times_of(scan.points)[0], SECONDS - times, atol=1e-6)
    turned = replace(clock, turn=0.25).times_of(scan.points)[0]
    np.testing.assert_allclose(turned, np.mod(times + 0.25 * SECONDS, SECONDS), atol=1e-6)
    assert is_same_motion(clock, clock, scan.points)
    assert not is_same_motion(clock, replace(clock, turn=0.25), scan.points)
    assert not is_same_motion(clock, replace(clock, is_reversed=True), scan.points)


def test_a_crop_does_not_tell_where_in_its_gap_a_sweep_begins() -> None:
    scan = front(spun(180.0))
    clock = azimuth_proposal([scan], NOMINAL).clock
    assert is_same_motion(clock, replace(clock, turn=0.05), scan.points)
    assert not is_same_motion(clock, replace(clock, turn=0.5), scan.points)


def test_the_sentence_names_where_a_sweep_begins() -> None:
    clock = SweepClock("azimuth", SECONDS, sense=-1, begin_rad=np.pi)
    assert (
        str(clock) == "the azimuth of the points, clockwise, from azimuth -180 deg, 0.1 s a sweep, stamped at its start"
    )
    assert "from azimuth 90 deg" in str(replace(clock, turn=0.75))
    assert "counter-clockwise" in str(replace(clock, is_reversed=True))


def twice_the_rows(scan: Scan) -> Scan:
    """Every row twice, each after the other, as a driver with another resolution might write them."""
    return scan.select(np.arange(len(scan)).reshape(ROWS, COLUMNS).repeat(2, axis=0).ravel())


@pytest.mark.parametrize("change", [shuffled, twice_the_rows, lambda scan: scan.select(slice(None, None, -1))])
def test_columns_of_another_layout_are_timed_by_azimuth_and_named(change: object) -> None:
    """64 rows divide the points of 128 rows too: what columns they would make does not turn evenly."""
    scans = [rows_first(spun(45.0, True, seed)) for seed in range(3)]
    proposal = propose_clock(scans, NOMINAL, None)
    assert proposal is not None
    assert proposal.clock.kind == "columns"
    other = change(scans[2])  # type: ignore[operator]
    times, why = proposal.clock.times_of(other.points)
    assert why == "its columns do not turn as those of the other scans: the azimuth of each instead"
    assert other.times is not None
    assert (np.abs(times - other.times) > 0.002).mean() < 0.02
