"""Correlation of bird's-eye views (BEV): height and visibility images of submaps, correlated by FFT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.backend.kernels import bev
from lslam.core.types.arrays import Bools, Floats, Longs

Image = NDArray[np.float32]
Spectrum = NDArray[np.complex64]

# m; a heading error of half a search step moves a wall by one cell at most.
CELL_M = 1.0
# Voxels per cell that count, at most: taller structure is no more distinctive.
MOST_VOXELS = 6.0
UNTURNED: Floats = np.eye(2)


@dataclass(frozen=True)
class BevGrid:
    """A BEV grid of `size` x `size` cells of `cell` m centred on the origin, x along rows."""

    size: int
    cell: float = CELL_M

    def cells_of(self, points: Floats) -> tuple[Longs, Bools]:
        """Flat cell of each point (N, 3), m, 0 outside, and whether it lies inside."""
        cells = np.floor(points[:, :2] / self.cell).astype(np.int64) + self.size // 2
        inside = np.asarray(((cells >= 0) & (cells < self.size)).all(axis=1))
        return np.where(inside, cells[:, 0] * self.size + cells[:, 1], 0), inside

    def view(self, points: Floats, ground: Floats, R: Floats = UNTURNED) -> Image:
        """(3, size, size) of what stands there, points (N, 3), m, and of the ground (M, 3), turned by R (2, 2) first.

        Structure: occupied voxels per cell, up to `MOST_VOXELS`; points are means of voxels. Its square. Visibility: 1 in cells
        that hold a point of either, and in their neighbours, else 0.
        """
        images = np.zeros((3, self.size, self.size), np.float32)
        bev.view(points, ground, R, self.cell, MOST_VOXELS, images)
        return images

    def lowest(self, points: Floats) -> Floats:
        """(size * size,) least z per cell, m, inf where there is none."""
        cells, inside = self.cells_of(points)
        lowest = np.full(self.size**2, np.inf)
        np.minimum.at(lowest, cells[inside], points[inside, 2])
        return lowest

    def shifts(self, cells: Longs) -> Floats:
        """(K, 2) m that the flat cells (K,) of a correlation stand for."""
        along = self._along()
        return np.column_stack([along[part] for part in np.divmod(cells, self.size)])

    def within(self, centre: Floats, radius: float) -> Longs:
        """Flat cells of a correlation whose shifts lie within `radius` m, or a cell, of `centre` (2,), increasing."""
        along = self._along()
        away2 = (along[:, None] - centre[0]) ** 2 + (along[None, :] - centre[1]) ** 2
        return np.flatnonzero(away2 <= max(radius, self.cell) ** 2)

    def _along(self) -> Floats:
        """(size,) m that row or column k of a correlation stands for."""
        return np.asarray(np.fft.fftfreq(self.size, 1 / (self.size * self.cell)))


def blurred(image: Image) -> Image:
    """Mean over a cell and the eight round it."""
    from scipy import ndimage

    return np.asarray(ndimage.uniform_filter(image, 3, mode="constant"))


def turning(yaw: float) -> Floats:
    """(2, 2) rotation by `yaw`, rad."""
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def spectra(images: Image) -> Spectrum:
    """Fourier transforms of images (K, size, size), for `correlate`."""
    from scipy import fft

    return np.asarray(fft.rfft2(images))


def correlate(a: Spectrum, b: Spectrum) -> Image:
    """(K, size, size) sums over the cells of images a times images b shifted, for all shifts; `size` is even."""
    from scipy import fft

    product = np.conj(b)
    product *= a
    return np.asarray(fft.irfft2(product, overwrite_x=True))


class BestShifts:
    """The best score of shifts over the headings tried so far: a correlation normalised over the cells that both observed.

    Without that the shift with most overlap would win.

    cells : (K,) flat cells of the correlation that are of interest
    score : (K,) 0 to 1; heading : (K,) that it was reached with
    """

    def __init__(self, cells: Longs) -> None:
        self.cells = cells
        self.score, self.heading = np.zeros((2, len(cells)), np.float32)

    def observe(self, sums: Image, least: float, heading: float) -> None:
        """Take the correlations (3, size, size) of another heading.

        sums : structure of a times that of b; where a observed, its square of b; where b observed, its square of a
        least : of the second, below which the score is 0
        """
        flat = sums.reshape(3, -1)
        bev.improve(flat, self.cells, np.float32(least), np.float32(heading), self.score, self.heading)

    def merge(self, other: BestShifts, rows: Longs) -> None:
        """Take what another one has in the rows (K,) where that is better."""
        score = other.score[rows]
        better = score > self.score
        self.score[better], self.heading[better] = score[better], other.heading[rows[better]]


def peaks(shifts: Floats, score: Image, apart: float, most: int, nearly: float = 0.0) -> list[int]:
    """Numbers of the best of the shifts (K, 2), m, by their score (K,): at most so many, none within `apart` m of another.

    nearly : least score as a part of the best

    Not only local maxima: along a ridge, as of a street, other cells score as well as the maximum.
    """
    x, y = np.ascontiguousarray(shifts.T)
    rest = score.copy()
    best = float(rest.max(initial=0.0))
    chosen: list[int] = []
    while len(chosen) < most and rest.max(initial=0.0) > nearly * best:
        k = int(rest.argmax())
        chosen.append(k)
        rest[(x - x[k]) ** 2 + (y - y[k]) ** 2 < apart**2] = 0
    return chosen
