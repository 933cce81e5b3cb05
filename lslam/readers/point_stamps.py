"""Stamps of scans by the absolute times of their points, where nothing better exists."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.point_cloud import PointCloud
from lslam.types.scan import is_measured

_UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_SHORTEST_S, _LONGEST_S = 0.005, 2.0  # of a sweep
_AROUND_S = 2.0  # times of points that lie farther from their median are wrong
_LOOKED_AT = 4  # scans that show whether it is a clock at all


class PointStamps(NamedTuple):
    """When the first points of the scans were measured, (N,) ns, how long a sweep takes, s, and the name of the field."""

    stamps_ns: NDArray[np.int64]
    sweep_s: float
    field: str


def point_stamps(count: int, read: Callable[[int], PointCloud]) -> PointStamps | None:
    """Begin of every scan by its points' own clock; None when their times are no clock's readings or do not increase.

    A scan whose points tell nothing gets its stamp from those beside it. All scans are read where the first few have a clock.
    """
    unit = ""
    begins: dict[int, tuple[int, float]] = {}
    field = ""
    for index in range(count):
        try:
            cloud = read(index)
        except InputError:
            continue
        clock = next((clock for clock in cloud.clocks if clock.values.dtype.itemsize == 8), None)
        if clock is not None and len(cloud):
            field, times = clock.name, clock.values[is_measured(cloud.points)]
            unit = unit or _unit_of(times)
            begin = _begin(times, unit) if unit else None
            if begin is not None:
                begins[index] = begin
        if index + 1 == _LOOKED_AT and not _is_clock(begins):
            return None
    if not _is_clock(begins) or 2 * len(begins) < count:
        return None
    at = np.array(list(begins), np.int64)
    known = np.array([begin for begin, _ in begins.values()], np.int64)
    return PointStamps(_filled(count, at, known), float(np.median([s for _, s in begins.values()])), field)


def step_against(headers: Sequence[tuple[int, PointCloud]], rate_hz: float) -> float:
    """By how much, s, absolute times of points step against the headers' stamps, ns, of a few scans; 0 below a period."""
    ahead = []
    for stamp, cloud in headers:
        times = None if cloud.times is None else cloud.times[is_measured(cloud.points)]
        unit = "" if times is None else _unit_of(times)
        begin = _begin(times, unit) if unit and times is not None else None
        if begin is not None:
            ahead.append(begin[0] - stamp)
    step = (max(ahead) - min(ahead)) * 1e-9 if ahead else 0.0
    return step if step > 1 / rate_hz else 0.0


def _is_clock(begins: dict[int, tuple[int, float]]) -> bool:
    """Whether sweeps follow each other without overlapping by half, or the only one begins much later than it lasts."""
    starts = np.array([begin for begin, _ in begins.values()], np.int64)
    sweeps = np.array([sweep for _, sweep in begins.values()])
    if len(starts) == 1:
        return bool(starts[0] * 1e-9 > 10 * sweeps[0])
    return len(starts) > 1 and bool((np.diff(starts) * 1e-9 > 0.5 * np.minimum(sweeps[:-1], sweeps[1:])).all())


def _unit_of(times: NDArray[Any]) -> str:
    return next((unit for unit in _UNITS_NS if _begin(times, unit) is not None), "")


def _begin(times: NDArray[Any], unit: str) -> tuple[int, float] | None:
    """Earliest time of a scan's points, ns, and what they span, s, in `unit`; None when they do not span a sweep."""
    finite = times[np.isfinite(times)] if times.dtype.kind == "f" else times
    if not len(finite):
        return None
    scale = _UNITS_NS[unit]
    # In the field's own type: absolute ns do not fit a float.
    ordered = np.sort(finite)
    off = np.array([float(x) for x in (ordered[-1] - ordered[0], ordered[0])])
    middle = ordered[len(ordered) // 2]
    reach = _AROUND_S * 1e9 / scale
    if off[0] > reach:
        ahead = np.where(ordered < middle, middle - ordered, ordered - middle).astype(np.float64)
        ordered = ordered[ahead <= reach]
    sweep_s = float(ordered[-1] - ordered[0]) * scale * 1e-9
    if not _SHORTEST_S <= sweep_s <= _LONGEST_S or 2 * len(ordered) < len(finite):
        return None
    first = ordered[0]
    begin = int(first) * scale if times.dtype.kind in "iu" else round(float(first) * scale)
    return (begin, sweep_s) if abs(begin) < 2**62 else None


def _filled(count: int, at: NDArray[np.int64], known: NDArray[np.int64]) -> NDArray[np.int64]:
    """(count,) ns: `known` at the indices `at`, evenly between them, at the median step before and after."""
    stamps = np.empty(count, np.int64)
    step = float(np.median(np.diff(known) / np.diff(at))) if len(at) > 1 else 0.0
    index = np.arange(count)
    since = np.interp(index, at, known - known[0])
    since += step * (np.minimum(index - at[0], 0) + np.maximum(index - at[-1], 0))
    stamps[:] = known[0] + np.rint(since).astype(np.int64)
    stamps[at] = known
    return stamps
