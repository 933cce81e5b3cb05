"""Colour palette for heights, and density images as small PNG files with transparency, without an imaging library.

Crops are squares of a map seen from above: the places with most structure, and their images.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs

# Evenly spaced; between two of them colours are mixed.
VIRIDIS = (
    "440154",
    "481a6c",
    "472f7d",
    "414487",
    "39568c",
    "31688e",
    "2a788e",
    "23888e",
    "1f988b",
    "22a884",
    "35b779",
    "54c568",
    "7ad151",
    "a5db36",
    "d2e21b",
    "fde725",
)


def palette() -> NDArray[np.uint8]:
    """(16, 3) palette as red, green, blue."""
    return np.array([[int(colour[i : i + 2], 16) for i in (0, 2, 4)] for colour in VIRIDIS], np.uint8)


def usual_range(values: NDArray[np.floating], left_out: float = 2.0) -> tuple[float, float]:
    """Range of the finite values (0, 1 without any) without `left_out` % at each end: outliers do not compress the colours."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, [left_out, 100 - left_out]))
    return low, max(high, low + 1e-3)


LEVELS = 16  # four bits per pixel


def density_png(image: NDArray[Any], top: float | None = None) -> bytes:
    """PNG of a density image (H, W): black, with an opacity that grows with the logarithm of the density.

    The palette has 16 levels. Densities from `top` on, by default the 99.5th percentile of the occupied pixels, are opaque.
    Empty and non-finite pixels are transparent, so the page's paper shows through in light and dark.
    """
    levels = _levels(np.nan_to_num(np.asarray(image, np.float32), nan=0.0, posinf=0.0, neginf=0.0), top)
    height, width = levels.shape
    even = np.zeros((height, width + width % 2), np.uint8)
    even[:, :width] = levels
    packed = (even[:, ::2] << 4) | even[:, 1::2]
    raw = np.zeros((height, 1 + packed.shape[1]), np.uint8)  # column 0: filter type none
    raw[:, 1:] = packed
    alpha = bytes(round(255 * (i / (LEVELS - 1)) ** 0.8) for i in range(LEVELS))
    return _png(
        [
            (b"IHDR", struct.pack(">IIBBBBB", width, height, 4, 3, 0, 0, 0)),
            (b"PLTE", bytes(3 * LEVELS)),
            (b"tRNS", alpha),
            (b"IDAT", zlib.compress(raw.tobytes(), 6)),
            (b"IEND", b""),
        ]
    )


