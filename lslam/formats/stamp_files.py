"""Text files of stamps, one scan a line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.text_tables import Row, read_rows, text_table
from lslam.formats.time_columns import find_clock
from lslam.remote import as_path


def read_times(path: str | Path) -> NDArray[np.int64]:
    """Stamps (N,) int64 ns that increase, as of KITTI's `times.txt`. Raises InputError for a file without any."""
    stamps = read_stamps(as_path(path), must_increase=True)
    if not len(stamps):
        raise InputError(f"{path} holds no times")
    return stamps


def read_stamps(path: Path, must_increase: bool = False) -> NDArray[np.int64]:
    """(N,) int64 ns of a text file, one stamp a line.

    The time is in the column that a header names, else in the first one or two; an index before it and columns behind it
    are left out. Seconds may be decimal or scientific (KITTI's times.txt), whole numbers of nanoseconds, or dates such as
    `2011-09-26 13:04:32.349659964` (KITTI raw, taken as UTC), which keep all nine digits.
    Raises InputError naming file and line.
    """
    rows, comments = read_rows(path)
    table = text_table(path, [Row(k, text) for k, line, _ in rows if (text := line.split("#")[0].strip())], comments)
    if not table.rows:
        return np.zeros(0, np.int64)
    clock = find_clock(table) or find_clock(replace(table, names=()))
    if clock is None:
        raise table.error(0, "no column is a time (s, ns or date)")
    if must_increase:
        table.check_increasing(clock.stamps_ns)
    return clock.stamps_ns
