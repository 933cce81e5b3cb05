"""Rows of a study as curves: one per sequence, method, IMU and value of the second parameter."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lslam.evaluation.efficiency import efficiency
from lslam.types.study import Bools, Curve, Floats, StudyRow, Value

# Everything else is registration: what Girolimetto's times per iteration hold (equation 5.2).
NOT_REGISTRATION = ("read", "prepare", "standing", "keyframe", "integrity")
# A run is lost when its error is that many times the best of the study ...
LOST_FACTOR = 10.0
# ... and more than Girolimetto takes for a result: its largest rmse that is one (LOAM, large eight) is 2.156 m.
LOST_FLOOR_M = 2.2


def lost_above(rows: Sequence[StudyRow]) -> float:
    """The error in m above which a run counts as lost: 10 times the best of all rows, and not below 2.2 m."""
    errors = [row.error for row in rows if row.is_usable and np.isfinite(row.error)]
    return max(LOST_FLOOR_M, LOST_FACTOR * min(errors, default=0.0))


def curves_of(rows: Sequence[StudyRow], limit: float | None = None) -> list[Curve]:
    """Curves in the order their rows appear; the first studied parameter is the abscissa.

    rows : of one study; runs beside it are left out; limit : m, `lost_above` of the rows by default
    """
    rows = [row for row in rows if row.parameters and not row.is_beside]
    limit = lost_above(rows) if limit is None else limit
    groups: dict[tuple[object, ...], list[StudyRow]] = {}
    for row in rows:
        abscissa, *_ = row.parameters
        others = tuple((key, value) for key, value in row.parameters.items() if key != abscissa)
        groups.setdefault((row.sequence, row.method, row.uses_imu, abscissa, others), []).append(row)
    return [_curve(group, limit) for group in groups.values()]


def registration_ms(row: StudyRow) -> float:
    """Mean time per scan of registration in all its stages; nan when nothing was timed."""
    own = [ms for name, ms in row.stages_ms.items() if name not in NOT_REGISTRATION]
    return sum(own) if own else float("nan")


def _curve(rows: Sequence[StudyRow], limit: float) -> Curve:
    parameter, *_ = rows[0].parameters
    at = [(key, value) for key, value in rows[0].parameters.items() if key != parameter]
    given: list[Value] = [row.parameters[parameter] for row in rows]
    is_number = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in given)
    order = sorted(set(given)) if is_number else list(dict.fromkeys(given))
    seeds = tuple(sorted({row.seed for row in rows}))
    cells = {(order.index(value), seeds.index(row.seed)): row for value, row in zip(given, rows, strict=True)}

    def table(number: Callable[[StudyRow], float]) -> Floats:
        out = np.full((len(order), len(seeds)), np.nan)
        for cell, row in cells.items():
            out[cell] = number(row) if row.is_usable else np.nan
        return out

    def mask(holds: Callable[[StudyRow], bool]) -> Bools:
        out = np.zeros((len(order), len(seeds)), bool)
        for cell, row in cells.items():
            out[cell] = holds(row)
        return out

    translation, angular = table(lambda row: row.error), table(lambda row: row.angular_rmse_deg)
    per_scan, total = table(registration_ms), table(lambda row: row.total_time_s)
    lost = mask(lambda row: row.is_diverged) | (translation > limit)
    stages = list(dict.fromkeys(name for row in rows for name in row.stages_ms))
    return Curve(
        sequence=rows[0].sequence,
        method=rows[0].method,
        uses_imu=rows[0].uses_imu,
        parameter=parameter,
        values=np.array(order if is_number else range(len(order)), np.float64),
        seeds=seeds,
        quantities={
            "translation": translation,
            "angular": angular,
            "time_per_scan": per_scan,
            "total_time": total,
            "fallback": 100 * table(lambda row: row.fallback_share),
            "efficiency": np.where(lost, 0.0, efficiency(translation, angular, per_scan / 1e3)),
            "total_efficiency": np.where(lost, 0.0, efficiency(translation, angular, total)),
        },
        stages={name: table(lambda row, name=name: row.stages_ms.get(name, np.nan)) for name in stages},  # type: ignore[misc]
        lost=lost,
        # A run that failed otherwise, for want of memory or a file, says nothing about its parameters.
        ran=mask(lambda row: row.is_usable or row.is_diverged),
        at=tuple(at),
        words=() if is_number else tuple(str(value) for value in order),
        is_timed_alone=all(row.is_timing_comparable for row in rows if row.is_usable),
    )
