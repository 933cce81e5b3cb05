"""A scan as a range image, ring by azimuth: its ground and its clusters (LeGO-LOAM, Shan and Englot 2018, section III).

Pixel `row * columns + column`: row 0 is the lowest ring, columns count the azimuth and close upon themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Ints
from lslam.core.kernels.jit import inline, kernel

_REACH = 2  # pixels without a return that neighbours may have between them


@kernel
def row_slopes(points: Floats, starts: NDArray[np.int64]) -> Floats:
    """Mean tangent of elevation (rings,) of points (K, 3) in ring order, NaN for rings without points.

    starts : (rings + 1,) where each ring starts in them
    """
    slopes = np.full(starts.shape[0] - 1, np.nan)
    for k in range(slopes.shape[0]):
        total = 0.0
        for j in range(starts[k], starts[k + 1]):
            total += points[j, 2] / np.sqrt(points[j, 0] ** 2 + points[j, 1] ** 2 + 1e-12)
        if starts[k + 1] > starts[k]:
            slopes[k] = total / (starts[k + 1] - starts[k])
    return slopes


@kernel
def project(
    points: Floats,
    ranges: Floats,
    starts: NDArray[np.int64],
    row: NDArray[np.int64],
    rows: int,
    columns: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pixel (K,) of every point, and the index of the nearest point in every pixel (rows * columns,), -1 for none.

    points : (K, 3), m, in ring order; ranges : (K,), m; starts : (rings + 1,), ring k has the points starts[k] to
        starts[k + 1] - 1
    row : (rings,) image row of each ring
    """
    pixel = np.empty(points.shape[0], np.int64)
    nearest = np.full(rows * columns, -1, np.int64)
    scale = columns / (2 * np.pi)
    for k in range(starts.shape[0] - 1):
        for j in range(starts[k], starts[k + 1]):
            column = np.int64(np.floor((np.arctan2(points[j, 1], points[j, 0]) + np.pi) * scale)) % columns
            p = row[k] * columns + column
            pixel[j] = p
            if nearest[p] < 0 or ranges[j] < ranges[nearest[p]]:
                nearest[p] = j
    return pixel, nearest


@kernel
def find_ground(
    points: Floats,
    nearest: NDArray[np.int64],
    columns: int,
    up: Floats,
    floor: float,
    slope: float,
    baseline: float,
    tolerance: float,
) -> Bools:
    """Whether the point of each pixel (rows * columns,) lies on the ground.

    Each column is followed from its lowest pixel. The first ground point of a column lies within `slope` and `tolerance`, m,
    of the floor, and the line from one ground point to the next is no steeper than `slope`. Neither is the line to the next
    pixel above that is `baseline`, m, away, unless the point is level with the ground before it: an object may stand behind.

    points : (K, 3), m; nearest : (rows * columns,) index of a pixel's point, see `project`
    up : (3,) unit vector; floor : height of the ground along `up` under the sensor, m; slope : tangent
    """
    rows = nearest.shape[0] // columns
    is_ground = np.zeros(nearest.shape[0], np.bool_)
    out = np.empty(rows)
    height = np.empty(rows)
    for column in range(columns):
        for r in range(rows):
            j = nearest[r * columns + column]
            out[r] = -1.0
            if j >= 0:
                x, y, z = points[j, 0], points[j, 1], points[j, 2]
                height[r] = up[0] * x + up[1] * y + up[2] * z
                out[r] = np.sqrt(max(x * x + y * y + z * z - height[r] * height[r], 0.0))
        last_out, last_height = 0.0, floor
        for r in range(rows):
            if out[r] < 0:
                continue
            rise = abs(height[r] - last_height)
            allowed = slope * abs(out[r] - last_out)
            if rise > allowed + tolerance:
                continue
            for above in range(r + 1, rows):
                up_by, out_by = abs(height[above] - height[r]), out[above] - out[r]
                if out[above] < 0 or (up_by < baseline and abs(out_by) < baseline):
                    continue
                if up_by <= slope * out_by + 0.5 * tolerance or (
                    rise <= min(allowed, tolerance) and out_by >= baseline
                ):
                    is_ground[r * columns + column] = True
                    last_out, last_height = out[r], height[r]
                break
    return is_ground


