"""Points stored ring after ring: how far the beam has turned at each of them, and which ring that makes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import kernel

_FULL = 2 * np.pi


@kernel
def follow(
    points: NDArray[np.float32], backward: float, tilt: float
) -> tuple[Floats, NDArray[np.float32], NDArray[np.int64], float]:
    """Follow the azimuth of points (N, 3) in the order in which they are stored.

    backward : largest step of the azimuth, rad, against the sense of rotation; a larger one is nearly a whole turn forward
    tilt : least change of slope (tangent of elevation) between two points that is a jump

    Returns the angle turned up to each point (N,), rad; the slopes (N,), NaN for points that are zero or not finite, at which
    the angle does not change; the indices (J,) of the points at which the slope jumps; and the share of small steps in the
    sense of rotation, which is that of most steps.
    """
    n = points.shape[0]
    steps = np.zeros(n)
    slope = np.empty(n, np.float32)
    before_x, before_y = 0.0, 0.0
    left, right, total = 0, 0, 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        flat = np.sqrt(x * x + y * y)
        if not (flat > np.float32(0) and np.isfinite(flat) and np.isfinite(z)):
            slope[i] = np.nan
            continue
        slope[i] = z / flat
        ahead_x, ahead_y = np.float64(x), np.float64(y)
        if before_x != 0.0 or before_y != 0.0:
            across = before_x * ahead_y - before_y * ahead_x
            along = before_x * ahead_x + before_y * ahead_y
            t = across / along
            # Four terms of the series are exact to a float64 up to half a degree: most steps.
            if along > 0.0 and abs(t) < 0.01:
                t2 = t * t
                step = t * (1.0 - t2 * (1.0 / 3.0 - t2 * (1.0 / 5.0 - t2 / 7.0)))
            else:
                step = np.arctan2(across, along)
            steps[i] = step
            total += 1
            if 0 < step < backward:
                left += 1
            elif -backward < step < 0:
                right += 1
        before_x, before_y = ahead_x, ahead_y
    sense = 1.0 if left >= right else -1.0
    angles = np.empty(n)
    jumps = np.empty(n, np.int64)
    used = 0
    at = 0.0
    last = -1
    for i in range(n):
        if not np.isnan(slope[i]):
            if last >= 0:
                step = sense * steps[i]
                at += step + _FULL if step < -backward else step
                if abs(slope[i] - slope[last]) > tilt:
                    jumps[used] = i
                    used += 1
            last = i
        angles[i] = at
    return angles, slope, jumps[:used], max(left, right) / max(total, 1)


@kernel
def cut_rings(
    angles: Floats, slope: NDArray[np.float32], seam: float
) -> tuple[NDArray[np.uint16], Floats, NDArray[np.int64]]:
    """Ring (N,) of each point, counted from 0: a new ring begins whenever `angles` (N,), rad, unwrapped, pass the `seam`, rad.

    Returns also the mean slope (rings,) of each ring, and the number of its points with a slope (rings,).
    """
    n = angles.shape[0]
    rings = np.empty(n, np.uint16)
    sums = np.zeros(65536)
    counts = np.zeros(65536, np.int64)
    ring = 0
    highest = np.floor((angles[0] - seam) / _FULL) if n else 0.0
    for i in range(n):
        turn = np.floor((angles[i] - seam) / _FULL)
        if turn > highest:
            highest = turn
            ring = min(ring + 1, 65535)
        rings[i] = ring
        if not np.isnan(slope[i]):
            sums[ring] += slope[i]
            counts[ring] += 1
    return rings, sums[: ring + 1] / np.maximum(counts[: ring + 1], 1), counts[: ring + 1]
