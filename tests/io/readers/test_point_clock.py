"""Per-point times that are wrong here and there, scans that break the rule of their recording, and names that deceive."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import START_NS, STEP_NS, bag, raw_cloud
from numpy.typing import NDArray

from lslam.core.types.sequence import Sequence
from lslam.io.formats.point_files import write_bin
from lslam.io.readers import open_sequence
from lslam.odometry.frontend.register_scans import sweep_of
from lslam.pipeline.convert.bag_writer import BagWriter

N, COUNT = 1600, 12
SECONDS = np.linspace(0, 0.0999, N)
RINGS = np.arange(N) % 16
XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
Rows = NDArray[Any]


def sweep(kind: str, unit: float = 1.0, begin: float = 0.0, name: str = "time") -> Rows:
    """A turn of 16 beams, point after point, its times from `begin`, s, in s / `unit`."""
    rows = np.zeros(N, [*XYZ, ("ring", "<u2"), (name, kind)])
    azimuth, elevation = -2 * np.pi * SECONDS / 0.1, np.radians(2.0 * RINGS - 15)
    rows["x"], rows["y"] = 20 * np.cos(azimuth), 20 * np.sin(azimuth)
    rows["z"], rows["ring"] = 20 * np.tan(elevation), RINGS
    values = (begin + SECONDS) / unit
    rows[name] = np.round(values) if "f" not in kind else values
    return rows


def recording(folder: Path, rows_of: Callable[[int], Rows], count: int = COUNT) -> Sequence:
    def fill(writer: BagWriter) -> None:
        for k in range(count):
            stamp = START_NS + k * STEP_NS
            writer.write("/points", stamp, raw_cloud(writer.store, stamp, rows_of(k)))

    return open_sequence(bag(folder / "a.bag", fill))


def begin_s(k: int) -> float:
    return START_NS * 1e-9 + 0.1 * k


def check_sound(sequence: Sequence, indices: range, atol: float = 1e-6) -> None:
    for k in indices:
        scan = sequence.scan(k)
        assert scan.fault == ""
        assert scan.times is not None
        np.testing.assert_allclose(1e-9 * (scan.stamp_ns - START_NS - k * STEP_NS) + scan.times, SECONDS, atol=atol)


@pytest.mark.parametrize("padding", [200, 2 * N])
@pytest.mark.parametrize("first", [0, 5])
def test_padded_points_have_no_say(tmp_path: Path, first: int, padding: int) -> None:
    """Nor where they are most of the points."""

    def rows(k: int) -> Rows:
        table = sweep("<f8", begin=begin_s(k))
        return np.concatenate([table, np.zeros(padding, table.dtype)]) if k >= first else table

    sequence = recording(tmp_path, rows)
    assert not sequence.problems
    assert any(
        f"{padding / (N + padding):.1%} of the points of a scan are no returns" in note for note in sequence.notes
    ), sequence.notes
    for k in range(COUNT):
        scan = sequence.scan(k)
        assert scan.times is not None
        assert abs(scan.stamp_ns - START_NS - k * STEP_NS) < 1000
        np.testing.assert_allclose(scan.times[:N], SECONDS, atol=1e-6)
        assert scan.span.seconds == pytest.approx(0.0999, abs=1e-5)
        assert scan.fault == ""


@pytest.mark.parametrize("is_early", [False, True], ids=["later", "first"])
def test_unsigned_times_that_ran_below_zero_are_read_below_zero(tmp_path: Path, is_early: bool) -> None:
    def rows(k: int) -> Rows:
        table = sweep("<u4", 1e-9)
        if (k < 2) == is_early:
            table["time"][:16] = (table["time"][:16].astype(np.int64) - 3_000_000) % 2**32
        return table

    sequence = recording(tmp_path, rows)
    assert not sequence.problems
    for k in range(COUNT):
        scan = sequence.scan(k)
        expected = SECONDS - np.where((np.arange(N) < 16) & ((k < 2) == is_early), 0.003, 0)
        assert scan.times is not None
        np.testing.assert_allclose(scan.times, expected, atol=1e-6)
        assert scan.stamp_ns == START_NS + k * STEP_NS
        assert ("16 points ran over the bits of field 'time'" in scan.fault) == ((k < 2) == is_early)


def test_a_low_word_that_wraps_within_a_scan_is_read_on(tmp_path: Path) -> None:
    """The low 32 bits of a clock in ns: scans 7 and 50 hold the wrap."""
    begin = 2**32 - 740_000_000
    sequence = recording(
        tmp_path,
        lambda k: _with(
            sweep("<u4", 1e-9), time=(begin + k * STEP_NS + np.round(SECONDS * 1e9).astype(np.int64)) % 2**32
        ),
    )
    for k in range(COUNT):
        scan = sequence.scan(k)
        assert scan.times is not None
        np.testing.assert_allclose(scan.times, SECONDS, atol=1e-6)
        assert bool(scan.fault) == (k == 7)


@pytest.mark.parametrize(("kind", "unit", "ns"), [("<u4", 1e-9, 1), ("<f4", 1e-3, 1e6)])
def test_a_sequence_says_by_which_rule_it_reads_times(kind: str, unit: float, ns: float, tmp_path: Path) -> None:
    rule = recording(tmp_path, lambda k: sweep(kind, unit), 3).time_rule  # type: ignore[attr-defined]
    assert (rule.field, rule.ns_per_unit, rule.is_absolute) == ("time", ns, False)
    assert rule.sweep_s == pytest.approx(0.0999, rel=1e-3)
    (tmp_path / "scans").mkdir()
    write_bin(tmp_path / "scans" / "0.bin", np.ones((9, 3)))
    assert open_sequence(tmp_path / "scans").time_rule is None  # type: ignore[attr-defined]


def _with(rows: Rows, **columns: Any) -> Rows:
    for name, values in columns.items():
        rows[name] = values
    return rows


@pytest.mark.parametrize("wrong", [np.nan, 1e9, -5.0, 3.0])
@pytest.mark.parametrize("first", [0, 6])
def test_points_with_a_wrong_time_are_left_out_and_that_is_said(tmp_path: Path, wrong: float, first: int) -> None:
    at = np.arange(3, N, 40)
    sequence = recording(
        tmp_path, lambda k: _with(sweep("<f4"), time=np.where(np.isin(np.arange(N), at) & (k >= first), wrong, SECONDS))
    )
    assert not sequence.problems
    kept = ~np.isin(np.arange(N), at)
    for k in range(first, COUNT):
        scan = sequence.scan(k)
        np.testing.assert_array_equal(scan.rings, RINGS[kept])
        np.testing.assert_allclose(scan.times, SECONDS[kept], atol=1e-6)
        assert scan.fault == f"{len(at)} of {N} points have times outside the sweep and are left out"
    check_sound(sequence, range(first))


@pytest.mark.parametrize("step_s", [37.0, -37.0, 0.4, -0.4, 0.128, -0.128, 0.07])
@pytest.mark.parametrize("order", ["fired", "ring after ring"])
def test_a_clock_that_is_set_within_a_scan_is_read_on(tmp_path: Path, step_s: float, order: str) -> None:
    """For two thirds of scan 8 and all later ones the clock is another: header stamps are taken for right here."""

    def rows(k: int) -> Rows:
        table = sweep("<f8", begin=begin_s(k))
        table["time"] += step_s * ((k > 8) | ((k == 8) & (SECONDS > 0.033)))
        return table if order == "fired" else table[np.argsort(RINGS, kind="stable")]

    scan = recording(tmp_path, rows).scan(8)
    expected = SECONDS if order == "fired" else SECONDS[np.argsort(RINGS, kind="stable")]
    assert len(scan) == N
    assert scan.times is not None
    # One step between two points is lost.
    np.testing.assert_allclose(scan.times, expected, atol=1e-4)
    assert scan.fault == "the clock of the points was set within the sweep and is read on as before"
    assert abs(scan.stamp_ns - START_NS - 8 * STEP_NS) < 1000


@pytest.mark.parametrize("order", [1, -1])
def test_packets_lost_within_a_scan_are_no_step_of_the_clock(tmp_path: Path, order: int) -> None:
    """A driver that counts packets makes such a scan longer, whether the last points come last or first."""

    def rows(k: int) -> Rows:
        table = sweep("<f8", begin=begin_s(k))
        table["time"] += 0.03 * ((k == 8) & (SECONDS > 0.033))
        return table[::order].copy()

    scan = recording(tmp_path, rows).scan(8)
    assert scan.fault == ""
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, (SECONDS + 0.03 * (SECONDS > 0.033))[::order], atol=1e-6)


@pytest.mark.parametrize("name", ["time", "timestamp"])
@pytest.mark.parametrize("kind", ["low, high", "seconds, nanoseconds", "high, low", "double"])
def test_times_of_two_words(tmp_path: Path, name: str, kind: str) -> None:
    """Of 32 bits each, of any meaning; the low word of ns wraps within scan 4."""
    start = ((START_NS >> 32) + 1 << 32) - 4 * STEP_NS - STEP_NS // 2

    def rows(k: int) -> Rows:
        table = sweep("<u4", 1e-9)
        ns = (start + k * STEP_NS + np.round(SECONDS * 1e9)).astype(np.uint64)
        words = {
            "low, high": [ns & 0xFFFFFFFF, ns >> 32],
            "high, low": [ns >> 32, ns & 0xFFFFFFFF],
            "seconds, nanoseconds": [ns // 10**9, ns % 10**9],
            "double": list((ns * 1e-9).view("<u4").reshape(-1, 2).T),
        }[kind]
        pairs = np.zeros(N, [*XYZ, ("ring", "<u2"), (name, "<u4", (2,))])
        for column in ("x", "y", "z", "ring"):
            pairs[column] = table[column]
        pairs[name] = np.stack(words, axis=1)
        return pairs

    def fill(writer: BagWriter) -> None:
        for k in range(COUNT):
            stamp = start + k * STEP_NS
            table = rows(k)
            flat = table.view([*XYZ, ("ring", "<u2"), (name, "<u4"), ("more", "<u4")])
            message = raw_cloud(writer.store, stamp, flat)
            message.fields = message.fields[:-1]
            message.fields[-1].count = 2
            writer.write("/points", stamp, message)

    sequence = open_sequence(bag(tmp_path / "a.bag", fill))
    assert not sequence.problems
    for k in range(COUNT):
        scan = sequence.scan(k)
        assert scan.times is not None
        np.testing.assert_allclose(1e-9 * (scan.stamp_ns - start - k * STEP_NS) + scan.times, SECONDS, atol=1e-6)
        assert scan.fault == ""


Change = Callable[[Rows], Rows]
BREAKS: dict[str, tuple[Change, str, bool]] = {
    # what the scan is, what is said of it, whether it has times all the same
    "no field": (lambda t: t[["x", "y", "z", "ring"]].copy(), "has no field 'time'", False),
    "zeros": (lambda t: _with(t, time=0), "field 'time' does not hold times as in the other scans", False),
    "other unit": (
        lambda t: _with(t, time=SECONDS * 1e6), "per-point times from field 'time' (float32), us, since scan start", True,
    ),
    "other field": (
        lambda t: _renamed(t, "time", "t"), "has no field 'time', unlike the others: per-point times from field 't'", True,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["zero", "stamp of the scan"])
def test_a_field_that_nobody_filled_in_is_none(tmp_path: Path, kind: str) -> None:
    """The order of the points may tell their times then, as without the field."""
    sequence = recording(tmp_path, lambda k: _with(sweep("<f8"), time=0 if kind == "zero" else begin_s(k)))
    assert not sequence.problems
    assert "fields of the points: x, y, z, ring; not read: time" in sequence.notes
    assert "no point times: time holds one value for all points of a scan" in sequence.notes
    assert sequence.scan(3).times is None
    np.testing.assert_array_equal(sequence.stamps_ns, START_NS + STEP_NS * np.arange(COUNT))


def _renamed(rows: Rows, old: str, new: str) -> Rows:
    names = tuple(new if name == old else name for name in rows.dtype.names or ())
    changed: Rows = rows.copy()
    changed.dtype.names = names
    return changed


@pytest.mark.parametrize("broken", [0, 7])
@pytest.mark.parametrize("name", BREAKS)
def test_a_scan_that_breaks_the_rule_is_treated_by_itself(tmp_path: Path, name: str, broken: int) -> None:
    change, words, has_times = BREAKS[name]
    sequence = recording(tmp_path, lambda k: change(sweep("<f4")) if k == broken else sweep("<f4"))
    assert not sequence.problems
    check_sound(sequence, range(broken))
    check_sound(sequence, range(broken + 1, COUNT))
    scan = sequence.scan(broken)
    assert words in scan.fault
    assert len(scan) == N
    assert (scan.times is not None) == has_times
    if scan.times is not None:
        np.testing.assert_allclose(scan.times, SECONDS, atol=1e-6)
    span = sweep_of(sequence)
    assert span is not None
    assert span.seconds == pytest.approx(0.0999, abs=1e-4)


@pytest.mark.parametrize("share", [0.05, 0.02, 0.005])
@pytest.mark.parametrize("kind", ["offsets", "to the end", "absolute"])
def test_a_sliver_at_the_beginning_teaches_nothing(tmp_path: Path, share: float, kind: str) -> None:
    """The end of a sweep is the first message: unit, reference and stamps are those of the others."""
    late_s = 0.1 if kind == "to the end" else 0.0

    def rows(k: int) -> Rows:
        table = sweep("<f8", begin=begin_s(k) if kind == "absolute" else -late_s)
        return table[(1 - share) * 0.1 < SECONDS] if k == 0 else table

    def fill(writer: BagWriter) -> None:
        for k in range(COUNT):
            stamp = START_NS + k * STEP_NS + round(1e9 * late_s)
            writer.write("/points", stamp, raw_cloud(writer.store, stamp, rows(k)))

    sequence = open_sequence(bag(tmp_path / "a.bag", fill))
    assert not sequence.problems
    check_sound(sequence, range(1, COUNT))
    np.testing.assert_allclose(sequence.stamps_ns[1:], START_NS + STEP_NS * np.arange(1, COUNT), atol=1000)
    first = sequence.scan(0)
    assert first.times is not None
    assert first.fault == ""
    expected = SECONDS[(1 - share) * 0.1 < SECONDS]
    np.testing.assert_allclose(1e-9 * (first.stamp_ns - START_NS) + first.times, expected, atol=1e-6)
    span = sweep_of(sequence)
    assert span is not None
    assert span.seconds > 0.09
