"""Time per scan and stage, from a run's `timing.csv`."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, input_errors
from lslam.io.remote import as_path

IMU_SAVING = "saved_s"
NOT_STAGES = ("index", "stamp_ns", "stamp", "total", IMU_SAVING)
# Before the names of what is done after odometry.
AFTER = "back end: "


@dataclass(frozen=True)
class TimingRows:
    """The columns of a file of N scans.

    stamps_ns : (N,) int64, None when the file has none; stages : (N,) seconds by name, in the order of the file
    total : (N,) seconds
    back_end : (N,) seconds by name, of what was done to a scan after odometry and does not count in `total`
    """

    stamps_ns: Longs | None
    stages: dict[str, Floats]
    total: Floats
    back_end: dict[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class StageTime:
    """Seconds per scan of one stage; `share` of the total time, 0..1."""

    median: float
    p95: float
    max: float
    mean: float
    share: float


@dataclass(frozen=True)
class Timing:
    """Time per scan of a run.

    stages : by name, in the order of the file; period : s between scans (the real-time limit), None when unknown
    over_limit : scans that took longer than `period`
    """

    source: str
    scans: int
    total: StageTime
    stages: dict[str, StageTime]
    period: float | None
    over_limit: int


def read_timing(path: str | Path) -> Timing:
    """Summarise a `timing.csv`. Raises InputError with file and line when it is missing, empty or holds no numbers."""
    rows = read_timing_rows(as_path(path))
    period = None
    if rows.stamps_ns is not None and len(rows.total) > 1:
        period = float(np.median(np.diff(rows.stamps_ns))) / 1e9
    whole = float(rows.total.sum())
    return Timing(
        source=str(path),
        scans=len(rows.total),
        total=summarise(rows.total, whole),
        stages={name: summarise(seconds, whole) for name, seconds in rows.stages.items()},
        period=period if period and period > 0 else None,
        over_limit=int((rows.total > period).sum()) if period and period > 0 else 0,
    )


def summarise(seconds: Floats, whole: float) -> StageTime:
    """Statistics of one stage (N,), s, of scans that took `whole` s in all."""
    median, p95 = (float(v) for v in np.percentile(seconds, [50, 95]))
    share = float(seconds.sum()) / whole if whole > 0 else 0.0
    return StageTime(median, p95, float(seconds.max()), float(seconds.mean()), share)


def read_timing_rows(path: Path) -> TimingRows:
    """Read columns `index`, `stamp_ns`, seconds per stage, `total` (their sum when absent).

    Raises InputError naming file and line when it is missing, empty or holds no numbers.
    """
    header, values = _table(path)
    # Others number their rows `scan`; beside an index that is LOAM's stage.
    others = NOT_STAGES if "index" in header else (*NOT_STAGES, "scan")
    columns = {name: values[:, k] for k, name in enumerate(header) if name not in others}
    stages = {name: column for name, column in columns.items() if not name.startswith(AFTER)}
    later = {name.removeprefix(AFTER): column for name, column in columns.items() if name not in stages}
    if "total" in header:
        total = values[:, header.index("total")]
    elif stages:
        total = np.sum(list(stages.values()), axis=0)
    else:
        raise InputError(f"{path} has neither a column total nor stages: columns are {', '.join(header)}")
    stamps = values[:, header.index("stamp_ns")].astype(np.int64) if "stamp_ns" in header else None
    return TimingRows(stamps, stages, total, later)


def _table(path: Path) -> tuple[list[str], Floats]:
    """Column names and finite values (N, C) of a CSV file; empty cells are 0. Raises InputError with the line of a bad one."""
    with (
        input_errors(f"timing {path}", UnicodeDecodeError, csv.Error),
        path.open(newline="", encoding="utf-8-sig") as stream,
    ):
        lines = [(n, row) for n, row in enumerate(csv.reader(stream), start=1) if row and not row[0].startswith("#")]
    if len(lines) < 2:
        raise InputError(f"timing {path} holds no scans")
    header = [name.strip() for name in lines[0][1]]
    values = []
    for number, row in lines[1:]:
        try:
            values.append([float(cell) if cell.strip() else 0.0 for cell in row])
        except ValueError:
            raise InputError(f"timing {path}, line {number}: not a number in {','.join(row)[:60]!r}") from None
        if len(row) != len(header):
            raise InputError(f"timing {path}, line {number}: {len(row)} columns, the header has {len(header)}")
    table = np.array(values)
    if not np.isfinite(table).all():
        raise InputError(f"timing {path}: NaN or infinity")
    return header, table
