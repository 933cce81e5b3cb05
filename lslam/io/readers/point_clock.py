"""Per-point times of each scan by the rule learnt for its recording; scans and points that break the rule are handled singly."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Longs, Stamps
from lslam.core.errors import InputError
from lslam.core.types.scan import has_return
from lslam.core.types.sequence import readable
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.sequence_toml import SequenceInfo
from lslam.io.readers.listing import DEFAULT_RATE_HZ, filled_stamps
from lslam.io.readers.point_times import Sample, TimeRule, apply_rule, densest, is_usable, learn_rule

# Sweeps of a sensor differ by less than this factor in length; what is wider holds times that are wrong.
_WIDER = 1.6
# One that is longer than usual by more may hold two clocks, where its points say so.
_LONGER = 1.1
# A full scan whose times span less of a sweep has no times.
_FLAT = 0.02
# More points than this share behind a gap are no stray ones: the clock was set while the sensor turned.
_STEP_SHARE = 0.05
# Scans from the beginning that a rule is learnt on, and about how many points of each.
_FIRST, _ENOUGH = 3, 5000
# A part of the sweep begins and ends once in each ring at most: more changes per point are no order of measuring.
_OFTEN = 0.02
# Absolute times that lie farther from the stamp are of another clock.
_OTHER_CLOCK_NS = 10**9
T = TypeVar("T")
_OTHER_EPOCH_NS = 10**10  # by which the times of points and of recording lie apart
_SLOW_HZ = 1.0  # tried where no rate is stated and no sweep is as short as usual


class TimedCloud(NamedTuple):
    """Points of a scan with times, (N,) float32 s or None; ns to add to the stamp; and a fault in words, empty if none.

    non_returns : number of points without coordinates whose times lie outside the sweep; they stay, with times at its
    beginning
    """

    cloud: PointCloud
    times: NDArray[np.float32] | None
    shift_ns: int
    fault: str = ""
    non_returns: int = 0


@dataclass(frozen=True)
class PointClock:
    """Reads the point times of every scan of a recording by one rule."""

    rule: TimeRule
    rate_hz: float
    is_of_one_scan: bool = False

    def read(self, cloud: PointCloud, stamp_ns: int) -> TimedCloud:
        """Points of a scan with their times, and the shift from `stamp_ns`, the stamp of the header.

        Measured points with an impossible time are left out. Points that were not measured stay, since no method uses them.
        """
        timed = self._read_times(cloud, stamp_ns)
        # Another clock or only nominal stamps: the sequence's own stamps stay.
        is_other = self.rule.is_absolute and abs(timed.shift_ns) >= _OTHER_CLOCK_NS
        return timed._replace(shift_ns=0) if is_other else timed

    def begin_ns(self, cloud: PointCloud) -> int | None:
        """Time of the first point, ns, from absolute times; None for a scan that breaks the rule."""
        times, begin = replace(self, is_of_one_scan=True)._read_times(cloud, 0)[1:3]
        return None if times is None or not len(times) else begin

    def _read_times(self, cloud: PointCloud, stamp_ns: int) -> TimedCloud:
        """Times of a scan with the stamp `stamp_ns`, by the rule; a scan that breaks it is repaired or read by itself."""
        rule = self.rule
        if not len(cloud):
            return TimedCloud(cloud, np.zeros(0, np.float32), 0)  # an empty scan is no scan of a sensor without times
        values = next((clock.values for clock in cloud.clocks if clock.name == rule.field), None)
        if values is None:
            return self._by_itself(cloud, stamp_ns, f"the scan has no field {rule.field!r}, unlike the others")
        if self._is_sound(values, len(cloud)):
            return TimedCloud(cloud, *apply_rule(rule, values, stamp_ns))
        return self._repair(cloud, values, stamp_ns)

    def first_whole(self, samples: dict[int, Sample]) -> int:
        """Number of the first sample with a sound sweep of the usual length, or else of the first."""
        timed = ((index, self.read(s.cloud, s.stamp_ns)) for index, s in samples.items())
        whole = (
            index
            for index, t in timed
            if t.times is not None and not t.fault and 2 * np.ptp(t.times) >= self.rule.sweep_s
        )
        return next(whole, next(iter(samples)))

    def _repair(self, cloud: PointCloud, values: NDArray[Any], stamp_ns: int) -> TimedCloud:
        """Times of a scan that needs repair: wrapped counters, a step of the clock, or points outside the sweep."""
        rule, width = self.rule, _WIDER * self.rule.sweep
        usable = is_usable(cloud, values)
        values, over = _unwrap(values, usable, width)
        good = densest(values, usable, width)
        step = _step(values, usable, good, rule.sweep)
        if step is not None:
            values, good = step
        if 2 * np.count_nonzero(good) <= np.count_nonzero(usable) or not self._is_sound(values[good], len(cloud)):
            return self._by_itself(cloud, stamp_ns, f"field {rule.field!r} does not hold times as in the other scans")
        times, shift = apply_rule(rule, np.where(good, values, values[good].min()), stamp_ns)
        wrong = has_return(cloud.points) & ~good
        count = np.count_nonzero(wrong)
        faults = []
        if over:
            faults.append(
                f"the times of {over} points ran over the bits of field {rule.field!r} and are read beyond them"
            )
        if step is not None:
            faults.append("the clock of the points was set within the sweep and is read on as before")
        if count:
            faults.append(f"{count} of {len(cloud)} points have times outside the sweep and are left out")
        non_returns = len(cloud) - int(np.count_nonzero(good | wrong))
        if count:
            cloud, times = cloud.select(~wrong), times[~wrong]
        return TimedCloud(cloud, times, shift, "; ".join(faults), non_returns)

    def _is_sound(self, values: NDArray[Any], count: int) -> bool:
        """Whether all times of a scan of `count` points can belong to one sweep; False if one of them is NaN."""
        rule = self.rule
        low, high = values.min(), values.max()
        span = float(high) - float(low)
        if not span <= _WIDER * rule.sweep or (span < _FLAT * rule.sweep and 2 * count > rule.points):
            return False
        if _is_set_back(values, rule.sweep):
            return False
        return rule.is_absolute or bool(low >= -rule.reach and high <= rule.reach)

    def _by_itself(self, cloud: PointCloud, stamp_ns: int, why: str) -> TimedCloud:
        """Times by this scan alone, for one that breaks the rule; without times, and with the fault `why`, if that fails."""
        with suppress(InputError):
            rule = None if self.is_of_one_scan else learn_rule([Sample(cloud, stamp_ns)], self.rate_hz)
            if rule is not None:
                timed = PointClock(rule, self.rate_hz, True).read(cloud, stamp_ns)
                if timed.times is not None:
                    return timed._replace(fault=f"{why}: {rule.sentence}")
        return TimedCloud(cloud, None, 0, f"{why}: it is not deskewed")


def read_samples(count: int, read: Callable[[int], Sample]) -> dict[int, Sample]:
    """Scans of a recording of `count` from which a rule is learnt, by number.

    These are the first one with points, one in the middle and the last. Unreadable scans are left out.
    """
    first = range(min(count, 2 * _FIRST))
    others = [k for k in dict.fromkeys((count // 2, count - 1)) if k not in first]
    some = chain(islice(readable(first, read), _FIRST), readable(others, read))
    return {index: sample.thin(_ENOUGH) for index, sample in some}


def open_clock(
    samples: Sequence[Sample], rate_hz: float, info: SequenceInfo, notes: list[str], problems: list[str]
) -> PointClock | None:
    """Clock of a recording's points, learnt from a few scans; None without times. Notes say so, and which fields are unread."""
    rule = None
    if not info.motion_compensated:
        try:
            rule = learn_rule(samples, rate_hz, info.point_time_unit, info.point_time_reference)
        except InputError as error:
            problems.append(f"no deskew: {error}")
    clock = None if rule is None else PointClock(rule, rate_hz)
    if clock is not None:
        notes.append(clock.rule.sentence)
        non_returns = max(clock.read(s.cloud, s.stamp_ns).non_returns / len(s.cloud) for s in samples)
        if non_returns:
            notes.append(
                f"up to {non_returns:.1%} of the points of a scan are no returns (zeros or NaN) with times outside the sweep, "
                "which are not looked at"
            )
    read = [] if rule is None else rule.field.removesuffix(")").split(" (")[0].split(" + ")
    fields = dict.fromkeys(name for sample in samples for name in (*sample.cloud.fields, *read))
    unread = dict.fromkeys(name for sample in samples for name in sample.cloud.unread if name not in fields)
    if fields:
        notes.append(
            f"fields of the points: {', '.join(fields)}" + (f"; not read: {', '.join(unread)}" if unread else "")
        )
    times = [column for sample in samples for column in sample.cloud.clocks]
    if rule is None and times and all(column.is_constant for column in times):
        names = dict.fromkeys(column.name for column in times)
        notes.append(f"no point times: {', '.join(names)} holds one value for all points of a scan")
    return clock


