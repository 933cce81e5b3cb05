"""The motion within a sweep taken out of its points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import poses_at
from lslam.core.kernels import transform
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.registration.preprocessing.prepare import PreparedPoints

# At 200 deg/s one of 32 steps of a 0.1 s sweep turns by 0.6 deg: blending two matrices errs by 4e-6 of the range.
SWEEP_KNOTS = 33


def knots_over(span: Span) -> Floats:
    """(SWEEP_KNOTS,) times over a sweep, s from the scan's stamp; that of the stamp alone where the sweep takes no time."""
    return np.linspace(*span, SWEEP_KNOTS) if span.seconds > 0 else np.zeros(1)


def deskew_points(points: NDArray[Any], times: NDArray[np.float32] | None, prior: MotionPrior) -> NDArray[Any]:
    """Points (N, 3), m, LiDAR frame at their `times` (N,), s from the scan's stamp, as seen from the pose at the stamp.

    Without times, or when the prior knows one instant only, they are returned as they are.
    """
    if times is None or len(times) == 0 or len(prior.times) < 2:
        return points
    moved = np.empty_like(points)
    start, step, knots = _knots(prior)
    transform.deskew(points, times, start, step, knots, moved)
    return moved


def deskew(points: PreparedPoints, prior: MotionPrior) -> PreparedPoints:
    """Both sets of points as seen from the pose at the stamp; the very same object when there is nothing to do."""
    if points.map_times is None or len(prior.times) < 2:
        return points
    return replace(
        points,
        map_points=deskew_points(points.map_points, points.map_times, prior),
        source=deskew_points(points.source, points.source_times, prior),
    )


def _knots(prior: MotionPrior) -> tuple[float, float, Floats]:
    """First time and step, s, and (SWEEP_KNOTS, 3, 4) poses within the sweep relative to the pose at the stamp."""
    within = se3.relative(prior.pose, prior.poses)
    start, end = float(prior.times[0]), float(prior.times[-1])
    if len(within) != SWEEP_KNOTS:
        within = poses_at(prior.times_ns, within, np.round(1e9 * np.linspace(start, end, SWEEP_KNOTS)).astype(np.int64))
    return start, (end - start) / (SWEEP_KNOTS - 1), np.ascontiguousarray(within[:, :3, :])
