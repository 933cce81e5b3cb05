"""Stamps of scans by the absolute times of their points, where nothing better exists."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.point_cloud import PointCloud
from lslam.readers.listing import DEFAULT_RATE_HZ
from lslam.readers.point_clock import PointClock, read_samples
from lslam.readers.point_times import Sample, learn_rule

_SLOW_HZ = 1.0  # tried where no rate is stated and no sweep is as short as usual


class PointStamps(NamedTuple):
    """When the first points of the scans were measured, (N,) ns, how long a sweep takes, s, and the name of the field."""

    stamps_ns: NDArray[np.int64]
    sweep_s: float
    field: str


def point_stamps(count: int, read: Callable[[int], PointCloud], rate_hz: float | None) -> PointStamps | None:
    """Begin of every scan by its points' own clock; None when their times are no clock's readings or do not increase.

    A scan whose points tell nothing gets its stamp from those beside it. All scans are read where the first few have a clock.
    """
    clock = _clock(count, read, rate_hz)
    if clock is None:
        return None
    begins: dict[int, int] = {}
    for index in range(count):
        with suppress(InputError):
            begin = clock.begin_ns(read(index))
            if begin is not None:
                begins[index] = begin
    at, stamps = np.array(list(begins), np.int64), np.array(list(begins.values()), np.int64)
    if not len(at) or 2 * len(at) < count or (np.diff(stamps) < 0.5e9 * clock.rule.sweep_s).any():
        return None
    return PointStamps(_filled(count, at, stamps), clock.rule.sweep_s, clock.rule.field)


def _clock(count: int, read: Callable[[int], PointCloud], rate_hz: float | None) -> PointClock | None:
    """The clock of the points when its readings are absolute, by a few scans."""
    samples = list(read_samples(count, lambda index: Sample(read(index), 0)).values())
    for rate in (rate_hz,) if rate_hz else (DEFAULT_RATE_HZ, _SLOW_HZ):
        with suppress(InputError):
            rule = learn_rule(samples, rate)
            return PointClock(rule, rate) if rule is not None and rule.is_absolute else None
    return None


def _filled(count: int, at: NDArray[np.int64], stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """(count,) ns: `stamps` at the indices `at`, evenly between them, at the median step before and after."""
    step = float(np.median(np.diff(stamps) / np.diff(at))) if len(at) > 1 else 0.0
    index = np.arange(count)
    since = np.interp(index, at, stamps - stamps[0])
    since += step * (np.minimum(index - at[0], 0) + np.maximum(index - at[-1], 0))
    filled: NDArray[np.int64] = stamps[0] + np.rint(since).astype(np.int64)
    filled[at] = stamps
    return filled