def _unwrap(values: NDArray[Any], usable: Bools, width: float) -> tuple[NDArray[Any], int]:
    """Values with overflows of a 32-bit or smaller counter removed, int64, if within `width` then; and how many changed."""
    if values.dtype.kind not in "iu":
        return values, 0
    plain = values.astype(np.int64)
    if values.dtype.itemsize > 4 or not usable.any():
        return plain, 0
    full = 1 << (8 * values.dtype.itemsize)
    first = plain[densest(plain, usable, width)].min()
    beyond = np.asarray((plain - first + full // 2) % full - full // 2 + first)
    # What is no nearer after it did not run over.
    beyond = np.where(np.abs(beyond - first) <= width, beyond, plain)
    return beyond, int(np.count_nonzero((beyond != plain) & usable))


def _step(values: NDArray[Any], usable: Bools, good: Bools, sweep: float) -> tuple[NDArray[Any], Bools] | None:
    """Values with a step of the clock removed, and (N,) which are valid then; None if there is no step.

    good : the largest cluster of times; sweep : usual length of a sweep, in the unit of the values
    """
    width = _WIDER * sweep
    rest = densest(values, usable & ~good, width)
    both = good | rest if np.count_nonzero(rest) > _STEP_SHARE * np.count_nonzero(usable) else good
    some = values[both]
    parts = _parts(some)
    if parts is None or (np.ptp(some) <= width and not _is_set_back(some, sweep)):
        return None
    earlier, later = parts
    if float(np.ptp(some[earlier])) + float(np.ptp(some[later])) > width:
        return None
    some[later] += some[earlier].max() - some[later].min()
    moved = values.copy()
    moved[both] = some
    return moved, both


def _is_set_back(values: NDArray[Any], sweep: float) -> bool:
    """Whether times (N,) span too much for a sweep because the points that come first have the later times."""
    parts = _parts(values) if np.ptp(values) > _LONGER * sweep else None
    if parts is None or not all(values[part][0] < values[part][-1] for part in parts):
        return False
    return bool(values[parts[0]].min() > values[parts[1]].max())


def _parts(values: NDArray[Any]) -> tuple[Bools, Bools] | None:
    """Masks of earlier and later times (N,) split at the largest gap; None if one side has few points or the order is mixed."""
    if len(values) < 2:
        return None
    ordered = np.sort(values)
    is_high = values > ordered[np.argmax(np.diff(ordered))]
    high, changes = np.count_nonzero(is_high), np.count_nonzero(np.diff(is_high))
    if min(high, len(values) - high) <= _STEP_SHARE * len(values) or changes > _OFTEN * len(values):
        return None
    return (is_high, ~is_high) if is_high[0] else (~is_high, is_high)


class PointStamps(NamedTuple):
    """Begin of each scan by its points, (N,) ns, the duration of a sweep, s, and the name of the field."""

    stamps_ns: Longs
    sweep_s: float
    field: str


def point_stamps(scans: Sequence[T], read: Callable[[T], PointCloud], rate_hz: float | None) -> PointStamps | None:
    """Begin of every scan by its points' own clock; None when their times are not absolute or do not increase.

    A scan without valid times gets its stamp from its neighbours. All scans are read, if the first few have absolute times.
    """
    count = len(scans)
    clock = _clock(scans, read, rate_hz)
    if clock is None:
        return None
    begins: dict[int, int] = {}
    for index, scan in enumerate(scans):
        with suppress(InputError):
            begin = clock.begin_ns(read(scan))
            if begin is not None:
                begins[index] = begin
    at, stamps = np.array(list(begins), np.int64), np.array(list(begins.values()), np.int64)
    if not len(at) or 2 * len(at) < count or (np.diff(stamps) < 0.5e9 * clock.rule.sweep_s).any():
        return None
    return PointStamps(filled_stamps(np.arange(count), at, stamps), clock.rule.sweep_s, clock.rule.field)


def _clock(scans: Sequence[T], read: Callable[[T], PointCloud], rate_hz: float | None) -> PointClock | None:
    """Clock of the points, learnt from a few scans, if their times are absolute; else None."""
    samples = list(read_samples(len(scans), lambda index: Sample(read(scans[index]), 0)).values())
    for rate in (rate_hz,) if rate_hz else (DEFAULT_RATE_HZ, _SLOW_HZ):
        with suppress(InputError):
            rule = learn_rule(samples, rate)
            return PointClock(rule, rate) if rule is not None and rule.is_absolute else None
    return None


def onto_recording(points: PointStamps, recording_ns: Stamps) -> tuple[Stamps, str]:
    """Stamps (N,) by the points, shifted to the clock of the recording if their epoch differs, and a sentence about it.

    The scan recorded with the least delay determines the offset.
    """
    ahead = int((points.stamps_ns - recording_ns).max())
    note = f"scan stamps from the absolute times of the points, field {points.field!r}"
    if abs(ahead) <= _OTHER_EPOCH_NS:
        return points.stamps_ns, note
    return points.stamps_ns - ahead, f"{note}, {-ahead * 1e-9:+.3f} s to the clock of the recording"


def step_against(clock: PointClock, samples: Iterable[Sample]) -> float:
    """Step, s, of absolute point times against the headers of a few scans; 0 if below a period."""
    if not clock.rule.is_absolute:
        return 0.0
    begins = [(clock.begin_ns(sample.cloud), sample.stamp_ns) for sample in samples]
    ahead = [begin - stamp for begin, stamp in begins if begin is not None]
    step_s = (max(ahead) - min(ahead)) * 1e-9 if ahead else 0.0
    return step_s if step_s > 1 / clock.rate_hz else 0.0


def points_off(
    clock: PointClock, headers: Stamps, stamps: Stamps, index: int, begin_ns: int, times: NDArray[np.float32] | None
) -> int:
    """Offset of a scan's absolute point times from its header, ns; 0 if they agree, or if the header itself is irregular.

    headers : (N,) of all scans; stamps : (N,) begins of the scans by the headers; begin_ns, times : of the scan's points, by
        their own times. A partial sweep agrees if it begins or ends together with a whole one.
    """
    if not clock.rule.is_absolute or times is None or not len(times):
        return 0
    period = 1e9 / clock.rate_hz
    late = begin_ns - int(stamps[index])
    at_end = late + float(times.max()) * 1e9 - clock.rule.sweep_s * 1e9
    steps = np.diff(headers[max(index - 1, 0) : index + 2])
    is_uneven = bool(np.any(np.abs(steps - period) > 0.5 * period))
    return 0 if min(abs(late), abs(at_end)) <= 0.5 * period or is_uneven else late
