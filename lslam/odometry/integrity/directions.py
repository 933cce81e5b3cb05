"""Directions in which a sensor sees something: a sensor that stands goes on seeing something there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats, Longs

# Edge of a cell of directions, rad: two rings of sixteen beams, a hundred shots.
CELL_RAD = float(np.deg2rad(5.0))
# Points that tell the directions of a scan, and that fill a cell.
POINTS, FILLING = 20_000, 3
# Share of the directions that empty: far from the few per cent of dropouts, and from the half and more of a cloud that leaves.
EMPTIED_SHARE = 0.25
# Cells are numbered by row, from the pole below upwards.
_ROWS = round(np.pi / CELL_RAD)
_COLUMNS = 2 * _ROWS


def directions(points: Floats) -> Longs:
    """(N,) numbers of the cells of directions, of about the same size, in which points (N, 3), m, lie as seen from 0."""
    ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    row = np.minimum((np.arcsin(points[:, 2] / ranges) + np.pi / 2) / CELL_RAD, _ROWS - 1).astype(np.int64)
    count = np.maximum(np.round(_COLUMNS * np.cos((row + 0.5) * CELL_RAD - np.pi / 2)), 1)
    column = np.minimum((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * count, count - 1).astype(
        np.int64
    )
    return np.asarray(row * _COLUMNS + column)


def filled_directions(points: NDArray[np.floating]) -> Longs:
    """Numbers of the cells of `directions` that hold some of the points (N, 3), m."""
    few = points[:: 1 + len(points) // POINTS, :3].astype(np.float64)
    ranges = np.linalg.norm(few, axis=1)
    cells, filling = np.unique(directions(few[np.isfinite(ranges) & (ranges > 0)]), return_counts=True)
    return np.asarray(cells[filling >= FILLING])


def emptied(before: Longs, now: Longs) -> float:
    """Share of the directions that were filled before and are empty now, in that half of them, lower or upper, where it is less.

    What leaves in front of the sky empties directions, what leaves in front of the ground, or below a ceiling, does not.
    """
    is_lower = before < _ROWS // 2 * _COLUMNS
    is_empty = ~np.isin(before, now)
    halves = [is_empty[half] for half in (is_lower, ~is_lower) if half.any()]
    return min((float(half.mean()) for half in halves), default=0.0)
