"""Initial guesses of a loop's registration: BEV correlation over all shifts and headings within odometry's gate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3
from lslam.loops.bev_correlation import CELL, BevGrid, Image, blurred, correlate, spectrum
from lslam.loops.level_submap import LevelSubmap

Floats = NDArray[np.float64]

# Cells; the smaller image serves where the search is short.
SMALL, LARGE = BevGrid(128), BevGrid(256)
# m, radius of the compared window, at most and at least; the rest of the image is room for the shift.
WIDEST, NARROWEST = 60.0, 40.0
# Least share of the window's non-ground cells that lie where the other submap was observed.
SHARED = 0.25
# m between two guesses, the least score relative to the best, and how many there are at most.
APART, NEARLY, STARTS = 4.0, 0.7, 5


@dataclass(frozen=True)
class InitialGuess:
    """Initial guess T_a_b (4, 4), level axes, and its normalised correlation, 0 to 1."""

    T_a_b: Floats
    score: float


def find_initial_guesses(
    a: LevelSubmap, b: LevelSubmap, expected: Floats, reach: float, yaws: Iterable[float]
) -> list[InitialGuess]:
    """Maxima of the correlation of b in a within `reach` m of `expected` (3,), for yaws (rad) of b in a, best first.

    The correlation is normalised over the cells that both observed, or else the shift with most overlap would win. All
    shifts of one heading are correlated by FFT. Empty without non-ground points.
    """
    far = float(np.linalg.norm(expected[:2])) + reach
    grid = SMALL if far + NARROWEST <= SMALL.size * CELL / 2 else LARGE
    window = min(grid.size * CELL / 2 - far, WIDEST)
    image = blurred(grid.heights(a.non_ground))
    A, A2, A_seen = spectrum(image), spectrum(image**2), spectrum(grid.cover(a.non_ground, a.ground))
    near, floor = (p[(p[:, :2] ** 2).sum(axis=1) < max(window, NARROWEST) ** 2] for p in (b.non_ground, b.ground))
    best, turn = np.zeros_like(image), np.zeros_like(image)
    for yaw in yaws:
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        turned = grid.heights(near, R)
        own = correlate(A_seen, spectrum(turned**2), grid.size)
        other = correlate(A2, spectrum(grid.cover(near, floor, R=R)), grid.size)
        score = correlate(A, spectrum(turned), grid.size) / np.sqrt(np.maximum(own * other, 1.0))
        score[own < SHARED * max(float((turned**2).sum()), 1.0)] = 0.0
        better = score > best
        best, turn = np.where(better, score, best), np.where(better, np.float32(yaw), turn)
    return [
        InitialGuess(_pose(grid, a, b, shift, yaw, float(expected[2])), score)
        for shift, yaw, score in _peaks(grid.shifts(), best, turn, expected, reach)
    ]


def _peaks(
    shifts: Floats, score: Image, turn: Image, expected: Floats, reach: float
) -> list[tuple[Floats, float, float]]:
    """Shift (2,) m, yaw and score of the best cells within reach, none near another.

    Not only local maxima: along a ridge, as of a street, other cells score as well as the maximum.
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


def _pose(grid: BevGrid, a: LevelSubmap, b: LevelSubmap, shift: Floats, yaw: float, expected_z: float) -> Floats:
    """(4, 4) with the median height difference of the ground in common; `expected_z` without any."""
    R = so3.exp(np.array([0.0, 0.0, yaw]))
    low_a, low_b = grid.lowest(a.ground), grid.lowest(b.ground @ R.T + np.array([*shift, 0.0]))
    both = np.isfinite(low_a) & np.isfinite(low_b)
    climb = float(np.median(low_a[both] - low_b[both])) if both.any() else expected_z
    return se3.make(R, np.array([*shift, climb]))
