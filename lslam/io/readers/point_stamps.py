"""Stamps of scans by the absolute times of their points, where nothing better exists, and these times against the headers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.readers.listing import DEFAULT_RATE_HZ, filled_stamps
from lslam.io.readers.point_clock import PointClock, read_samples
from lslam.io.readers.point_times import Sample, learn_rule

Stamps = NDArray[np.int64]
T = TypeVar("T")
_OTHER_EPOCH_NS = 10**10  # by which the times of points and of recording lie apart
_SLOW_HZ = 1.0  # tried where no rate is stated and no sweep is as short as usual


class PointStamps(NamedTuple):
    """When the first points of the scans were measured, (N,) ns, how long a sweep takes, s, and the name of the field."""

    stamps_ns: NDArray[np.int64]
    sweep_s: float
    field: str


def point_stamps(scans: Sequence[T], read: Callable[[T], PointCloud], rate_hz: float | None) -> PointStamps | None:
    """Begin of every scan by its points' own clock; None when their times are no clock's readings or do not increase.

    A scan whose points tell nothing gets its stamp from those beside it. All scans are read where the first few have a clock.
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
    """The clock of the points when its readings are absolute, by a few scans."""
    samples = list(read_samples(len(scans), lambda index: Sample(read(scans[index]), 0)).values())
    for rate in (rate_hz,) if rate_hz else (DEFAULT_RATE_HZ, _SLOW_HZ):
        with suppress(InputError):
            rule = learn_rule(samples, rate)
            return PointClock(rule, rate) if rule is not None and rule.is_absolute else None
    return None


def onto_recording(points: PointStamps, recorded: Stamps) -> tuple[Stamps, str]:
    """Stamps (N,) by the points, on the clock of the recording where theirs is of another epoch, and a sentence.

    The scan that was recorded with the least delay tells how far apart the clocks are.
    """
    ahead = int((points.stamps_ns - recorded).max())
    note = f"scan stamps from the absolute times of the points, field {points.field!r}"
    if abs(ahead) <= _OTHER_EPOCH_NS:
        return points.stamps_ns, note
    return points.stamps_ns - ahead, f"{note}, {-ahead * 1e-9:+.3f} s to the clock of the recording"


def step_against(clock: PointClock, samples: Iterable[Sample]) -> float:
    """By how much, s, absolute times of points step against the headers of a few scans; 0 below a period."""
    if not clock.rule.is_absolute:
        return 0.0
    begins = [(clock.begin_ns(sample.cloud), sample.stamp_ns) for sample in samples]
    ahead = [begin - stamp for begin, stamp in begins if begin is not None]
    step_s = (max(ahead) - min(ahead)) * 1e-9 if ahead else 0.0
    return step_s if step_s > 1 / clock.rate_hz else 0.0


def points_off(
    clock: PointClock, headers: Stamps, stamps: Stamps, index: int, begin_ns: int, times: NDArray[np.float32] | None
) -> int:
    """By how much the absolute times of a scan's points contradict its header, ns; 0 where they do not, or it is uneven itself.

    headers : (N,) of all scans; stamps : (N,) their begins as they follow from these; begin_ns, times : when the points of the
    scan were measured. A part of a sweep begins or ends with a whole one.
    """
    if not clock.rule.is_absolute or times is None or not len(times):
        return 0
    period = 1e9 / clock.rate_hz
    late = begin_ns - int(stamps[index])
    at_end = late + float(times.max()) * 1e9 - clock.rule.sweep_s * 1e9
    steps = np.diff(headers[max(index - 1, 0) : index + 2])
    is_uneven = bool(np.any(np.abs(steps - period) > 0.5 * period))
    return 0 if min(abs(late), abs(at_end)) <= 0.5 * period or is_uneven else late
