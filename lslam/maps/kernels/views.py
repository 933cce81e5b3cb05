"""Which points are seen: of a map in images of a camera, and of a scan in the range images of others.

In an image of a camera a point at range r stands for a square of the map's spacing s, which covers s / r radians: a depth buffer
of splats, the pixels of the points that are seen, and a few views kept of each. Of a scan, votes of other scans say which points
their beams pass through. Points are projected by the parameters of `lslam.core.types.camera.Lens`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Ints
from lslam.core.kernels.jit import inline, kernel

_MIX_A, _MIX_B = -4658895280553007687, -7723592293110705685  # of splitmix64, as int64


@inline
def project(x: float, y: float, z: float, lens: Floats) -> tuple[float, float]:
    """Pixel of a point of the camera's frame, m; NaN where the lens does not see: behind it, or where its model folds back."""
    flat = np.sqrt(x * x + y * y)
    if lens[0] > 0.5:
        angle = np.arctan2(flat, z)
        if not angle <= lens[13]:
            return np.nan, np.nan
        a2 = angle * angle
        out = angle * (1.0 + a2 * (lens[5] + a2 * (lens[6] + a2 * (lens[7] + a2 * lens[8]))))
        share = out / flat if flat > 0.0 else 0.0
        return lens[1] * x * share + lens[3], lens[2] * y * share + lens[4]
    if not (z > 0.0 and flat <= lens[13] * z):
        return np.nan, np.nan
    a, b = x / z, y / z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    radial /= 1.0 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    u = a * radial + 2.0 * lens[7] * a * b + lens[8] * (r2 + 2.0 * a * a)
    v = b * radial + lens[7] * (r2 + 2.0 * b * b) + 2.0 * lens[8] * a * b
    return lens[1] * u + lens[3], lens[2] * v + lens[4]


@kernel
def project_all(points: Floats, lens: Floats, pixels: Floats) -> None:
    """Write the pixels (N, 2) of points (N, 3) of the camera's frame, m; NaN where the lens does not see."""
    for i in range(len(points)):
        u, v = project(points[i, 0], points[i, 1], points[i, 2], lens)
        pixels[i, 0], pixels[i, 1] = u, v


@kernel
def shifted_means(image: NDArray[np.float32], pixels: Floats, weights: Floats, means: Floats) -> None:
    """Write the weighted mean of the image over pixels (N, 2) moved by each shift into `means` (2R+1, 2R+1), rows and columns.

    Pixels that some shift moves out of the image are left out of all; zeros where none is left.
    """
    height, width = image.shape
    reach = means.shape[0] // 2
    means[:] = 0.0
    total = 0.0
    for i in range(len(pixels)):
        if not (pixels[i, 0] >= reach and pixels[i, 1] >= reach):
            continue
        u, v = int(np.rint(pixels[i, 0])), int(np.rint(pixels[i, 1]))
        if u + reach >= width or v + reach >= height:
            continue
        total += weights[i]
        for row in range(-reach, reach + 1):
            for column in range(-reach, reach + 1):
                means[row + reach, column + reach] += weights[i] * image[v + row, u + column]
    if total > 0.0:
        means /= total


@inline
def _share(point: int, view: int) -> float:
    """Pseudorandom number in (0, 1], the same for a point and a view in every run."""
    h = (point * 1000003 + view + 1) * -7046029254386353131
    h = (h ^ ((h >> 30) & 0x3FFFFFFFF)) * _MIX_A
    h = (h ^ ((h >> 27) & 0x1FFFFFFFFF)) * _MIX_B
    h = h ^ ((h >> 31) & 0x1FFFFFFFF)
    return (float((h >> 11) & 0x1FFFFFFFFFFFFF) + 1.0) / 9007199254740993.0


@inline
def _seen_from(points: NDArray[np.float32], i: int, T: Floats, lens: Floats) -> tuple[float, float, float]:
    """Pixel and range, m, of point i for a camera at T (4, 4); NaN where the lens does not see it."""
    px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
    x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
    y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
    u, v = project(x, y, z, lens)
    return u, v, np.sqrt(x * x + y * y + z * z)


@inline
def _cosine(points: NDArray[np.float32], normals: NDArray[np.int8], i: int, T: Floats, far: float) -> float:
    """Cosine between the normal of point i, in 127ths, and the ray to it; 1 where the normal is unknown, 0."""
    nx, ny, nz = normals[i, 0] / 127.0, normals[i, 1] / 127.0, normals[i, 2] / 127.0
    if not nx * nx + ny * ny + nz * nz > 0.0:
        return 1.0
    # The camera's place in the frame of the points is -R^T t.
    cx = points[i, 0] + T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3]
    cy = points[i, 1] + T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3]
    cz = points[i, 2] + T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3]
    return float(min(abs(nx * cx + ny * cy + nz * cz) / far, 1.0))


@inline
def _resolution(cosine: float, spacing: float) -> float:
    """m by which ranges in one pixel differ on one surface: the spacing, and what a neighbour on a slant is nearer."""
    return spacing * (1.0 + 0.5 * math.sqrt(2.0) * math.sqrt(1.0 - cosine * cosine) / cosine)


