"""Where one place may lie in another: all shifts and turns that odometry allows, seen from above."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lslam.geometry import se3, so3
from lslam.loops.place import Place

Floats = NDArray[np.float64]

# m and cells: places reach 128 m, so that a window of 60 m may be shifted by as much without wrapping round.
CELL, CELLS = 1.0, 256
WINDOW = 60.0
# Voxels in a column of a cell that count; what is taller is no more telling.
TALLEST = 6.0
# Of what stands in the window, this share must lie where the other place was seen.
SHARED = 0.25
# m between two starts, how well the next must fit of the best, and how many there are at most.
APART, NEARLY, STARTS = 4.0, 0.7, 5


@dataclass(frozen=True)
class Start:
    """A guess: T_a_b (4, 4), level axes, and how well it fits, 0 to 1."""

    T_a_b: Floats
    score: float


def find_starts(a: Place, b: Place, expected: Floats, reach: float, yaws: Iterable[float]) -> list[Start]:
    """The best fits of b in a within `reach` m of `expected` (3,), for yaws (rad) of b in a, best first; perhaps none.

    Both are seen from above: do things stand in the same cells? What the other did not see counts neither for nor
    against, or else the shift that covers most would win. Each correlation of all shifts is a Fourier transform.
    """
    image = ndimage.uniform_filter(_heights(a.standing), 3, mode="constant")
    A, A2, A_seen = fft.rfft2(image), fft.rfft2(image**2), fft.rfft2(seen_cells(a).astype(np.float64))
    near, floor = (p[(p[:, :2] ** 2).sum(axis=1) < WINDOW**2] for p in (b.standing, b.floor))
    best, turn = np.zeros(image.shape), np.zeros(image.shape)
    for yaw in yaws:
        R = so3.exp(np.array([0.0, 0.0, yaw]))
        turned = _heights(near @ R.T)
        seen = _cover([near @ R.T, floor @ R.T]).astype(np.float64)
        own = _correlate(A_seen, turned**2)
        other = _correlate(A2, seen)
        score = _correlate(A, turned) / np.sqrt(np.maximum(own * other, 1.0))
        score[own < SHARED * max(float((turned**2).sum()), 1.0)] = 0.0
        better = score > best
        best, turn = np.where(better, score, best), np.where(better, yaw, turn)
    return [_start(a, b, shift, yaw, score, expected) for shift, yaw, score in _peaks(best, turn, expected, reach)]


def seen_cells(place: Place) -> NDArray[np.bool_]:
    """(CELLS, CELLS) cells from above where the place is known, or next to such."""
    return _cover([place.standing, place.floor])


def cells_of(points: Floats) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Flat cell of each point (N, 3), and whether it lies inside the image; x along rows, the origin in the middle."""
    cells = np.floor(points[:, :2] / CELL).astype(np.int64) + CELLS // 2
    inside = np.asarray(((cells >= 0) & (cells < CELLS)).all(axis=1))
    return np.where(inside, cells[:, 0] * CELLS + cells[:, 1], 0), inside


def _correlate(a_hat: NDArray[np.complex128], b: Floats) -> Floats:
    """Sum over the cells of a times b shifted, for all shifts."""
    return np.asarray(fft.irfft2(a_hat * np.conj(fft.rfft2(b)), s=b.shape))


def _heights(points: Floats) -> Floats:
    """(CELLS, CELLS) how tall things stand there, in voxels."""
    cells, inside = cells_of(points)
    counts = np.bincount(cells[inside], minlength=CELLS * CELLS)
    return np.minimum(counts, TALLEST).astype(np.float64).reshape(CELLS, CELLS)


def _cover(clouds: list[Floats]) -> NDArray[np.bool_]:
    cover = np.zeros(CELLS * CELLS, np.bool_)
    for points in clouds:
        cells, inside = cells_of(points)
        cover[cells[inside]] = True
    return ndimage.maximum_filter(cover.reshape(CELLS, CELLS), 3, mode="constant")


def _peaks(score: Floats, turn: Floats, expected: Floats, reach: float) -> list[tuple[Floats, float, float]]:
    """Shift (2,) m, yaw and score of the best cells within reach, none near another.

    Not only of the local maxima: along a ridge, as a street makes it, other places may fit as well as the top.
    """
    shift = fft.fftfreq(CELLS, 1 / (CELLS * CELL))
    away2 = (shift[:, None] - expected[0]) ** 2 + (shift[None, :] - expected[1]) ** 2
    left = np.where(away2 <= max(reach, CELL) ** 2, score, 0.0)
    best = float(left.max())
    found: list[tuple[Floats, float, float]] = []
    while len(found) < STARTS and left.max() > NEARLY * best:
        r, c = np.unravel_index(int(left.argmax()), left.shape)
        found.append((np.array([shift[r], shift[c]]), float(turn[r, c]), float(score[r, c])))
        left[(shift[:, None] - shift[r]) ** 2 + (shift[None, :] - shift[c]) ** 2 < APART**2] = 0.0
    return found


def _start(a: Place, b: Place, shift: Floats, yaw: float, score: float, expected: Floats) -> Start:
    R = so3.exp(np.array([0.0, 0.0, yaw]))
    return Start(se3.make(R, np.array([*shift, _climb(a, b, shift, R, float(expected[2]))])), score)


def _climb(a: Place, b: Place, shift: Floats, R: Floats, expected: float) -> float:
    """How much higher b's origin lies: the median over the cells in which both see a floor; `expected` without."""
    low_a, low_b = _lowest(a.floor), _lowest(b.floor @ R.T + np.array([*shift, 0.0]))
    both = np.isfinite(low_a) & np.isfinite(low_b)
    return float(np.median(low_a[both] - low_b[both])) if both.any() else expected


def _lowest(points: Floats) -> Floats:
    """(CELLS^2,) least z per cell, inf where there is none."""
    cells, inside = cells_of(points)
    lowest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(lowest, cells[inside], points[inside, 2])
    return lowest
