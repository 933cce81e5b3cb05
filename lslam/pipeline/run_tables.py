"""Tables of a run folder: `loops.csv`, `osm_matches.csv` (candidates with verdict and reason), `timing.csv`, `imu_states.csv`."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lslam.evaluation.timing import AFTER, SAVED
from lslam.formats.atomic import write_text
from lslam.types.arrays import Floats
from lslam.types.building import BuildingMatch, KeyframeMatch, OsmMatches
from lslam.types.constraint import LoopCandidate
from lslam.types.imu import IMU_STATES
from lslam.types.scan_result import ScanResult

LOOP_COLUMNS = (
    "keyframe_a", "keyframe_b", "scan_a", "scan_b", "distance_m", "descriptor_distance", "verdict", "stage", "rmse_m",
    "overlap", "sigma_m", "sigma_deg", "reason",
)  # fmt: skip
# x, y, yaw: of the keyframe in the map frame, or of the displacement of the building about its middle.
MATCH_COLUMNS = (
    "keyframe", "scan", "building", "verdict", "kind", "rank", "walls", "fitness", "coverage", "rms_m", "x_m", "y_m", "yaw_deg",
    "reason",
)  # fmt: skip


def write_loops(path: Path, candidates: Sequence[LoopCandidate], scans: Sequence[int]) -> None:
    """One row per candidate in their order; `sigma` is the standard deviation where it is largest, empty when unknown.

    scans : of the keyframes, as the recording numbers them. Raises OutputError when the file cannot be written.
    """
    rows = [
        (
            c.a, c.b, scans[c.a], scans[c.b], f"{c.distance:.3f}", _number(c.descriptor_distance),
            c.verdict, c.stage, _number(c.rmse), _number(c.overlap), *map(_number, _sigmas(c)), c.reason,
        )
        for c in candidates
    ]  # fmt: skip
    _write(path, LOOP_COLUMNS, rows)


def _sigmas(candidate: LoopCandidate) -> tuple[float, float]:
    """m and deg."""
    if candidate.constraint is None:
        return float("nan"), float("nan")
    C = candidate.constraint.covariance
    largest = [float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for block in (C[:3, :3], C[3:, 3:])]
    return largest[0], float(np.rad2deg(largest[1]))


def _number(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


def write_osm_matches(path: Path, matches: OsmMatches, scans: Sequence[int], poses: Floats) -> None:
    """One row per keyframe, `building` empty, then one per building seen from one, with its OpenStreetMap number.

    scans : of the keyframes, as the recording numbers them; poses : (K, 3) their final planar poses in the map frame.
    Raises OutputError when it cannot be written.
    """
    rows = [_match_row(match, scans, "", match.pose) for match in matches.keyframes]
    for one in matches.local:
        building = matches.buildings[one.building]
        rows.append(_match_row(one, scans, building.osm_id, one.displacement(poses[one.keyframe], building.middle)))
    _write(path, MATCH_COLUMNS, rows)


def _match_row(
    match: KeyframeMatch | BuildingMatch, scans: Sequence[int], building: str, pose: Floats
) -> tuple[Any, ...]:
    place = (pose[0], pose[1], np.degrees(pose[2])) if match.rank else (np.nan, np.nan, np.nan)
    return (
        match.keyframe, scans[match.keyframe], building, match.verdict, match.kind, match.rank, len(match.pairs),
        *map(_number, (match.fitness, match.coverage, match.rms, *place)), match.reason,
    )  # fmt: skip


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_text(path, text.getvalue())


def timing_text(
    indices: list[int], stamps_ns: list[int], names: list[str], seconds: Floats,
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


def imu_states_text(results: Iterable[ScanResult]) -> str:
    """What was known of the IMU, each value beside its standard deviation: a row per scan that has an `ImuState`.

    A state that is not estimated is empty. SI units, radians.
    """
    header = ["index", "stamp_ns", *(column for name in IMU_STATES for column in (name, f"{name}_sigma"))]
    rows = [",".join(header)]
    for r in results:
        if r.imu.state is not None:
            pairs = np.stack([r.imu.state.values, r.imu.state.sigmas], axis=1).ravel()
            rows.append(",".join([str(r.index), str(r.stamp_ns), *("" if np.isnan(v) else f"{v:.7g}" for v in pairs)]))
    return "\n".join(rows) + "\n"