@inline
def _is_gone(
    points: NDArray[np.float32],
    normals: NDArray[np.int8],
    i: int,
    T: Floats,
    spacing: float,
    u: float,
    v: float,
    far: float,
    behind: NDArray[np.float32],
) -> bool:
    """Whether a scan measured something behind point i: `behind` has a longer range than `far`, m, at pixel u, v.

    The map's point is of something that has moved away.
    """
    height, width = behind.shape
    if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
        return False
    beyond = behind[int(np.rint(v)), int(np.rint(u))] - far
    if not beyond > spacing:
        return False
    return bool(beyond > _resolution(_cosine(points, normals, i, T, far), spacing))


@kernel
def splat(
    points: NDArray[np.float32],
    normals: NDArray[np.int8],
    runs: NDArray[np.int64],
    T: Floats,
    lens: Floats,
    spacing: float,
    reach: float,
    behind: NDArray[np.float32],
    depth: NDArray[np.float32],
) -> None:
    """Enter the points of `runs` (R, 2), begin and end, into the buffer of ranges `depth` (height, width), m.

    T : (4, 4) camera from points; spacing, reach : m; farther points are left out
    normals : (N, 3) in 127ths, 0 where unknown
    behind : (height, width) m, range measured about when the image was taken, -inf where none; points that it passes through
        are left out
    """
    height, width = depth.shape
    for r in range(len(runs)):
        for i in range(runs[r, 0], runs[r, 1]):
            u, v, far = _seen_from(points, i, T, lens)
            # Within a spacing of its point the camera would see nothing else.
            if not (far > spacing and far <= reach):
                continue
            half_u, half_v = 0.5 * spacing / far * lens[1], 0.5 * spacing / far * lens[2]
            if not (u + half_u > -0.5 and v + half_v > -0.5 and u - half_u < width - 0.5 and v - half_v < height - 0.5):
                continue
            if _is_gone(points, normals, i, T, spacing, u, v, far, behind):
                continue
            first_u, last_u = max(int(np.rint(u - half_u)), 0), min(int(np.rint(u + half_u)), width - 1)
            first_v, last_v = max(int(np.rint(v - half_v)), 0), min(int(np.rint(v + half_v)), height - 1)
            for row in range(first_v, last_v + 1):
                for column in range(first_u, last_u + 1):
                    if far < depth[row, column]:
                        depth[row, column] = far


@kernel
def collect(
    points: NDArray[np.float32],
    normals: NDArray[np.int8],
    runs: NDArray[np.int64],
    T: Floats,
    lens: Floats,
    spacing: float,
    reach: float,
    behind: NDArray[np.float32],
    depth: NDArray[np.float32],
    image: NDArray[np.uint8],
    view: int,
    weight: float,
    ranks: NDArray[np.float32],
    views: Ints,
    colours: NDArray[np.uint8],
) -> int:
    """Enter the colour of every point that the image shows into the views kept of it. Returns the number of such points.

    A point is seen if nothing lies before it by more than the map's depth resolution: its spacing, and on a slanted surface what
    a neighbour whose splat covers the same pixel is nearer; and if nothing `behind` is seen through it. Where the number of
    views exceeds the room, priority sampling (Duffield et al. 2007) keeps each in proportion to the solid angle that the point's
    surface covers in it.

    normals, behind : as of `splat`; depth : from it; view : number of the image
    ranks, views, colours : (N, K), (N, K) and (N, K, 3) of the views kept; rank 0 where there is none
    """
    height, width = depth.shape
    count = 0
    for r in range(len(runs)):
        for i in range(runs[r, 0], runs[r, 1]):
            u, v, far = _seen_from(points, i, T, lens)
            if not (far > spacing and far <= reach):
                continue
            if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
                continue
            row, column = int(np.rint(v)), int(np.rint(u))
            cosine = _cosine(points, normals, i, T, far)
            pixels = cosine * lens[1] * lens[2] * (spacing / far) ** 2
            if pixels < 1.0:
                continue
            if far - depth[row, column] > _resolution(cosine, spacing):
                continue
            if _is_gone(points, normals, i, T, spacing, u, v, far, behind):
                continue
            count += 1
            rank = weight * pixels / _share(i, view)
            slot = 0
            for k in range(1, ranks.shape[1]):
                if ranks[i, k] < ranks[i, slot]:
                    slot = k
            if rank > ranks[i, slot]:
                ranks[i, slot], views[i, slot] = rank, view
                for c in range(3):
                    colours[i, slot, c] = image[row, column, c]
    return count


