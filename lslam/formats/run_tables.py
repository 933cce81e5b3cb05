"""Tables of a run folder: `loops.csv`, `osm_matches.csv` (every candidate, its verdict and reason) and `timing.csv`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.atomic import write_text
from lslam.types.building import BuildingMatch, KeyframeMatch, OsmMatches
from lslam.types.constraint import LoopCandidate

LOOP_COLUMNS = (
    "keyframe_a", "keyframe_b", "scan_a", "scan_b", "distance_m", "descriptor_distance", "verdict", "stage", "rmse_m",
    "overlap", "sigma_m", "sigma_deg", "reason",
)  # fmt: skip
# x, y, yaw: of the keyframe in the map frame, or of the displacement of the building about its middle.
MATCH_COLUMNS = (
    "keyframe", "scan", "building", "verdict", "kind", "rank", "walls", "fitness", "coverage", "rms_m", "x_m", "y_m", "yaw_deg",
    "reason",
)  # fmt: skip
SAVED = "saved_s"
NOT_STAGES = ("index", "stamp_ns", "stamp", "total", SAVED)
# Before the names of what is done after odometry.
AFTER = "back end: "


def write_loops(path: Path, candidates: Sequence[LoopCandidate], scans: Sequence[int]) -> None:
    """One row per candidate in their order; `sigma` is the standard deviation where it is largest, empty when unknown.

    scans : of the keyframes, as the recording numbers them. Raises OutputError when the file cannot be written.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(LOOP_COLUMNS)
    for c in candidates:
        sigma_m, sigma_deg = _sigmas(c)
        row = (
            c.a, c.b, scans[c.a], scans[c.b], f"{c.distance:.3f}", _number(c.descriptor_distance),
            c.verdict, c.stage, _number(c.rmse), _number(c.overlap), _number(sigma_m), _number(sigma_deg), c.reason,
        )  # fmt: skip
        table.writerow(row)
    write_text(path, text.getvalue())


def _sigmas(candidate: LoopCandidate) -> tuple[float, float]:
    """m and deg."""
    if candidate.constraint is None:
        return float("nan"), float("nan")
    C = candidate.constraint.covariance
    largest = [float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for block in (C[:3, :3], C[3:, 3:])]
    return largest[0], float(np.rad2deg(largest[1]))


def _number(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


def write_osm_matches(path: Path, matches: OsmMatches, scans: Sequence[int], poses: NDArray[np.float64]) -> None:
    """One row per keyframe, `building` empty, then one per building seen from one, with its OpenStreetMap number.

    scans : of the keyframes, as the recording numbers them; poses : (K, 3) their final planar poses in the map frame.
    Raises OutputError when it cannot be written.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(MATCH_COLUMNS)
    for match in matches.keyframes:
        table.writerow(_row(match, scans, "", match.pose))
    for one in matches.local:
        building = matches.buildings[one.building]
        moved = one.displacement(poses[one.keyframe], building.middle)
        table.writerow(_row(one, scans, building.osm_id, moved))
    write_text(path, text.getvalue())


def _row(
    match: KeyframeMatch | BuildingMatch, scans: Sequence[int], building: str, pose: NDArray[np.float64]
) -> tuple[Any, ...]:
    x, y, yaw = (pose[0], pose[1], np.degrees(pose[2])) if match.rank else (np.nan, np.nan, np.nan)
    numbers = (match.fitness, match.coverage, match.rms, x, y, yaw)
    return (
        match.keyframe, scans[match.keyframe], building, match.verdict, match.kind, match.rank, len(match.pairs),
        *(f"{value:.4f}" if np.isfinite(value) else "" for value in numbers), match.reason,
    )  # fmt: skip


@dataclass(frozen=True)
class TimingRows:
    """The columns of a file of N scans.

    stamps_ns : (N,) int64, None when the file has none; stages : (N,) seconds by name, in the order of the file
    total : (N,) seconds
    back_end : (N,) seconds by name, of what was done to a scan after odometry and does not count in `total`
    """

    stamps_ns: NDArray[np.int64] | None
    stages: dict[str, NDArray[np.float64]]
    total: NDArray[np.float64]
    back_end: dict[str, NDArray[np.float64]] = field(default_factory=dict)


def timing_text(
    indices: list[int], stamps_ns: list[int], names: list[str], seconds: NDArray[np.float64],
    back_end: Mapping[int, Mapping[str, float]] | None = None, saved: Mapping[int, float] | None = None,
) -> str:  # fmt: skip
    """The file of scans by number and stamp, with seconds (N, S) of the stages `names`.

    back_end : seconds by row and name, of stages that do not count in the total of a scan
    saved : seconds by row that were not needed, a column when there are any; empty where nobody knows
    """
    back_end = back_end or {}
    later = list(dict.fromkeys(f"{AFTER}{name}" for row in back_end.values() for name in row))
    lines = [",".join(["index", "stamp_ns", *names, "total", *later, *([SAVED] if saved else [])])]
    for k, (index, stamp, row) in enumerate(zip(indices, stamps_ns, seconds, strict=True)):
        own = back_end.get(k, {})
        values = (*row, row.sum(), *(own.get(name.removeprefix(AFTER), 0.0) for name in later))
        said = [str(index), str(stamp), *(f"{v:.6f}" for v in values)]
        if saved:
            said.append(f"{saved[k]:.6f}" if k in saved else "")
        lines.append(",".join(said))
    return "\n".join(lines) + "\n"


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


def _table(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [
                (n, row) for n, row in enumerate(csv.reader(stream), start=1) if row and not row[0].startswith("#")
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
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
