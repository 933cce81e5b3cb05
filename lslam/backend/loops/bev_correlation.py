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
    """A BEV grid of `size` x `size` cells centred on the origin, x along rows."""

    size: int

    def cells_of(self, points: Floats) -> tuple[Longs, Bools]:
        """Flat cell of each point (N, 3), m, 0 outside, and whether it lies inside."""
        cells = np.floor(points[:, :2] / CELL_M).astype(np.int64) + self.size // 2
        inside = np.asarray(((cells >= 0) & (cells < self.size)).all(axis=1))
        return np.where(inside, cells[:, 0] * self.size + cells[:, 1], 0), inside

    def heights(self, points: Floats, R: Floats = UNTURNED) -> Image:
        """(size, size) occupied voxels per cell, up to `MOST_VOXELS`; points are means of voxels, turned by R (2, 2) first."""
        counts = np.zeros((self.size, self.size), np.float32)
        bev.count(points, R, CELL_M, MOST_VOXELS, counts)
        return counts

    def cover(self, *clouds: Floats, R: Floats = UNTURNED) -> Image:
        """(size, size) visibility: 1 in cells that hold a point, turned by R (2, 2), and in their neighbours, else 0."""
        covered = np.zeros((self.size, self.size), np.float32)
        for points in clouds:
            bev.mark(points, R, CELL_M, covered)
        return covered

    def lowest(self, points: Floats) -> Floats:
        """(size * size,) least z per cell, m, inf where there is none."""
        cells, inside = self.cells_of(points)
        lowest = np.full(self.size**2, np.inf)
        np.minimum.at(lowest, cells[inside], points[inside, 2])
        return lowest

    def shifts(self) -> Floats:
        """(size,) m that row or column k of a correlation stands for."""
        return np.asarray(np.fft.fftfreq(self.size, 1 / (self.size * CELL_M)))


def blurred(image: Image) -> Image:
    """Mean over a cell and the eight round it."""
    from scipy import ndimage

    return np.asarray(ndimage.uniform_filter(image, 3, mode="constant"))


def spectrum(image: Image) -> Spectrum:
    """Fourier transform of an image, for `correlate`."""
    from scipy import fft

    return np.asarray(fft.rfft2(image))


def correlate(a: Spectrum, b: Spectrum, size: int) -> Image:
    """(size, size) sum over the cells of image a times image b shifted, for all shifts."""
    from scipy import fft

    return np.asarray(fft.irfft2(a * np.conj(b), s=(size, size)))