@kernel
def medians(
    ranks: NDArray[np.float32],
    views: Ints,
    colours: NDArray[np.uint8],
    gains: Floats,
    out: NDArray[np.uint8],
) -> int:
    """Write the vector median (Astola et al. 1990) of the views of each point into `out` (N, 3); returns how many have none.

    It is the view nearest to all others, and of two the one of higher rank: always a colour that a camera saw. Points without a
    view keep what `out` holds.

    gains : (V, 3) brightness of each image by channel, which is divided out
    """
    room = ranks.shape[1]
    seen = np.empty((room, 3))
    rank = np.empty(room)
    unseen = 0
    for i in range(len(ranks)):
        n = 0
        for k in range(room):
            if ranks[i, k] > 0.0:
                rank[n] = ranks[i, k]
                for c in range(3):
                    seen[n, c] = colours[i, k, c] / gains[views[i, k], c]
                n += 1
        if n == 0:
            unseen += 1
            continue
        best, least = 0, np.inf
        for k in range(n):
            total = 0.0
            for j in range(n):
                for c in range(3):
                    total += abs(seen[k, c] - seen[j, c])
            if total < least or (total == least and rank[k] > rank[best]):
                best, least = k, total
        for c in range(3):
            out[i, c] = np.uint8(min(max(np.rint(seen[best, c]), 0.0), 255.0))
    return unseen


@inline
def _pixel(x: float, y: float, z: float, low: float, inverse: float, columns: int) -> tuple[int, int]:
    """Row (elevation above `low`, rad) and column (azimuth) of a direction; the row may lie outside the image."""
    row = math.floor((math.atan2(z, math.sqrt(x * x + y * y)) - low) * inverse)
    column = int((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * columns)
    return row, column - columns if column >= columns else column


@kernel
def nearest_ranges(
    points: NDArray[np.float32], stands: Bools, rows: int, columns: int, low: float, inverse: float
) -> NDArray[np.float32]:
    """Range image (rows, columns, 3) of points (N, 3), sensor frame: range, height and clear range of each pixel, m.

    The range is that of the nearest point, inf without one. The height, along the sensor's z, is that of the same point, NaN
    unless it is ground. The clear range is the least range in the pixel and the eight around it, 0 where the row below is
    empty.
    stands : (N,) whether a point is off the ground; low : elevation of the lowest row's lower edge, rad; inverse : rows per rad
    """
    image = np.full((rows, columns, 3), np.float32(np.inf))
    image[:, :, 1] = np.nan
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        r2 = x * x + y * y + z * z
        if not (r2 > 1e-6 and np.isfinite(r2)):
            continue
        row, column = _pixel(x, y, z, low, inverse, columns)
        if 0 <= row < rows:
            r = np.float32(math.sqrt(r2))
            if r < image[row, column, 0]:
                image[row, column, 0] = r
                image[row, column, 1] = np.nan if stands[i] else z
    for row in range(rows):
        for column in range(columns):
            image[row, column, 2] = _clear(image, row, column)
    return image


@inline
def _clear(image: NDArray[np.float32], row: int, column: int) -> np.float32:
    """Least range in a pixel and the eight around it, m; 0 where the row below is empty."""
    rows, columns = image.shape[:2]
    left = column - 1 if column > 0 else columns - 1
    right = column + 1 if column + 1 < columns else 0
    nearest = np.float32(np.inf)
    for a in range(max(row - 1, 0), min(row + 2, rows)):
        nearest = min(nearest, image[a, left, 0], image[a, column, 0], image[a, right, 0])
        if a < row and not np.isfinite(nearest):
            return np.float32(0.0)
    return nearest if row > 0 else np.float32(0.0)


@kernel
def vote(
    points: NDArray[np.float32],
    T: Floats,
    image: NDArray[np.float32],
    low: float,
    inverse: float,
    margin: float,
    slope: float,
    step: float,
    later: int,
    free: NDArray[np.int16],
    hits: NDArray[np.int16],
) -> None:
    """Count for each point whether the scan of `image` passed through its place or measured a surface there.

    It passed through, counted in `free` (N,), when all ranges in the point's pixel and the eight around it are larger than the
    point's by the tolerance, and the row below is not empty. So edges of objects and ground at grazing angles are not free.
    It measured a surface, counted in `hits` (N,), when the range of the pixel differs by the tolerance at most. Ground does so
    only when its height differs by `step` times the tolerance at most: it does not confirm the foot of an object.

    points : (N, 3), m, in their own frame; T : (4, 4) from there to the frame of the image
    low, inverse : of the image, as in `nearest_ranges`
    margin, slope : the tolerance is `margin` + `slope` r, m, for a point at range r
    later : number of images still to come, this one included; a point with more hits than that above its free counts is
        skipped, since its majority is decided
    """
    rows, columns = image.shape[:2]
    for i in range(len(points)):
        if hits[i] - free[i] > later:
            continue
        px, py, pz = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        r = math.sqrt(x * x + y * y + z * z)
        if not (r > 0.5 and np.isfinite(r)):
            continue
        row, column = _pixel(x, y, z, low, inverse, columns)
        if row < 1 or row >= rows or not np.isfinite(image[row, column, 0]):
            continue
        reach = margin + slope * r
        if abs(image[row, column, 0] - r) <= reach:
            if not abs(image[row, column, 1] - z) > step * reach:
                hits[i] += 1
        elif image[row, column, 2] > r + reach:
            free[i] += 1
