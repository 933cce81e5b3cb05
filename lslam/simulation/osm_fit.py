"""A shape without a place, laid where it fits: turned and shifted until it runs between the buildings of a map."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.simulation.osm_streets import solid_ground
from lslam.simulation.waypoints import WayPoints
from lslam.types.building import Building

log = logging.getLogger("lslam")

Floats = NDArray[np.float64]

CELL = 1.0  # m, of the raster of distances to walls
SHIFT = 4.0  # m between the places that are tried
HEADINGS = 72
SEEN = 50.0  # m: a place on the line counts when a wall is that near; nothing is known farther from the map


def fit_shape(shape: WayPoints, buildings: Sequence[Building], margin: float, source: str) -> WayPoints:
    """The shape turned and shifted so that all of it keeps `margin` m from walls, with walls along as much as possible.

    Of equally good places the first in a fixed order is taken. Raises UsageError when there is none.
    """
    points = _dense(shape)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    low, distance = _distances(buildings)
    best, most = None, -1
    for angle in 2 * np.pi * np.arange(HEADINGS) / HEADINGS:
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, -s], [s, c]])
        shifts, seen = _free_shifts((points - middle) @ R.T, low, distance, margin)
        if len(seen) and seen.max() > most:
            most = int(seen.max())
            best = R, shifts[int(np.argmax(seen))] - R @ middle
    if best is None:
        raise UsageError(
            f"the shape of --path fits nowhere between the buildings of {source} with {margin:.1f} m of room: give way-points "
            "of the place itself; --plan without --path draws it"
        )
    R, shift = best
    turn = np.degrees(np.arctan2(R[1, 0], R[0, 0]))
    log.info("the shape of --path begins at x = %.0f, y = %.0f m, turned by %.0f deg", *(R @ points[0] + shift), turn)
    return replace(shape, points=shape.points[:, :2] @ R.T + shift, is_placed=True)


def _dense(shape: WayPoints) -> Floats:
    """The line (N, 2) every 2 m."""
    line = shape.points[:, :2]
    line = np.concatenate([line, line[:1]]) if shape.closed else line
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, along[-1], max(int(along[-1] / 2.0), 1) + 1)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def _distances(buildings: Sequence[Building]) -> tuple[Floats, NDArray[np.float32]]:
    """Distance to the nearest wall on a raster from `low` (2,), m; 0 inside of buildings."""
    from scipy.ndimage import distance_transform_edt
    from shapely import contains_xy

    solid = solid_ground(buildings, 0.5 * CELL)
    bounds = np.array(solid.bounds).reshape(2, 2) + np.array([[-SEEN], [SEEN]])
    x, y = (np.arange(bounds[0, k], bounds[1, k], CELL) for k in (0, 1))
    inside = contains_xy(solid, *np.meshgrid(x, y, indexing="ij"))
    return bounds[0], np.asarray(CELL * distance_transform_edt(~inside), np.float32)


def _free_shifts(
    line: Floats, low: Floats, distance: NDArray[np.float32], margin: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Shifts (M, 2) on a grid that bring all of `line` (N, 2) on free ground, and how many of its points see walls there."""
    size = CELL * np.array(distance.shape)
    x, y = (np.arange(low[k], low[k] + size[k], SHIFT) for k in (0, 1))
    shifts = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    seen = np.zeros(len(shifts), np.int64)
    # From far apart to near: most shifts fail at the first few points.
    order = np.concatenate([np.arange(k, len(line), 16) for k in range(16)])
    for point in line[order]:
        cell = np.floor((shifts + point - low) / CELL).astype(np.int64)
        on_map = ((cell >= 0) & (cell < distance.shape)).all(axis=1)
        away = distance[tuple(np.where(on_map[:, None], cell, 0).T)]
        free = on_map & (away > margin)
        shifts, seen = shifts[free], seen[free] + (away[free] <= SEEN)
        if not len(shifts):
            break
    return shifts, seen
