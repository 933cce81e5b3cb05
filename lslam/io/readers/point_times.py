"""Per-point times of any sensor as seconds from the scan's stamp: the rule is learnt on several scans and logged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools
from lslam.core.errors import InputError
from lslam.core.types.scan import Span, has_return
from lslam.io.formats.point_cloud import PointCloud, TimeColumn
from lslam.io.formats.time_columns import UNITS

# A field's unit is that in which the scan lasts so many of its periods; an offset that begins later is a clock's reading.
_SHORTEST, _LONGEST = 0.05, 3.0
# Times fill each of so many parts of a sweep with this share of the points at least, which real curvature, small nearly
# everywhere, does not; and between neighbours they differ by less than this share of the sweep.
_PARTS, _LEAST_IN_PART, _ALIKE = 10, 0.01, 0.05


@dataclass(frozen=True)
class TimeRule:
    """How a per-point time field is read.

    ns_per_unit : length of its unit, ns; is_absolute : clock readings instead of offsets
    is_before_stamp : offsets are negative, the stamp belongs to the scan's end and moves to its start
    sentence : the decision in words, for the log and the manifest
    field : its name; sweep : usual length of a sweep, reach : how far from 0 an offset can be, both in its unit
    points : usual number of points of a scan
    """

    ns_per_unit: float
    is_absolute: bool
    is_before_stamp: bool
    sentence: str
    field: str = ""
    sweep: float = np.inf
    reach: float = np.inf
    points: float = 0.0

    @property
    def sweep_s(self) -> float:
        """Usual length of a sweep, s."""
        return self.sweep * self.ns_per_unit * 1e-9


@dataclass(frozen=True)
class Sample:
    """Scan from which a rule is learnt: its points, or every `step`-th of them, and its header stamp, ns."""

    cloud: PointCloud
    stamp_ns: int
    step: int = 1

    def __len__(self) -> int:
        return len(self.cloud)

    def thin(self, most: int) -> Sample:
        """The sample with every n-th point, `most` or somewhat more of them."""
        step = max(len(self) // most, 1)
        return Sample(self.cloud.select(np.arange(0, len(self), step)), self.stamp_ns, step)


class _TimeReading(NamedTuple):
    """Possible reading of one scan's times: unit, dtype, limits of the sweep in that unit, and reference instant."""

    unit: str
    dtype: np.dtype[Any]
    low: float
    high: float
    is_absolute: bool
    instant: str


def learn_rule(
    samples: Sequence[Sample], rate_hz: float, unit: str | None = None, reference: str | None = None
) -> TimeRule | None:
    """Find the time field of a recording, its unit and reference, on several of its scans; None without a varying field.

    unit : s, ms, us or ns; reference : `start` or `end` of the scan, or `absolute`; None finds out

    A field is used if it can be times in half of the scans that have it; fields of most scans come first. The unit is the
    one in which a scan lasts about 1 / `rate_hz`; integers are ns when that fits too. Offsets about 0 refer to the
    scan's middle, other negative ones to its end, those that begin later than a scan can last are readings of a clock
    of any epoch (a sensor without external time counts from power-on, a simulator from the begin of the recording).
    Raises InputError with field, type, range and stamp when no field and unit fits.
    """
    refusal: InputError | None = None
    counts = Counter(clock.name for sample in samples for clock in sample.cloud.clocks)
    for name in sorted(counts, key=lambda name: 2 * counts[name] < len(samples)):
        having = [(c, sample) for sample in samples if len(sample) for c in sample.cloud.clocks if c.name == name]
        readings = []
        for clock, sample in having:
            try:
                readings.append(_read(clock, sample, rate_hz, unit, reference))
            except InputError as error:
                refusal = refusal or (None if clock.is_doubtful or clock.is_constant else error)
        if readings and 2 * len(readings) >= len(having):
            points = float(np.median([sample.step * len(sample) for _, sample in having]))
            return _agree(name, readings, points, rate_hz, unit, reference)
    if refusal is not None:
        raise refusal
    return None


def _agree(
    name: str, readings: list[_TimeReading], points: float, rate_hz: float, unit: str | None, reference: str | None
) -> TimeRule:
    """Rule that fits most of the scans with the usual number of points, in the unit of most of them."""
    usual = Counter(r.unit for r in readings).most_common(1)[0][0]
    readings = [r for r in readings if r.unit == usual]
    # A clock that started with the recording looks like an offset in the first scans.
    is_rising = readings[-1].is_absolute and all(b.low > a.low for a, b in pairwise(readings))
    is_absolute = is_rising or 2 * sum(r.is_absolute for r in readings) > len(readings)
    instant = Counter(r.instant for r in readings if r.is_absolute == is_absolute).most_common(1)[0][0]
    if reference is not None:
        is_absolute = reference == "absolute"
        instant = "scan_end" if reference == "end" else "scan_start"
    words = "since scan start" if instant == "scan_start" else f"relative to the scan's {instant.removeprefix('scan_')}"
    words = "absolute" if is_absolute else words
    how = ", as stated" if unit or reference else ""
    ns = UNITS[usual]
    farthest = max(max(abs(r.low), abs(r.high)) for r in readings)
    return TimeRule(
        ns,
        is_absolute,
        is_before_stamp=not is_absolute and instant == "scan_end",
        field=name,
        points=points,
        sentence=f"per-point times from field {name!r} ({readings[0].dtype}), {usual}, {words}{how}",
        sweep=float(np.median([r.high - r.low for r in readings])),
        reach=np.inf if is_absolute else max(_LONGEST * 1e9 / rate_hz / ns, 1.5 * farthest),
    )


