"""Headers of a bag's scans against the absolute times of their points."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from lslam.formats.bag_files import Bag, BagTopic, read_header
from lslam.formats.point_cloud import PointCloud
from lslam.readers.bag_topics import HEADER
from lslam.readers.point_clock import PointClock
from lslam.readers.point_stamps import point_stamps
from lslam.readers.point_times import Sample

Stamps = NDArray[np.int64]
_OTHER_EPOCH_NS = 10**10  # by which the times of points and of recording lie apart


def stamps_by_points(
    bag: Bag,
    topic: BagTopic,
    messages: Stamps,
    recorded: Stamps,
    rate_hz: float,
    cloud: Callable[[int], PointCloud],
) -> tuple[Stamps, str] | None:
    """Stamps (N,) by the absolute times of the points, better than the times of recording where the headers stand still; a note.

    cloud : the points of a scan by its place among the messages (N,); None where headers go on or points have no such times
    """
    ends = (int(messages[0]), int(messages[-1]))
    if len(messages) < 2 or len({read_header(topic, bag.message(topic, k, HEADER)).stamp_ns for k in ends}) > 1:
        return None
    points = point_stamps(len(messages), cloud, rate_hz)
    if points is None:
        return None
    # A clock of another epoch is brought onto that of the recording, by the scan that was recorded with the least delay.
    ahead = int((points.stamps_ns - recorded).max())
    is_other = abs(ahead) > _OTHER_EPOCH_NS
    how = f", {-ahead * 1e-9:+.3f} s to the clock of the recording" if is_other else ""
    note = f"scan stamps from the absolute times of the points, field {points.field!r}{how}"
    return points.stamps_ns - (ahead if is_other else 0), note


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
