"""Stamps of scan files: their own file, their names and the times of their points, held against each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.point_cloud import PointCloud
from lslam.formats.pose_rows import read_rows
from lslam.readers.clocks import Clock, agree, jitter_notes, onto, stands_still
from lslam.readers.ground_truth import Voice
from lslam.readers.listing import check_stamps, file_numbers, load_stamps, rows_of
from lslam.readers.name_stamps import stamps_in_names
from lslam.readers.point_stamps import PointStamps, point_stamps
from lslam.untrusted import whole_number

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
    files, clocks, words = _named(files, voice)
    own = None if path is None else _own_clock(path, files, read, bool(clocks), voice)
    if own is not None:
        have, clock = own
        files = [file for file, has in zip(files, have, strict=True) if has]
        clocks = [clock, *(Clock(c.name, c.stamps_ns[have]) for c in clocks)]
        words = clock.name.rsplit("/", 1)[-1]
    points = None
    if not clocks or _is_suspicious(clocks[0].stamps_ns):
        points = _points(files, read, rate_hz)
        if points is not None:
            clocks.append(Clock(f"the absolute times of the points, field {points.field!r},", points.stamps_ns))
            words = words or clocks[0].name.rstrip(",")
    if not clocks:
        return None
    voice.notes.append(f"scan stamps from {words}")
    source = clocks[0].name if own is not None else files[0].parent
    agreed, raw = _agreed(clocks, voice), clocks[0].stamps_ns
    for stamps in beside[:1]:
        agreed = onto(stamps, raw, agreed)
    checked, rate = check_stamps(agreed, rate_hz, source, voice.problems)
    if points is not None and rate_hz is None and rate * points.sweep_s < 0.5:
        rate = round(1 / points.sweep_s, 1)
        voice.notes.append(f"scans lie farther apart than sweeps of {points.sweep_s:.3g} s last: rate {rate:g} Hz")
    voice.notes.extend(jitter_notes(checked, "scans"))
    return StampedScans(files, checked, rate, raw)


def _named(files: list[Path], voice: Voice) -> tuple[list[Path], list[Clock], str]:
    """The files in the order of the stamps in their names, these stamps, and what they are in words."""
    names = stamps_in_names(files)
    if names is None:
        return files, [], ""
    if names.stamps_ns is None:
        voice.problems.append(f"stamps in the file names are not used: as {names.words} they repeat")
        return files, [], ""
    order = np.argsort(names.stamps_ns, kind="stable")
    files = [files[k] for k in order]
    return (
        files,
        [Clock("the stamps in the file names", names.stamps_ns[order])],
        (f"the file names: {names.words}, as in {files[0].name}"),
    )


def _own_clock(
    path: Path, files: list[Path], read: Callable[[Path], PointCloud], is_named: bool, voice: Voice
) -> tuple[NDArray[np.bool_], Clock] | None:
    """Which scans have a stamp in the file `path`, (N,) bool, and the stamps of these; None where other clocks are better."""
    stamps = load_stamps(path, voice.problems)
    if stamps is None:
        return None
    try:
        rows = rows_of_scans(path, stamps, files, voice)
    except InputError as error:
        if not is_named and _points(files, read, None) is None:
            raise
        voice.problems.append(f"stamps are not used: {error}")
        return None
    return rows.have, Clock(str(path), rows.stamps_ns)


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
        held = agree(stamps, np.zeros_like(stamps), other, first.name)
        voice.problems.extend(held.problems)
        stamps = held.stamps_ns
        if np.any(np.diff(stamps) <= 0):
            voice.problems.append(f"{first.name}: its stamps do not increase: {other.name} are used")
            return other.stamps_ns
    return stamps


def _is_suspicious(stamps: Stamps) -> bool:
    steps = np.diff(stamps)
    return bool(len(steps)) and bool((steps <= 0).any() or steps.max() > _STEP * np.median(steps))


def _points(files: list[Path], read: Callable[[Path], PointCloud], rate_hz: float | None) -> PointStamps | None:
    return point_stamps(len(files), lambda index: read(files[index]), rate_hz)


class Rows(NamedTuple):
    """Which scans have a stamp, (N,) bool, and the stamps of these, ns."""

    have: NDArray[np.bool_]
    stamps_ns: Stamps


def rows_of_scans(path: Path, stamps: Stamps, files: list[Path], voice: Voice) -> Rows:
    """The rows of a stamps file that belong to the scans: by a column of names or numbers, by the numbers in the file names, or
    by the gaps that lost rows leave.

    Raises InputError when the counts differ and nothing tells.
    """
    count = len(files)
    labelled = _labelled(path, files, len(stamps))
    whole = np.ones(count, bool)
    if labelled is None and len(stamps) == count:
        return Rows(whole, stamps)
    counts = f"{path} has {len(stamps)} stamps for {count} scans"
    if labelled is not None:
        have = labelled >= 0
        if not have.all() or len(stamps) != count:
            voice.problems.append(
                f"{counts}: they go together by name, {int((~have).sum())} scans without one are left out"
            )
        return Rows(have, stamps[labelled[have]])
    rows, rule = rows_of(files, len(stamps))
    steps = np.diff(stamps)
    is_gapless = len(stamps) < count and bool(len(steps)) and steps.min() > 0 and not _is_suspicious(stamps)
    if rule.startswith("by the number") or is_gapless:
        # Rows that were lost from the middle would leave a gap.
        have = rows >= 0
        voice.problems.append(f"{counts}: the {int(have.sum())} common ones are used, {rule}")
        return Rows(have, stamps[rows[have]])
    filled = _filled_gaps(stamps, count)
    if filled is None:
        raise InputError(
            f"{counts}, and neither numbers, names nor gaps tell which belong together: add or remove rows, put the scans' "
            "names in a column, or remove the file for stamps at a constant rate"
        )
    voice.problems.append(
        f"{counts}: the lost rows leave gaps of whole intervals, which hold just the {count - len(stamps)} scans without one; "
        "their stamps follow from the rows beside"
    )
    return Rows(whole, filled)


def _labelled(path: Path, files: list[Path], count: int) -> NDArray[np.int64] | None:
    """(N,) row of each file, -1 for none, by a column that names the files or their numbers; None when there is no such one."""
    rows, _ = read_rows(path)
    cells = [row.text.replace(",", " ").replace(";", " ").split() for row in rows][-count:]
    if len(cells) != count or min(map(len, cells)) < 2:
        return None
    numbers = file_numbers(files)
    for column in range(min(map(len, cells))):
        texts = [row[column] for row in cells]
        names: list[object] = [Path(text).name for text in texts]
        labels: list[object] = [file.name for file in files]
        if not set(names) & set(labels):
            labels = [file.stem for file in files]
        if numbers is not None and column == 0 and not set(names) & set(labels):
            names, labels = [whole_number(text) for text in texts], numbers.tolist()
            if None in names or any(b <= a for a, b in pairwise(names)):  # type: ignore[operator]
                continue
        if len(set(names)) == count and len(set(names) & set(labels)) > 0.5 * min(count, len(labels)):
            row_of = {name: k for k, name in enumerate(names)}
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
    at = np.concatenate([[0], np.cumsum(whole)])
    filled: Stamps = stamps[0] + np.rint(np.interp(np.arange(count), at, stamps - stamps[0])).astype(np.int64)
    return filled