def _read(clock: TimeColumn, sample: Sample, rate_hz: float, unit: str | None, reference: str | None) -> _TimeReading:
    """Possible readings of one scan's times, judged by most of its points; unit, reference : as stated, None to find them.

    Raises InputError when no unit fits.
    """
    usable = is_usable(sample.cloud, clock.values)
    values, points = clock.values[usable], sample.cloud.points[usable]
    period_ns = 1e9 / rate_hz

    def can_be(u: str) -> bool:
        low, high = limits[u]
        is_sweep = _SHORTEST <= (high - low) * UNITS[u] / period_ns <= _LONGEST
        return is_sweep and (not clock.is_doubtful or (u == clock.unit and _is_sweep(points, values, low, high)))

    limits = {u: _limits(values, _LONGEST * period_ns / ns) for u, ns in UNITS.items()}
    fitting = [u for u in limits if can_be(u)]
    if unit is not None:
        fitting, limits = [unit], {unit: _limits(values, np.inf)}
    if not fitting:
        low, high = _limits(values, np.inf)
        raise InputError(
            f"per-point time field {clock.name!r} ({values.dtype}, {low:.9g} to {high:.9g}, scan stamp {sample.stamp_ns} ns) "
            f"spans no scan of {1 / rate_hz:.3g} s in s, ms, us or ns; state rate_hz, or point_time_unit and "
            "point_time_reference, in sequence.toml"
        )
    usual = "ns" if values.dtype.kind in "iu" and "ns" in fitting else fitting[0]
    usual = clock.unit if clock.unit in fitting else usual
    low, high = limits[usual]
    is_absolute = reference is None and low * UNITS[usual] > _LONGEST * period_ns
    instant = "scan_start" if low >= 0 else Span(low, high).instant
    return _TimeReading(usual, values.dtype, low, high, is_absolute, instant)


def is_usable(cloud: PointCloud, values: NDArray[Any]) -> Bools:
    """(N,) whether a point's time counts: it is a number, and the point was measured (if any point of the scan was)."""
    measured = has_return(cloud.points)
    if not measured.any():
        measured[:] = True
    return measured & np.isfinite(values) if values.dtype.kind == "f" else measured


def _limits(values: NDArray[Any], width: float) -> tuple[float, float]:
    """Smallest and largest value of the densest part not wider than `width` when it holds more than half; else 0, 0."""
    dense = values[densest(values, np.ones(len(values), np.bool_), width)]
    if 2 * len(dense) <= len(values):
        return 0.0, 0.0
    low, high = dense.min(), dense.max()
    return float(low), float(low) + float(high - low)


def densest(values: NDArray[Any], among: Bools, width: float) -> Bools:
    """(N,) mask of the finite values `among` that lie in the interval of length `width` with most of them."""
    if not among.any():
        return among
    ordered = np.sort(values[among])
    # From the first in the field's own type: absolute ns do not fit a float.
    ahead = (ordered - ordered[0]).astype(np.float64)
    counts = np.searchsorted(ahead, ahead + width, "right") - np.arange(len(ahead))
    k = int(np.argmax(counts))
    return np.asarray(among & (values >= ordered[k]) & (values <= ordered[k + int(counts[k]) - 1]))


def _is_sweep(points: NDArray[np.float32], values: NDArray[Any], low: float, high: float) -> bool:
    """Whether values (N,) from `low` to `high` look like times: they cover the sweep, and neighbouring points are alike."""
    shares = np.histogram(values.astype(np.float64), _PARTS, (low, high))[0] / max(len(values), 1)
    around = np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable")
    apart = min(np.median(np.abs(np.diff(v.astype(np.float64)))) for v in (values, values[around]))
    return bool(low >= 0 and shares.min() >= _LEAST_IN_PART and apart < _ALIKE * (high - low))


def apply_rule(rule: TimeRule, values: NDArray[Any], stamp_ns: int) -> tuple[NDArray[np.float32], int]:
    """Times (N,) float32, s, relative to the new stamp, from finite values (N > 0,), and the shift of the stamp, ns.

    The new stamp is the scan's start; for offsets about the scan's middle it is unchanged.
    """
    scale_s = rule.ns_per_unit * 1e-9
    if not rule.is_absolute and not rule.is_before_stamp:
        return (values * scale_s).astype(np.float32), 0
    first = values.min()
    # The difference is taken in the field's own type first: absolute ns do not fit a float.
    times = ((values - first).astype(np.float64) * scale_s).astype(np.float32)
    if rule.is_before_stamp:
        # Offsets that count up to a stamp at the end, where that is stated, begin at 0.
        offset = float(first) if first < 0 else -float(values.max() - first)
        return times, round(offset * rule.ns_per_unit)
    is_exact = values.dtype.kind in "iu" and rule.ns_per_unit == 1
    return times, (int(first) if is_exact else round(float(first) * rule.ns_per_unit)) - stamp_ns


def azimuth_times(points: NDArray[np.float32], sweep: Span) -> NDArray[np.float32]:
    """Times (N,) float32 s of a sensor that turns clockwise seen from above and starts behind (KITTI's HDL-64E)."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    return (sweep.begin_s + 0.5 * (1 - azimuth / np.pi) * sweep.seconds).astype(np.float32)
