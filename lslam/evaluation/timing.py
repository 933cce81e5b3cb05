"""Time per scan and stage, from a run's `timing.csv`."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError

NOT_STAGES = ("index", "scan", "stamp_ns", "stamp", "total")


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
    """Read a `timing.csv`: columns `index`, `stamp_ns`, seconds per stage, `total` (their sum when absent).

    Raises InputError naming file and line when it is missing, empty or holds no numbers.
    """
    path = Path(path)
    header, values = _table(path)
    stages = {name: values[:, k] for k, name in enumerate(header) if name not in NOT_STAGES}
    if "total" in header:
        total = values[:, header.index("total")]
    elif stages:
        total = np.sum(list(stages.values()), axis=0)
    else:
        raise InputError(f"{path} has neither a column total nor stages: columns are {', '.join(header)}")
    period = None
    if "stamp_ns" in header and len(values) > 1:
        period = float(np.median(np.diff(values[:, header.index("stamp_ns")]))) / 1e9
    whole = max(float(total.sum()), 1e-300)
    return Timing(
        source=str(path),
        scans=len(values),
        total=_describe(total, whole),
        stages={name: _describe(seconds, whole) for name, seconds in stages.items()},
        period=period if period and period > 0 else None,
        over_limit=int((total > period).sum()) if period and period > 0 else 0,
    )


def _table(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [
                (n, row) for n, row in enumerate(csv.reader(stream), start=1) if row and not row[0].startswith("#")
            ]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"timing {path} cannot be read: {error}") from None
    if len(lines) < 2:
        raise InputError(f"timing {path} holds no scans")
    header = [name.strip() for name in lines[0][1]]
    values = []
    for number, row in lines[1:]:
        try:
            values.append([float(field) if field.strip() else 0.0 for field in row])
        except ValueError:
            raise InputError(f"timing {path}, line {number}: not a number in {','.join(row)[:60]!r}") from None
        if len(row) != len(header):
            raise InputError(f"timing {path}, line {number}: {len(row)} columns, the header has {len(header)}")
    table = np.array(values)
    if not np.isfinite(table).all():
        raise InputError(f"timing {path}: NaN or infinity")
    return header, table


def _describe(seconds: NDArray[Any], whole: float) -> StageTime:
    return StageTime(
        median=float(np.median(seconds)),
        p95=float(np.percentile(seconds, 95)),
        max=float(seconds.max()),
        mean=float(seconds.mean()),
        share=float(seconds.sum()) / whole,
    )