@inline
def _is_one_surface(a: float, b: float, sine: float, cosine: float, tangent: float) -> bool:
    """Whether the points at ranges a and b, m, lie on one object: the line through both makes a large angle with the beam.

    sine, cosine : of the angle between the beams; tangent : of the least angle of the line with the beam of the farther point
    """
    far, near = max(a, b), min(a, b)
    across, along = near * sine, far - near * cosine
    return along <= 0.0 or across > tangent * along


@kernel
def cluster(
    ranges: Floats,
    nearest: NDArray[np.int64],
    is_ground: Bools,
    columns: int,
    elevation: Floats,
    angle: float,
    least: tuple[int, int, int],
) -> Ints:
    """Label (rows * columns,) of the pixels off the ground: 1, 2, ... for clusters, 0 for pixels in none.

    Neighbours belong to one cluster when the line through them makes more than `angle`, rad, with the beam. Clusters are
    filled breadth first, in the order of their lowest, leftmost pixels.

    ranges : (K,) m; elevation : (rows,) rad; least : least number of pixels of a cluster, or of pixels and of rows they span
    """
    total = nearest.shape[0]
    rows = total // columns
    labels = np.zeros(total, np.int32)
    # Empty pixels and ground belong to no cluster.
    seen = np.ones(total, np.bool_)
    image = np.zeros(total)
    for p in range(total):
        if nearest[p] >= 0:
            image[p] = ranges[nearest[p]]
            seen[p] = is_ground[p]
    queue = np.empty(total, np.int64)
    tangent = np.tan(angle)
    sines = np.zeros((rows + 1, _REACH + 2))
    cosines = np.zeros((rows + 1, _REACH + 2))
    for step in range(1, _REACH + 2):
        for r in range(rows - step):
            sines[r, step], cosines[r, step] = (
                np.sin(elevation[r + step] - elevation[r]),
                np.cos(elevation[r + step] - elevation[r]),
            )
        sines[rows, step], cosines[rows, step] = np.sin(2 * np.pi / columns * step), np.cos(2 * np.pi / columns * step)
    touched = np.zeros(rows, np.int64)
    label = 0
    for seed in range(total):
        if seen[seed]:
            continue
        head, tail = 0, 1
        queue[0] = seed
        seen[seed] = True
        rows_touched = 0
        while head < tail:
            p = queue[head]
            head += 1
            r, c = p // columns, p % columns
            if touched[r] != seed + 1:
                touched[r] = seed + 1
                rows_touched += 1
            here = image[p]
            for side in range(4):
                for step in range(1, _REACH + 2):
                    other, column, angles = r, c, rows
                    if side < 2:
                        column = (c + (step if side else columns - step)) % columns
                    else:
                        other = r + (step if side == 2 else -step)
                        if other < 0 or other >= rows:
                            break
                        angles = min(r, other)
                    q = other * columns + column
                    if image[q] == 0.0:
                        continue
                    if not seen[q] and _is_one_surface(
                        here, image[q], sines[angles, step], cosines[angles, step], tangent
                    ):
                        seen[q] = True
                        queue[tail] = q
                        tail += 1
                    break
        if tail >= least[0] or (tail >= least[1] and rows_touched >= least[2]):
            label += 1
            for n in range(tail):
                labels[queue[n]] = label
    return labels


@kernel
def point_labels(
    ranges: Floats,
    order: NDArray[np.int64],
    pixel: NDArray[np.int64],
    nearest: NDArray[np.int64],
    is_ground: Bools,
    labels: Ints,
    same: float,
    count: int,
) -> tuple[Bools, Ints]:
    """Whether each point of a scan (count,) is ground, and its label (count,), from those of its pixel.

    A point takes those of its pixel when its range is within `same`, m, of the pixel's nearest point. Otherwise it is not
    ground and has label 0.
    """
    ground_of = np.zeros(count, np.bool_)
    labels_of = np.zeros(count, np.int32)
    for j in range(order.shape[0]):
        p = pixel[j]
        if ranges[j] - ranges[nearest[p]] < same:
            ground_of[order[j]] = is_ground[p]
            labels_of[order[j]] = labels[p]
    return ground_of, labels_of
