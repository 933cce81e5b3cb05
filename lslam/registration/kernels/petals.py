"""Lines of a pattern that does not repeat, in the order of firing: where they turn, and their curvature.

Lin and Zhang 2020, section III, and the authors' code. Two neighbours on each side, as there: over more of them the line itself
bends.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats
from lslam.core.kernels.jit import kernel

PETAL_SIDE = 2  # neighbours on each side


@kernel
def cut_lines(xyz: Floats, steps: Floats, starts: NDArray[np.int64], gap: float, turn: float) -> NDArray[np.int64]:
    """Index of the first point of each line, and the number of points at the end (lines + 1,), among points (K, 3).

    A line ends where the next point is more than `gap`, rad, away. It also ends where its angle to the sensor's x axis is
    largest or smallest, once the angle has turned back by `turn`, rad.

    steps : (K,) rad to the next point; starts : (lasers + 1,), laser k has the points starts[k] to starts[k + 1] - 1
    """
    total = xyz.shape[0]
    begins = np.empty(total + 1, np.int64)
    count = 0
    for k in range(starts.shape[0] - 1):
        low, high, low_at, high_at, way = 0.0, 0.0, 0, 0, 0
        for j in range(starts[k], starts[k + 1]):
            off = math.atan2(math.sqrt(xyz[j, 1] * xyz[j, 1] + xyz[j, 2] * xyz[j, 2]), xyz[j, 0])
            if j == starts[k] or steps[j - 1] > gap:
                begins[count] = j
                count += 1
                low, high, low_at, high_at, way = off, off, j, j, 0
                continue
            if off > high:
                high, high_at = off, j
            if off < low:
                low, low_at = off, j
            if way >= 0 and high - off > turn:
                if way > 0:
                    begins[count] = high_at
                    count += 1
                way, low, low_at = -1, off, j
            elif way <= 0 and off - low > turn:
                if way < 0:
                    begins[count] = low_at
                    count += 1
                way, high, high_at = 1, off, j
    begins[count] = total
    return begins[: count + 1]


@kernel
def smoothness(
    xyz: Floats,
    ranges: Floats,
    starts: NDArray[np.int64],
    left_out: Bools,
    brightness: Floats,
    jump: float,
    jump_slope: float,
    grazing: float,
) -> tuple[Floats, Floats, Floats, Bools]:
    """Curvature (K,) over `PETAL_SIDE` neighbours on each side, its bend, the contrast and the breaks of the lines, each (K,).

    The curvature is NaN for points that are no features: those that are `left_out`, within `PETAL_SIDE` points of a line's end,
    just behind an occlusion boundary, on a surface whose angle with the beam has a cosine above `grazing`, or alone between
    two breaks.

    brightness : (K,) intensities, or (0,); jump, jump_slope, bend and breaks as in `curvature.curvatures`
    The contrast is the difference of brightness between both sides over its sum. It is 0 where the brightness within the
    sides varies by half of that difference or more.
    """
    total = xyz.shape[0]
    curvature = np.full(total, np.nan)
    bend = np.zeros(total)
    contrast = np.zeros(total)
    breaks = np.zeros(total, np.bool_)
    hidden = left_out.copy()
    is_bright = brightness.shape[0] > 0
    for k in range(starts.shape[0] - 1):
        first, last = starts[k], starts[k + 1]
        for j in range(first, last - 1):
            near, far = ranges[j], ranges[j + 1]
            if abs(far - near) > max(jump, jump_slope * min(near, far)):
                breaks[j] = True
                if far > near:
                    hidden[j + 1 : min(j + 1 + PETAL_SIDE, last)] = True
                else:
                    hidden[max(j + 1 - PETAL_SIDE, first) : j + 1] = True
        for c in range(first + PETAL_SIDE, last - PETAL_SIDE):
            if hidden[c]:
                continue
            before, after = 0, 0
            while before < PETAL_SIDE and not breaks[c - before - 1]:
                before += 1
            while after < PETAL_SIDE and not breaks[c + after]:
                after += 1
            is_whole = before + after == 2 * PETAL_SIDE
            x, y, z = xyz[c, 0], xyz[c, 1], xyz[c, 2]
            dx = xyz[c + after, 0] - xyz[c - before, 0]
            dy = xyz[c + after, 1] - xyz[c - before, 1]
            dz = xyz[c + after, 2] - xyz[c - before, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length == 0.0 or abs(x * dx + y * dy + z * dz) > grazing * length * ranges[c]:
                continue
            sx, sy, sz = 0.0, 0.0, 0.0
            for n in range(c - PETAL_SIDE, c + PETAL_SIDE + 1):
                sx += x - xyz[n, 0]
                sy += y - xyz[n, 1]
                sz += z - xyz[n, 2]
            square = sx * sx + sy * sy + sz * sz
            scale = (2 * PETAL_SIDE + 1) * ranges[c]
            curvature[c] = math.sqrt(square) / scale
            if is_whole:
                along = (sx * dx + sy * dy + sz * dz) / length
                square = max(square - along * along, 0.0)
            bend[c] = math.sqrt(square) / scale
            if is_bright and is_whole:
                a, b = brightness[c - 1] + brightness[c - 2], brightness[c + 1] + brightness[c + 2]
                unlike = abs(brightness[c - 1] - brightness[c - 2]) + abs(brightness[c + 1] - brightness[c + 2])
                if a + b > 0.0 and 2.0 * unlike < abs(a - b):
                    contrast[c] = abs(a - b) / (a + b)
    return curvature, bend, contrast, breaks
