"""Where one place may lie in another: all shifts and turns that odometry allows, seen from above."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3
from lslam.loops.place import Place
from lslam.loops.raster import CELL, Image, Raster, blurred, correlate, spectrum

Floats = NDArray[np.float64]

# Cells; the smaller image serves where the search is short.
SMALL, LARGE = Raster(128), Raster(256)
# m round a place that is compared, at most and at least; the rest of the image is room for the shift.
WIDEST, NARROWEST = 60.0, 40.0
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
    far = float(np.linalg.norm(expected[:2])) + reach
    raster = SMALL if far + NARROWEST <= SMALL.size * CELL / 2 else LARGE
    window = min(raster.size * CELL / 2 - far, WIDEST)
    image = blurred(raster.heights(a.standing))
    A, A2, A_seen = spectrum(image), spectrum(image**2), spectrum(raster.cover(a.standing, a.floor))
    near, floor = (p[(p[:, :2] ** 2).sum(axis=1) < max(window, NARROWEST) ** 2] for p in (b.standing, b.floor))
    best, turn = np.zeros_like(image), np.zeros_like(image)
    for yaw in yaws:
        R = so3.exp(np.array([0.0, 0.0, yaw]))
        turned = raster.heights(near @ R.T)
        own = correlate(A_seen, spectrum(turned**2), raster.size)
        other = correlate(A2, spectrum(raster.cover(near @ R.T, floor @ R.T)), raster.size)
        score = correlate(A, spectrum(turned), raster.size) / np.sqrt(np.maximum(own * other, 1.0))
        score[own < SHARED * max(float((turned**2).sum()), 1.0)] = 0.0
        better = score > best
        best, turn = np.where(better, score, best), np.where(better, np.float32(yaw), turn)
    return [
        Start(_pose(raster, a, b, shift, yaw, float(expected[2])), score)
        for shift, yaw, score in _peaks(raster.shifts(), best, turn, expected, reach)
    ]


def _peaks(
    shifts: Floats, score: Image, turn: Image, expected: Floats, reach: float
) -> list[tuple[Floats, float, float]]:
    """Shift (2,) m, yaw and score of the best cells within reach, none near another.

    Not only of the local maxima: along a ridge, as a street makes it, other places may fit as well as the top.
    """
    away2 = (shifts[:, None] - expected[0]) ** 2 + (shifts[None, :] - expected[1]) ** 2
    left = np.where(away2 <= max(reach, CELL) ** 2, score, np.float32(0))
    best = float(left.max())
    found: list[tuple[Floats, float, float]] = []
    while len(found) < STARTS and left.max() > NEARLY * best:
        r, c = np.unravel_index(int(left.argmax()), left.shape)
        found.append((np.array([shifts[r], shifts[c]]), float(turn[r, c]), float(score[r, c])))
        left[(shifts[:, None] - shifts[r]) ** 2 + (shifts[None, :] - shifts[c]) ** 2 < APART**2] = 0
    return found


def _pose(raster: Raster, a: Place, b: Place, shift: Floats, yaw: float, expected_z: float) -> Floats:
    """(4, 4) with the climb that the floors in common tell, their median difference; `expected_z` without any."""
    R = so3.exp(np.array([0.0, 0.0, yaw]))
    low_a, low_b = raster.lowest(a.floor), raster.lowest(b.floor @ R.T + np.array([*shift, 0.0]))
    both = np.isfinite(low_a) & np.isfinite(low_b)
    climb = float(np.median(low_a[both] - low_b[both])) if both.any() else expected_z
    return se3.make(R, np.array([*shift, climb]))
