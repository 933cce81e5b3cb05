"""Stamps of scan files: their own file, their names and the times of their points, held against each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.untrusted import whole_number
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.text_tables import read_rows
from lslam.io.readers.clocks import Clock, agree, onto, say_jitter, stands_still
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.listing import check_stamps, file_numbers, filled_stamps, load_stamps, rows_of
from lslam.io.readers.name_stamps import stamps_in_names
from lslam.io.readers.point_stamps import PointStamps, point_stamps

Stamps = NDArray[np.int64]
_STEP = 1.5  # median intervals, from which on a gap is held against other clocks
_NEAR = 0.25  # of the interval, how far a gap may lie from whole ones


class StampedScans(NamedTuple):
    """Scan files in the order of their stamps (N,) ns, which increase, their rate, Hz, and the stamps before they were mended."""

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
    """The scans with the stamps of the file `path`, else those in their names, else by their points; None without any.

    read : the points of a file; beside : stamps of other streams, with one of which the scans share time

    A clock that goes back, stands still or steps gives way to the next one that contradicts it, which is said. Raises
    InputError when the file has another number of rows than there are scans and nothing tells which belong together.
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
    agreed, raw = _agreed(clocks, voice), clocks[0].stamps_ns
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
    """The stamps, ns, in the names of the files, none where they hold none, and what they are in words."""
    names = stamps_in_names(files)
    if names is None:
        return {}, ""
    if names.stamps_ns is None:
        voice.problems.append(f"stamps in the file names are not used: as {names.words} they repeat")
        return {}, ""
    stamps = dict(zip(files, names.stamps_ns.tolist(), strict=True))
    return stamps, f"the file names: {names.words}, as in {min(files, key=stamps.__getitem__).name}"


def _agreed(clocks: list[Clock], voice: Voice) -> Stamps:
    """The first clock with its faults mended by the others; the next that increases where it cannot be."""
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
    steps = np.diff(stamps)
    return bool(len(steps)) and bool((steps <= 0).any() or steps.max() > _STEP * np.median(steps))


def rows_of_scans(path: Path, stamps: Stamps, files: list[Path], voice: Voice) -> tuple[list[Path], Stamps]:
    """The scans that have a stamp in the file `path`, and these: by a column of names or numbers, by the numbers in the file
    names, or by the gaps that lost rows leave.

    Raises InputError when the counts differ and nothing tells.
    """
    count = len(files)
    counts = f"{path} has {len(stamps)} {'times' if path.stem == 'times' else 'stamps'} for {count} scans"
    rows = _labelled(path, files, len(stamps))
    if rows is not None:
        without = np.count_nonzero(rows < 0)
        if without or len(stamps) != count:
            voice.problems.append(f"{counts}: they go together by name, {without} scans without one are left out")
    elif len(stamps) == count:
        return files, stamps
    else:
        filled = _filled_gaps(stamps, count)
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


def _labelled(path: Path, files: list[Path], count: int) -> NDArray[np.int64] | None:
    """(N,) row of each file, -1 for none, by a column that names the files or their numbers; None when there is no such one."""
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


def _filled_gaps(stamps: Stamps, count: int) -> Stamps | None:
    """(count,) ns: `stamps`, in whose gaps just as many scans fit as have no row, evenly; else None."""
    steps = np.diff(stamps).astype(np.float64)
    if len(stamps) >= count or len(steps) < 2 or steps.min() <= 0:
        return None
    step = float(np.median(steps))
    whole = np.rint(steps / step)
    if np.abs(steps / step - whole).max() > _NEAR or len(stamps) + int((whole - 1).sum()) != count:
        return None
    return filled_stamps(np.arange(count), np.concatenate([[0], np.cumsum(whole)]), stamps)
