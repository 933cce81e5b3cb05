"""Points stored ring after ring: how far the beam has turned at each of them, and which ring that makes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import kernel

_FULL = 2 * np.pi


@kernel
def follow(
    points: NDArray[np.float32], backward: float, tilt: float
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int64], float]:
    """Follow the azimuth from point to point (N, 3).

    backward : rad that the azimuth may go back before that counts as nearly a whole turn onwards
    tilt : change of slope (tangent of elevation) from point to point that is a jump

    Returns the angle turned up to each point (N,), rad, the slopes (N,), NaN for points that are none (zero, not finite; they
    turn nothing), the points (J,) at which the slope jumps, and the share of steps that are small and in the sense of
    turning, which is the sense of most.
    """
    n = points.shape[0]
    azimuth = np.empty(n, np.float32)
    slope = np.empty(n, np.float32)
    last = -1
    left, right, total = 0, 0, 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        flat = np.sqrt(x * x + y * y)
        if not (flat > np.float32(0) and np.isfinite(flat) and np.isfinite(z)):
            slope[i] = np.nan
            continue
        azimuth[i] = np.arctan2(y, x)
        slope[i] = z / flat
        if last >= 0:
            step = np.float64(azimuth[i]) - np.float64(azimuth[last])
            step -= _FULL * np.rint(step / _FULL)
            total += 1
            if 0 < step < backward:
                left += 1
            elif -backward < step < 0:
                right += 1
        last = i
    sense = 1.0 if left >= right else -1.0
    turned = np.empty(n)
    jumps = np.empty(n, np.int64)
    used = 0
    at = 0.0
    last = -1
    for i in range(n):
        if not np.isnan(slope[i]):
            if last >= 0:
                step = sense * (np.float64(azimuth[i]) - np.float64(azimuth[last]))
                step -= _FULL * np.rint(step / _FULL)
                at += step + _FULL if step < -backward else step
                if abs(slope[i] - slope[last]) > tilt:
                    jumps[used] = i
                    used += 1
            last = i
        turned[i] = at
    return turned, slope, jumps[:used], max(left, right) / max(total, 1)


@kernel
def cut(
    turned: NDArray[np.float64], slope: NDArray[np.float32], seam: float
) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.int64]]:
    """Rings (N,), from 0, of points that turned so far (N,), rad: a new one each time the angle passes the `seam`.

    Also the mean slope (rings,) and the number (rings,) of the points of each that have one.
    """
    n = turned.shape[0]
    rings = np.empty(n, np.uint16)
    sums = np.zeros(65536)
    counts = np.zeros(65536, np.int64)
    ring = 0
    highest = np.floor((turned[0] - seam) / _FULL) if n else 0.0
    for i in range(n):
        turn = np.floor((turned[i] - seam) / _FULL)
        if turn > highest:
            highest = turn
            ring = min(ring + 1, 65535)
        rings[i] = ring
        if not np.isnan(slope[i]):
            sums[ring] += slope[i]
            counts[ring] += 1
    return rings, sums[: ring + 1] / np.maximum(counts[: ring + 1], 1), counts[: ring + 1]
