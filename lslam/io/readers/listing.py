"""Scan files of a folder, their order, and the rows of stamp and pose files that belong to them."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Longs, Stamps
from lslam.core.errors import InputError, input_errors
from lslam.io.formats.point_files import SUFFIXES
from lslam.io.formats.time_columns import read_stamps

DEFAULT_RATE_HZ = 10.0


def list_scans(folder: Path, suffixes: tuple[str, ...] = SUFFIXES) -> tuple[list[Path], list[str]]:
    """Point files of the most frequent suffix in natural order (scan2 before scan10), and notes about the others."""
    with input_errors(folder):
        files = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    kinds = Counter(p.suffix.lower() for p in files)
    if not kinds:
        return [], []
    suffix = max(kinds, key=lambda s: (kinds[s], s == ".bin"))
    notes = [f"{n} *{s} files in {folder} are not scans: *{suffix} are" for s, n in kinds.items() if s != suffix]
    return sorted((p for p in files if p.suffix.lower() == suffix), key=natural_key), notes


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key of a file name with numbers compared as numbers."""
    parts = re.split(r"(\d+)", path.stem)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts]


def file_numbers(files: list[Path]) -> Longs | None:
    """The number in each name when all names are plain numbers below 1e9 (larger ones are times), else None."""
    if not all(re.fullmatch(r"0*\d{1,9}", p.stem) for p in files):
        return None
    return np.array([int(p.stem) for p in files], np.int64)


def rows_of(files: list[Path], count: int) -> tuple[Longs, str]:
    """Row of a file with `count` rows that belongs to each scan, -1 for none, and the rule in words.

    Scans in KITTI are numbered by row, and scans may be missing. If a number exceeds the rows, the i-th scan belongs
    to the i-th row.
    """
    numbers = file_numbers(files)
    if numbers is not None and len(numbers) and numbers[-1] < count and len(files) != count:
        return numbers, "by the number in the file name"
    rows = np.arange(len(files), dtype=np.int64)
    rows[rows >= count] = -1
    return rows, "by index"


def nominal_stamps(count: int, rate_hz: float, start_ns: int = 0) -> Stamps:
    """Stamps (count,), ns, at `rate_hz` from `start_ns`."""
    return start_ns + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def filled_stamps(numbers: NDArray[Any], at: NDArray[Any], stamps: Stamps) -> Stamps:
    """Stamps (N,), ns, of all scans `numbers`, from `stamps` (M,) of the scans `at`.

    Stamps in between are interpolated, others extrapolated by the median step.
    """
    steps = np.diff(stamps) / np.diff(at)
    step = float(np.median(steps)) if len(steps) else 0.0
    since = np.interp(numbers, at, stamps - stamps[0])
    since += step * (np.minimum(numbers - at[0], 0) + np.maximum(numbers - at[-1], 0))
    filled: Stamps = stamps[0] + np.rint(since).astype(np.int64)
    filled[np.isin(numbers, at)] = stamps
    return filled


def load_stamps(path: Path, problems: list[str]) -> Stamps | None:
    """Stamps of a text file; None, with the reason in `problems`, when it cannot be read."""
    try:
        stamps = read_stamps(path)
    except InputError as error:
        problems.append(f"stamps are not used: {error}")
        return None
    if not len(stamps):
        problems.append(f"stamps are not used: {path} is empty")
        return None
    return stamps


def check_stamps(
    stamps: Stamps, rate_hz: float | None, source: Path | str, problems: list[str]
) -> tuple[Stamps, float]:
    """Stamps if they increase, else nominal ones from the first, with a problem; and the rate, Hz, stated or measured."""
    steps = np.diff(stamps)
    rate = rate_hz or measured_rate(stamps)
    wrong = np.flatnonzero(steps <= 0)
    if not len(wrong):
        return stamps, rate
    word = "repeats" if steps[wrong[0]] == 0 else "goes back"
    problems.append(
        f"{source}: time {word} at line {wrong[0] + 2} ({len(wrong)} place{'s' if len(wrong) > 1 else ''}); "
        f"the nominal rate of {rate:g} Hz is used instead"
    )
    return nominal_stamps(len(stamps), rate, int(stamps[0])), rate


def measured_rate(stamps: Stamps) -> float:
    """Scan rate in Hz from the median of the positive steps, 10 when there is none."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if not len(steps):
        return DEFAULT_RATE_HZ
    rate = 1e9 / float(np.median(steps))
    return float(round(rate, 3)) or rate
