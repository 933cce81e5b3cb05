"""Per-point times of any sensor to seconds from the scan's stamp: the rule is decided once per sequence and said aloud."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.types.scan import Span

_UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
# A field's unit is that in which the scan lasts so many of its periods; an offset that begins later is a clock's reading.
_SHORTEST, _LONGEST = 0.05, 3.0


@dataclass(frozen=True)
class TimeRule:
    """How a per-point time field is read.

    ns_per_unit : length of its unit, ns; is_absolute : clock readings instead of offsets
    is_before_stamp : offsets are negative, the stamp belongs to the scan's end and moves to its start
    sentence : the decision in words, for the log and the manifest
    """

    ns_per_unit: float
    is_absolute: bool
    is_before_stamp: bool
    sentence: str


def decide_rule(
    name: str,
    values: NDArray[Any],
    stamp_ns: int,
    rate_hz: float,
    unit: str | None = None,
    reference: str | None = None,
) -> TimeRule:
    """Find unit and reference of a time field from one scan, unless they are stated.

    unit : s, ms, us or ns; reference : `start` or `end` of the scan, or `absolute`; None finds out

    The unit is the one in which the scan lasts about 1 / `rate_hz`; integers are ns when that fits too. Offsets that lie
    about 0 refer to the scan's middle, others that are negative to its end, those that begin later than a scan can last are
    readings of a clock, whatever its epoch (a sensor that was never told the time counts from where it was switched on).
    Raises InputError with field, type, range and stamp when no unit fits.
    """
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    period_ns = 1e9 / rate_hz
    fitting = [u for u, ns in _UNITS_NS.items() if _SHORTEST <= (high - low) * ns / period_ns <= _LONGEST]
    if unit is not None:
        fitting = [unit]
    if not fitting or values.dtype.kind not in "fiu":
        raise InputError(
            f"per-point time field {name!r} ({values.dtype}, {low:.9g} to {high:.9g}, scan stamp {stamp_ns} ns) spans no "
            f"scan of {1 / rate_hz:.3g} s in s, ms, us or ns; state rate_hz, or point_time_unit and point_time_reference, "
            "in sequence.toml"
        )
    how = ", as stated" if unit or reference else ""
    unit = "ns" if values.dtype.kind in "iu" and "ns" in fitting else fitting[0]
    scale = _UNITS_NS[unit]
    is_absolute = low * scale > _LONGEST * period_ns
    is_about_stamp = reference is None and low < 0 and Span(low, high).instant == "scan_middle"
    is_before_stamp = not is_absolute and low < 0 and not is_about_stamp
    if reference is not None:
        is_absolute, is_before_stamp = reference == "absolute", reference == "end"
    words = (
        "absolute" if is_absolute else "relative to the scan's end" if is_before_stamp else
        "relative to the scan's middle" if is_about_stamp else "since scan start"
    )  # fmt: skip
    return TimeRule(
        scale,
        is_absolute,
        is_before_stamp,
        f"per-point times from field {name!r} ({values.dtype}), {unit}, {words}{how}",
    )


def rule_of_scans(
    name: str, first: NDArray[Any], later: NDArray[Any], stamp_ns: int, rate_hz: float, unit: str | None = None,
    reference: str | None = None,
) -> TimeRule:  # fmt: skip
    """`decide_rule` for the first scan, and for a later one by which a clock that started with the recording is told.

    first, later : values of the field in two scans; stamp_ns : of the first
    """
    rule = decide_rule(name, first, stamp_ns, rate_hz, unit, reference)
    if rule.is_absolute or rule.is_before_stamp or not len(later):
        return rule
    with suppress(InputError):
        by_later = decide_rule(name, later, stamp_ns, rate_hz, unit, reference)
        return by_later if by_later.is_absolute else rule
    return rule


def apply_rule(rule: TimeRule, values: NDArray[Any], stamp_ns: int) -> tuple[NDArray[np.float32], int]:
    """Times (N,) float32 s, and what to add to the stamp (ns) so that they count from it.

    It becomes the scan's start, unless the offsets lie about it: then it stays in the middle.
    """
    if not len(values):
        return np.zeros(0, np.float32), 0
    if not rule.is_absolute and not rule.is_before_stamp:
        return (values * (rule.ns_per_unit * 1e-9)).astype(np.float32), 0
    first = values[np.isfinite(values)].min() if values.dtype.kind == "f" else values.min()
    # The difference is taken in the field's own type first: absolute ns do not fit a float.
    times = ((values - first).astype(np.float64) * (rule.ns_per_unit * 1e-9)).astype(np.float32)
    if rule.is_before_stamp:
        # Offsets that count up to a stamp at the end, where that is stated, begin at 0.
        offset = float(first) if first < 0 else -float(values[np.isfinite(values)].max() - first)
        return times, round(offset * rule.ns_per_unit)
    start_ns = (
        int(first) if values.dtype.kind in "iu" and rule.ns_per_unit == 1 else round(float(first) * rule.ns_per_unit)
    )
    # Another clock or only nominal stamps: the sequence's own stamps stay.
    return times, start_ns - stamp_ns if abs(start_ns - stamp_ns) < 1e9 else 0


def azimuth_times(points: NDArray[np.float32], sweep: Span) -> NDArray[np.float32]:
    """Times (N,) float32 s of a sensor that turns clockwise seen from above and starts behind (KITTI's HDL-64E)."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    return (sweep.begin_s + 0.5 * (1 - azimuth / np.pi) * sweep.seconds).astype(np.float32)
