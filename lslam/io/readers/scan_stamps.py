"""Stamps of scan files: from a file, from their names in any unit, or from their points' times, checked against each other."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lslam.core.arrays import Longs, Stamps
from lslam.core.errors import InputError
from lslam.core.untrusted import whole_number
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.text_tables import read_rows
from lslam.io.readers.clocks import Clock, agree, onto, say_jitter, stands_still
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.listing import check_stamps, file_numbers, filled_stamps, load_stamps, rows_of
from lslam.io.readers.point_clock import PointStamps, point_stamps

_STEP = 1.5  # median intervals, from which on a gap is held against other clocks
_NEAR = 0.25  # of the interval, how far a gap may lie from whole ones

_UNITS = {"nanoseconds": 1, "microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}
_EARLIEST_NS, _LATEST_NS = 10**17, 41 * 10**17  # 1973, where seconds have nine digits, to 2099
_DATE = re.compile(
    r"(?<!\d)(\d{4})([-_]?)(\d\d)\2(\d\d)[T _-]?(\d\d)([-_:.]?)(\d\d)\6(\d\d)(?:[.,_-]?(\d{1,9}))?"
    r"(Z|[+-]\d\d:?\d\d)?(?!\d)"
)
# Numbers that lie so far apart count no scans; in their unit scans follow each other at 1 to 100 Hz.
_NO_COUNT = 10_000
_SHORTEST_NS, _LONGEST_NS, _MINUTE_NS = 10**7, 10**9, 60 * 10**9
_CLEARLY = 0.5


class StampedScans(NamedTuple):
    """Scan files in the order of their increasing stamps (N,), ns, their rate, Hz, and the stamps before corrections."""

    files: list[Path]
    stamps_ns: Stamps
    rate_hz: float
    raw_ns: Stamps


def stamp_scans(
    files: list[Path],
    path: Path | None,
    read: Callable[[Path], PointCloud],
    rate_hz: float | None,
    beside: Sequence[Stamps],
    voice: Voice,
) -> StampedScans | None:
    """Stamp the scans by the file `path`, else by their names, else by their points; None if none of these has times.

    read : the points of a file; beside : stamps of other streams, one of which overlaps the scans in time

    A clock that goes back, is constant or steps is replaced by the next one that contradicts it, with a note. Raises
    InputError when the file's rows cannot be matched with the scans.
    """
    by_name, words = _stamps_by_name(files, voice)
    files = sorted(files, key=lambda file: by_name.get(file, 0))
    clocks: list[Clock] = []
    points: PointStamps | None = None
    own = None if path is None else load_stamps(path, voice.problems)
    if path is not None and own is not None:
        try:
            files, own = rows_of_scans(path, own, files, voice)
            clocks, words = [Clock(str(path), own)], path.name
        except InputError as error:
            points = None if by_name else point_stamps(files, read, rate_hz)
            if not by_name and points is None:
                raise
            voice.problems.append(f"stamps are not used: {error}")
    if by_name:
        clocks.append(Clock("the stamps in the file names", np.array([by_name[file] for file in files], np.int64)))
    if not clocks or _is_suspicious(clocks[0].stamps_ns):
        points = points or point_stamps(files, read, rate_hz)
    if points is not None:
        clocks.append(Clock(f"the absolute times of the points, field {points.field!r},", points.stamps_ns))
    if not clocks:
        return None
    voice.notes.append(f"scan stamps from {words or clocks[0].name.rstrip(',')}")
    agreed, raw = _agreement(clocks, voice), clocks[0].stamps_ns
    for stamps in beside[:1]:
        agreed = onto(stamps, raw, agreed)
    source = clocks[0].name if clocks[0].name == str(path) else files[0].parent
    checked, rate = check_stamps(agreed, rate_hz, source, voice.problems)
    if points is not None and rate_hz is None and rate * points.sweep_s < 0.5:
        rate = round(1 / points.sweep_s, 1)
        voice.notes.append(f"scans lie farther apart than sweeps of {points.sweep_s:.3g} s last: rate {rate:g} Hz")
    say_jitter(checked, "scans", voice)
    return StampedScans(files, checked, rate, raw)


def _stamps_by_name(files: list[Path], voice: Voice) -> tuple[dict[Path, int], str]:
    """Stamps, ns, by file name, empty for names without them, and their format in words."""
    names = stamps_in_names(files)
    if names is None:
        return {}, ""
    if names.stamps_ns is None:
        voice.problems.append(f"stamps in the file names are not used: as {names.words} they repeat")
        return {}, ""
    stamps = dict(zip(files, names.stamps_ns.tolist(), strict=True))
    return stamps, f"the file names: {names.words}, as in {min(files, key=stamps.__getitem__).name}"


def _agreement(clocks: list[Clock], voice: Voice) -> Stamps:
    """First clock with its faults corrected by the others; if that fails, the next one that increases."""
    first, *others = clocks
    stamps = first.stamps_ns
    for other in others:
        if np.any(np.diff(other.stamps_ns) <= 0):
            continue
        if stands_still(stamps, other.stamps_ns):
            voice.problems.append(f"{first.name}: its stamps stand still: {other.name} are used")
            return other.stamps_ns
        stamps = agree(stamps, np.zeros_like(stamps), other, first.name, Voice([], voice.problems))
        if np.any(np.diff(stamps) <= 0):
            voice.problems.append(f"{first.name}: its stamps do not increase: {other.name} are used")
            return other.stamps_ns
    return stamps


def _is_suspicious(stamps: Stamps) -> bool:
    """Whether stamps (N,) fail to increase somewhere, or have a gap."""
    steps = np.diff(stamps)
    return bool(len(steps)) and bool((steps <= 0).any() or steps.max() > _STEP * np.median(steps))


def rows_of_scans(path: Path, stamps: Stamps, files: list[Path], voice: Voice) -> tuple[list[Path], Stamps]:
    """Scans that have a stamp in the file `path`, and these stamps.

    Rows are matched by a column of names or numbers, by the numbers in the file names, or by the gaps that lost rows leave.
    Raises InputError when the counts differ and no match is found.
    """
    count = len(files)
    counts = f"{path} has {len(stamps)} {'times' if path.stem == 'times' else 'stamps'} for {count} scans"
    rows = _rows_by_name(path, files, len(stamps))
    if rows is not None:
        without = np.count_nonzero(rows < 0)
        if without or len(stamps) != count:
            voice.problems.append(f"{counts}: they go together by name, {without} scans without one are left out")
    elif len(stamps) == count:
        return files, stamps
    else:
        filled = _fill_gaps(stamps, count)
        if filled is not None:
            voice.problems.append(
                f"{counts}: the lost rows leave gaps of whole intervals, which hold just the {count - len(stamps)} scans "
                "without one; their stamps follow from the rows beside"
            )
            return files, filled
        rows, rule = rows_of(files, len(stamps))
        # Rows that were lost from the middle would leave a gap.
        is_gapless = 1 < len(stamps) < count and not _is_suspicious(stamps)
        if not rule.startswith("by the number") and not is_gapless:
            raise InputError(
                f"{counts}, and neither numbers, names nor gaps tell which belong together: add or remove rows, put the "
                "scans' names in a column, or remove the file for stamps at a constant rate"
            )
        voice.problems.append(f"{counts}: the {np.count_nonzero(rows >= 0)} common ones are used, {rule}")
    return [file for file, row in zip(files, rows.tolist(), strict=True) if row >= 0], stamps[rows[rows >= 0]]


def _rows_by_name(path: Path, files: list[Path], count: int) -> Longs | None:
    """(N,) row of each file, -1 for none, by a column of file names or numbers; None without such a column."""
    cells = [row.text.replace(",", " ").replace(";", " ").split() for row in read_rows(path)[0]][-count:]
    if len(cells) != count or min(map(len, cells)) < 2:
        return None
    columns = list(zip(*cells, strict=False))
    names, stems, numbers = [file.name for file in files], [file.stem for file in files], file_numbers(files)
    candidates: list[tuple[list[Any], list[Any]]] = []
    for column in columns:
        texts = [Path(text).name for text in column]
        candidates += [(names, texts), (stems, texts)]
    if numbers is not None:
        candidates.append((numbers.tolist(), [whole_number(text) for text in columns[0]]))
    for labels, texts in candidates:
        row_of = {text: k for k, text in enumerate(texts)}
        if len(row_of) == count and len(row_of.keys() & set(labels)) > 0.5 * min(count, len(labels)):
            return np.array([row_of.get(label, -1) for label in labels], np.int64)
    return None


def _fill_gaps(stamps: Stamps, count: int) -> Stamps | None:
    """(count,) ns: `stamps` with missing ones interpolated, if their gaps fit exactly the missing number of scans; else None."""
    steps = np.diff(stamps).astype(np.float64)
    if len(stamps) >= count or len(steps) < 2 or steps.min() <= 0:
        return None
    step = float(np.median(steps))
    whole = np.rint(steps / step)
    if np.abs(steps / step - whole).max() > _NEAR or len(stamps) + int((whole - 1).sum()) != count:
        return None
    return filled_stamps(np.arange(count), np.concatenate([[0], np.cumsum(whole)]), stamps)


class NameStamps(NamedTuple):
    """Stamps (N,), ns, of the files in order, and the format of the names in words; `stamps` is None if they repeat."""

    stamps_ns: Stamps | None
    words: str


def stamps_in_names(files: list[Path]) -> NameStamps | None:
    """Stamps of scan files by their names: dates, or one number since 1970 in s, ms, us or ns, or seconds and their fraction.

    Other words and numbers may precede or follow. None when the names have no times; of several readings, the first that is
    unique for every file is used.
    """
    stems = [path.stem for path in files]
    # No name holds a zero byte.
    shapes = {re.sub(r"\d+", "\0", stem) for stem in stems}
    readings = list(_dates(stems))
    if len(shapes) == 1:
        shape = shapes.pop()
        groups = [list(column) for column in zip(*(re.findall(r"\d+", stem) for stem in stems), strict=True)]
        readings += [*_pairs(groups, shape.split("\0")[1:-1]), *_numbers(groups)]
    for stamps, words in readings:
        if len(np.unique(stamps)) == len(stamps):
            return NameStamps(np.array(stamps, np.int64), words)
    return NameStamps(None, readings[0][1]) if readings else None


def _dates(stems: list[str]) -> Iterator[tuple[list[int], str]]:
    """Stamps (ns) by dates in all names, and a description; nothing if a name has none."""
    begins, fractions, counts = [], [], []
    for stem in stems:
        match = _DATE.search(stem)
        if match is None:
            return
        year, _, month, day, hour, separator, minute, second, fraction, zone = match.groups()
        try:
            begin = datetime.fromisoformat(f"{year}-{month}-{day}T{hour}:{minute}:{second}{zone or 'Z'}")
        except ValueError:
            return
        begins.append(int(begin.timestamp()) * 10**9)
        fractions.append(fraction or "")
        counts.append("".join((hour, separator, minute, second)))
    # A number behind the day, or behind the second, that counts the files is none of the time.
    if all(count.isdigit() and count.startswith("0000") for count in counts) and _counts(counts):
        return
    if all(fractions) and _counts(fractions):
        fractions = [""] * len(fractions)
    stamps = [begin + int(fraction.ljust(9, "0")) for begin, fraction in zip(begins, fractions, strict=True)]
    if min(stamps) >= _EARLIEST_NS and max(stamps) <= _LATEST_NS:
        yield stamps, "dates, UTC where they state no other zone"


def _pairs(groups: list[list[str]], between: list[str]) -> Iterator[tuple[list[int], str]]:
    """Readings of two successive numbers as seconds and their fraction, each with a description; between : separators."""
    for (whole, rest), separator in zip(pairwise(groups), between, strict=True):
        lengths = {len(text) for text in rest}
        if separator not in tuple("._-,") or max(lengths) > 9 or max(map(len, whole)) > 10 or _counts(rest):
            continue
        decimals = [int(a) * 10**9 + int(b.ljust(9, "0")) for a, b in zip(whole, rest, strict=True)]
        unit = min((n for n in _UNITS if n != "seconds"), key=lambda n: _unevenness(_in_unit(whole, rest, _UNITS[n])))
        units = _in_unit(whole, rest, _UNITS[unit])
        a, b = _unevenness(decimals), _unevenness(units)
        is_decimal = a < b if min(a, b) < _CLEARLY * max(a, b) else max(lengths) < 9
        if len(lengths) == 1:
            stamps, words = decimals, f"seconds and {len(rest[0])} decimals"
        elif is_decimal or any(text[0] == "0" and text != "0" for text in rest):
            stamps, words = decimals, "decimal seconds"
        else:
            stamps, words = units, f"seconds and {unit} without leading zeros"
        if _is_time(whole, 10**9):
            yield stamps, words
        elif len(groups) == 2 and (
            lengths == {9} or (separator == "." and len(set(rest)) > 1 and min(a, b) < _CLEARLY and _is_rate(stamps))
        ):
            yield stamps, f"{words} of a clock that began elsewhere"


def _in_unit(whole: list[str], rest: list[str], unit_ns: int) -> list[int]:
    """Stamps, ns, of whole seconds and their fractions in a unit of `unit_ns`."""
    return [int(a) * 10**9 + int(b) * unit_ns for a, b in zip(whole, rest, strict=True)]


def _numbers(groups: list[list[str]]) -> list[tuple[list[int], str]]:
    """Readings of one number as a time since 1970 or of another clock, in any unit, each with a description."""
    since_1970 = [
        ([int(text) * scale for text in texts], f"{unit} since 1970")
        for unit, scale in _UNITS.items()
        for texts in groups
        if _is_time(texts, scale) and (len(texts) == 1 or len(set(texts)) > 1)
    ]
    varying = [texts for texts in groups if len(set(texts)) > 1]
    others: list[tuple[list[int], str]] = []
    if len(varying) == 1 and len(varying[0]) > 2 and max(map(len, varying[0])) < 19:
        values = [int(text) for text in varying[0]]
        for unit, scale in _UNITS.items():
            stamps = [value * scale for value in values]
            if _step_ns(values) >= _NO_COUNT and max(stamps) < _EARLIEST_NS and _is_rate(stamps):
                others.append((stamps, f"{unit} of a clock that began elsewhere"))
    # Scans hardly lie more than a minute apart.
    return sorted([*since_1970, *others], key=lambda reading: _step_ns(reading[0]) > _MINUTE_NS)


def _is_time(texts: list[str], scale: int) -> bool:
    """Whether all numbers, times `scale` in ns, are plausible times since 1970."""
    return all(len(text) < 20 and _EARLIEST_NS <= int(text) * scale <= _LATEST_NS for text in texts)


def _counts(texts: list[str]) -> bool:
    """Whether numbers merely count the files."""
    return len(texts) > 2 and bool((np.diff([int(text) for text in texts]) == 1).all())


def _step_ns(stamps: list[int]) -> float:
    """Median interval, ns; 0 for a single stamp."""
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) if len(stamps) > 1 else 0.0


def _is_rate(stamps: list[int]) -> bool:
    """Whether the median interval of stamps, ns, can be a scan period."""
    return _SHORTEST_NS <= _step_ns(stamps) <= _LONGEST_NS


def _unevenness(stamps: list[int]) -> float:
    """Mean deviation of the intervals from their median, relative to the median."""
    steps = np.diff(np.sort(np.array(stamps, np.int64))).astype(np.float64)
    middle = float(np.median(steps)) if len(steps) else 0.0
    return float(np.mean(np.abs(steps - middle))) / middle if middle > 0 else np.inf