def density_grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Grey values (H, W) of a density image: 255 where nothing is, darker with the logarithm of the density, in 16 levels."""
    return np.asarray(255 - (255 // (LEVELS - 1)) * _levels(np.asarray(image, np.float32), None), np.uint8)


def halve(image: NDArray[Any], values: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Density image (H, W) and its values at half the resolution: densities are summed, values averaged by density."""
    height, width = (2 * (n // 2) for n in image.shape)
    blocks = (height // 2, 2, width // 2, 2)
    density = np.nan_to_num(np.asarray(image[:height, :width], np.float32)).reshape(blocks)
    weighted = np.nan_to_num(np.asarray(values[:height, :width], np.float32)).reshape(blocks) * density
    sums = density.sum((1, 3))
    return sums, np.divide(weighted.sum((1, 3)), sums, out=np.full_like(sums, np.nan), where=sums > 0)


def coloured_png(image: NDArray[Any], values: NDArray[Any], low: float, high: float) -> bytes:
    """PNG of a density image (H, W): colours show `values` (H, W) from `low` to `high`, opacities the density.

    Of 16 colours and 16 opacities; empty pixels are transparent.
    """
    levels = _levels(np.nan_to_num(np.asarray(image, np.float32), nan=0.0, posinf=0.0, neginf=0.0), None)
    share = (np.nan_to_num(np.asarray(values, np.float32), nan=low) - low) / (high - low)
    colour = np.rint(np.clip(share, 0, 1) * (len(VIRIDIS) - 1)).astype(np.uint8)
    raw = np.zeros((levels.shape[0], 1 + levels.shape[1]), np.uint8)  # column 0: filter type none
    raw[:, 1:] = np.where(levels > 0, colour * LEVELS + levels, 0)
    alpha = [round(255 * (0.4 + 0.6 * i / (LEVELS - 1)) if i else 0) for i in range(LEVELS)]
    header = struct.pack(">IIBBBBB", levels.shape[1], levels.shape[0], 8, 3, 0, 0, 0)
    return _png(
        [
            (b"IHDR", header),
            (b"PLTE", palette().repeat(LEVELS, axis=0).tobytes()),
            (b"tRNS", bytes(alpha * len(VIRIDIS))),
            (b"IDAT", zlib.compress(raw.tobytes(), 6)),
            (b"IEND", b""),
        ]
    )


def grey_png(image: NDArray[np.uint8]) -> bytes:
    """PNG of grey values (H, W), 0 black to 255 white."""
    height, width = image.shape
    raw = np.zeros((height, 1 + width), np.uint8)  # column 0: filter type none
    raw[:, 1:] = image
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return _png([(b"IHDR", header), (b"IDAT", zlib.compress(raw.tobytes(), 6)), (b"IEND", b"")])


def _png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    """PNG file of its chunks (type, data)."""
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def data_uri(png: bytes) -> str:
    """Image as a data URI, embedded in the page."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _levels(image: NDArray[np.float32], top: float | None) -> NDArray[np.uint8]:
    """Grey levels (H, W) of counts, on a logarithmic scale; `top` counts, by default the 99.5 % quantile, are white."""
    occupied = image[image > 0]
    if not len(occupied):
        return np.zeros(image.shape, np.uint8)
    if top is None:
        rank = int(np.ceil(0.995 * (len(occupied) - 1)))
        top = float(np.partition(occupied, rank)[rank])
    share = np.log1p(np.maximum(image, 0)) / np.log1p(top)
    # Anything occupied is seen: the faintest level of a point is 2.
    return np.where(image > 0, np.clip(np.rint(share * (LEVELS - 1)), 2, LEVELS - 1), 0).astype(np.uint8)


SIZE_M = 20.0
MOST_CROPS = 3
PIXELS = 200
# m; a column whose points reach this high is a wall, a trunk, a car: structure, and not ground.
_RELIEF = 1.0
_CELL = 0.5
_STEP = 5.0


@dataclass(frozen=True)
class Crop:
    """A square seen from above: its centre and edge, m, in the world of the drawing."""

    x: float
    y: float
    size: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Limits x_min, x_max, y_min, y_max, m."""
        half = self.size / 2
        return (self.x - half, self.x + half, self.y - half, self.y + half)

    def inside(self, points: Floats) -> Floats:
        """Points among (K, 2) or (K, 3), m, that lie in the square."""
        x0, x1, y0, y1 = self.extent
        return points[((points[:, :2] >= (x0, y0)) & (points[:, :2] <= (x1, y1))).all(axis=1)]


def choose_crops(points: NDArray[Any], size: float = SIZE_M) -> list[Crop]:
    """At most `MOST_CROPS` squares of `size` m that do not overlap, those with most structure first.

    Structure is counted in columns of 0.5 m whose points span more than 1 m of height; a square with less than a third of the
    best one's is not worth showing. Empty without any.

    points : (M, 3) m; rows that are not finite are ignored
    """
    counts, low = _structure(points)
    window, step = round(size / _CELL), round(_STEP / _CELL)
    sums = _window_sums(counts, window, step)
    crops: list[Crop] = []
    best = sums.max(initial=0)
    while len(crops) < MOST_CROPS:
        row, column = np.unravel_index(int(np.argmax(sums)), sums.shape)
        if sums[row, column] <= best / 3 or sums[row, column] == 0:
            break
        x, y = low + _CELL * (step * np.array([row, column]) + window / 2)
        crops.append(Crop(float(x), float(y), size))
        reach = -(-window // step)
        sums[max(row - reach + 1, 0) : row + reach, max(column - reach + 1, 0) : column + reach] = 0
    return crops


def crop_images(clouds: Sequence[NDArray[Any] | None], crop: Crop) -> tuple[list[NDArray[np.float32] | None], float]:
    """Images of the square, points per pixel of each cloud (M, 3), row 0 at the largest y; and the common count drawn black.

    None stays None; the count is the largest of the images' 99.5th percentiles of occupied pixels, at least 1.
    """
    images = [None if cloud is None else _crop_image(cloud, crop) for cloud in clouds]
    tops = [float(np.percentile(image[image > 0], 99.5)) for image in images if image is not None and image.any()]
    return images, max([1.0, *tops])


def _structure(points: NDArray[Any]) -> tuple[Longs, Floats]:
    """Grid (x, y) of columns with relief, 0 or 1, and the grid's lower corner, m."""
    xyz = np.asarray(points, np.float64)
    xyz = xyz[np.isfinite(xyz).all(1)]
    if not len(xyz):
        return np.zeros((1, 1), np.int64), np.zeros(2)
    low, high = np.percentile(xyz[:, :2], [0.1, 99.9], axis=0)
    low = np.floor(low / _STEP) * _STEP
    shape = np.maximum(np.ceil((high - low) / _CELL).astype(int), round(SIZE_M / _CELL))
    cell = np.floor((xyz[:, :2] - low) / _CELL).astype(int)
    inside = ((cell >= 0) & (cell < shape)).all(1)
    index = np.ravel_multi_index(tuple(cell[inside].T), tuple(shape))
    bottom, top = np.full(shape.prod(), np.inf), np.full(shape.prod(), -np.inf)
    np.minimum.at(bottom, index, xyz[inside, 2])
    np.maximum.at(top, index, xyz[inside, 2])
    return (top - bottom > _RELIEF).astype(np.int64).reshape(shape), low


def _window_sums(counts: Longs, window: int, step: int) -> Longs:
    """Sums over windows of `window` x `window` cells, placed every `step` cells."""
    padded = np.pad(counts, ((0, max(window - counts.shape[0], 0)), (0, max(window - counts.shape[1], 0))))
    table = np.zeros((padded.shape[0] + 1, padded.shape[1] + 1), np.int64)
    table[1:, 1:] = padded.cumsum(0).cumsum(1)
    sums = table[window:, window:] - table[:-window, window:] - table[window:, :-window] + table[:-window, :-window]
    return sums[::step, ::step].copy()


def _crop_image(cloud: NDArray[Any], crop: Crop) -> NDArray[np.float32]:
    """Points of a cloud per pixel of a square, row 0 at the largest y."""
    x0, x1, y0, y1 = crop.extent
    counts, _, _ = np.histogram2d(cloud[:, 1], cloud[:, 0], bins=PIXELS, range=((y0, y1), (x0, x1)))
    image: NDArray[np.float32] = counts[::-1].astype(np.float32)
    return image
