"""Time per scan and stage, from a run's `timing.csv`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.formats.run_tables import read_timing_rows
from lslam.remote import as_path


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
    """Read and summarise a `timing.csv`.

    Raises InputError naming file and line when it is missing, empty or holds no numbers.
    """
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


def summarise(seconds: NDArray[np.float64], whole: float) -> StageTime:
    """One stage (N,), s, of scans that took `whole` s in all."""
    median, p95 = (float(v) for v in np.percentile(seconds, [50, 95]))
    share = float(seconds.sum()) / whole if whole > 0 else 0.0
    return StageTime(median, p95, float(seconds.max()), float(seconds.mean()), share)
