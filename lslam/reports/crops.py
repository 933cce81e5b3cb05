"""Squares of a map seen from above: the places with most structure, and their images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats, Longs

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


def choose_crops(points: NDArray[Any], size: float = SIZE_M, most: int = MOST_CROPS) -> list[Crop]:
    """At most `most` squares of `size` m that do not overlap, those with most structure first.

    Structure is counted in columns of 0.5 m whose points span more than 1 m of height; a square with less than a third of the
    best one's is not worth showing. Empty without any.

    Parameters
    ----------
    points : (M, 3) m; rows that are not finite are ignored
    """
    counts, low = _structure(points)
    window, step = round(size / _CELL), round(_STEP / _CELL)
    sums = _window_sums(counts, window, step)
    crops: list[Crop] = []
    best = sums.max(initial=0)
    while len(crops) < most:
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
    images = [None if cloud is None else _image(cloud, crop) for cloud in clouds]
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


def _image(cloud: NDArray[Any], crop: Crop) -> NDArray[np.float32]:
    x0, x1, y0, y1 = crop.extent
    counts, _, _ = np.histogram2d(cloud[:, 1], cloud[:, 0], bins=PIXELS, range=((y0, y1), (x0, x1)))
    image: NDArray[np.float32] = counts[::-1].astype(np.float32)
    return image
