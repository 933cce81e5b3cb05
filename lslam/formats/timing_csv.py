"""timing.csv: seconds per scan and stage."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause

NOT_STAGES = ("index", "stamp_ns", "stamp", "total")


@dataclass(frozen=True)
class TimingRows:
    """The columns of a file of N scans.

    stamps_ns : (N,) int64, None when the file has none; stages : (N,) seconds by name, in the order of the file
    total : (N,) seconds
    """

    stamps_ns: NDArray[np.int64] | None
    stages: dict[str, NDArray[np.float64]]
    total: NDArray[np.float64]


def timing_text(
    indices: list[int], stamps_ns: list[int], names: list[str], seconds: NDArray[np.float64]
) -> str:  # fmt: skip
    """The file of scans by number and stamp, with seconds (N, S) of the stages `names`."""
    lines = [",".join(["index", "stamp_ns", *names, "total"])]
    for index, stamp, row in zip(indices, stamps_ns, seconds, strict=True):
        lines.append(",".join([str(index), str(stamp), *(f"{v:.6f}" for v in (*row, row.sum()))]))
    return "\n".join(lines) + "\n"


def read_timing_rows(path: Path) -> TimingRows:
    """Read columns `index`, `stamp_ns`, seconds per stage, `total` (their sum when absent).

    Raises InputError naming file and line when it is missing, empty or holds no numbers.
    """
    header, values = _table(path)
    # Others number their rows `scan`; beside an index that is LOAM's stage.
    others = NOT_STAGES if "index" in header else (*NOT_STAGES, "scan")
    stages = {name: values[:, k] for k, name in enumerate(header) if name not in others}
    if "total" in header:
        total = values[:, header.index("total")]
    elif stages:
        total = np.sum(list(stages.values()), axis=0)
    else:
        raise InputError(f"{path} has neither a column total nor stages: columns are {', '.join(header)}")
    stamps = values[:, header.index("stamp_ns")].astype(np.int64) if "stamp_ns" in header else None
    return TimingRows(stamps, stages, total)


def _table(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [
                (n, row) for n, row in enumerate(csv.reader(stream), start=1) if row and not row[0].startswith("#")
            ]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"timing {path} cannot be read: {cause(error)}") from None
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
