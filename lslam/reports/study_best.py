"""What a study shows while it runs and when it ends: the best point of each method so far; of a batch, every run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from lslam.reports.grid_text import Grid
from lslam.types.study import StudyRow

LABELS = {"ate_se3": "ATE se3", "ate_origin": "ATE origin", "thesis_rmse": "thesis_rmse"}


@dataclass(frozen=True)
class Best:
    """One method on one sequence: how many runs have ended and failed, and the point with the least mean error.

    point : rows of that point, one per seed; empty when no point is without a failed run
    """

    sequence: str
    method: str
    runs: int
    failed: int
    point: tuple[StudyRow, ...]

    def mean(self, name: str) -> float:
        """Of a number over the seeds."""
        return float(sum(getattr(row, name) for row in self.point)) / len(self.point)


def best_points(rows: Sequence[StudyRow]) -> list[Best]:
    """One per sequence and method, with and without IMU and beside apart, in the order of the rows."""
    groups: dict[tuple[str, str], list[StudyRow]] = {}
    for row in rows:
        groups.setdefault((row.sequence, label(row)), []).append(row)
    return [
        Best(sequence, method, len(group), sum(not row.is_usable for row in group), _best(group))
        for (sequence, method), group in groups.items()
    ]


def label(row: StudyRow) -> str:
    """The method as people read it.

    >>> label(StudyRow("", "", "open", 0, "icp", uses_imu=True, is_beside=True))
    'icp+imu (beside)'
    """
    return f"{row.method}{'+imu' if row.uses_imu else ''}{' (beside)' if row.is_beside else ''}"


def best_table(rows: Sequence[StudyRow]) -> Grid:
    """Header and a line per method."""
    metric = LABELS[rows[0].metric] if rows else "error"
    header = ["sequence", "method", "runs", "failed", "best at", f"{metric}, m", "angular, deg", "total, s"]
    return [header, *(_line(best) for best in best_points(rows))]


def batch_table(rows: Sequence[StudyRow]) -> Grid:
    """Header and a line per run of a batch: how it ended, its errors, and where it lies or why it failed."""
    header = ["sequence", "method", "status", "scans", "ATE se3, m", "ms per scan", "total, s", "folder or reason"]
    lines = []
    for row in rows:
        numbers = [f"{row.ate_se3:.3f}", f"{row.time_per_scan_ms:.1f}", f"{row.run_s:.1f}"]
        shown = ["-" if number == "nan" else number for number in numbers]
        end = row.folder if row.is_usable else row.reason
        lines.append([row.sequence, label(row), row.status, str(row.scans), *shown, end])
    return [header, *lines]


def _best(rows: Sequence[StudyRow]) -> tuple[StudyRow, ...]:
    points: dict[str, list[StudyRow]] = {}
    for row in rows:
        points.setdefault(repr(row.parameters), []).append(row)
    best: tuple[StudyRow, ...] = ()
    least = inf
    for point in points.values():
        error = sum(row.error if row.is_usable else inf for row in point) / len(point)
        if error < least:  # never with nan, without ground truth
            best, least = tuple(point), error
    return best


def _line(best: Best) -> list[str]:
    head = [best.sequence, best.method, str(best.runs), str(best.failed)]
    if not best.point:
        return [*head, "-", "-", "-", "-"]
    at = ", ".join(f"{key.partition('.')[2]} {value}" for key, value in best.point[0].parameters.items())
    errors = [f"{best.mean('error'):.3f}", f"{best.mean('angular_rmse_deg'):.2f}"]
    return [*head, at or "its own values", *errors, f"{best.mean('total_time_s'):.2f}"]
