"""Classes of points by the geometry of a submap alone: ground, wall, pole, vegetation, vehicle.

For recordings without labels. Moments of the points in cubes tell planes, lines and scatter (Demantke et al. 2011, Weinmann et
al. 2015); what stands together below the height of a vehicle is one by its size; a pole is what is narrow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels import ground
from lslam.core.labels import CLASSES
from lslam.core.types.arrays import Bools, Floats, Longs
from lslam.osm.walls import CELL_M, ROUGHNESS_M, SLOPE, THICKNESS, lowest_levels

_GROUND, _WALL, _POLE = CLASSES["other-ground"], CLASSES["building"], CLASSES["pole"]
_VEGETATION, _VEHICLE, _OTHER = CLASSES["vegetation"], CLASSES["car"], CLASSES["unlabeled"]
NEAR_M = 10.0  # m about the sensor, where the ground is surely seen
CUBE_M = 0.4  # m; three of them to a side are the neighbourhood of a point
FLATNESS = 6.0  # times the variance across a plane that it has along its narrower side, or it is a line
UPRIGHT_SINE = np.sin(np.radians(20.0))  # largest vertical component of the normal of a wall
SHAPED_POINTS = 5.0  # points in a neighbourhood, with fewer it has no shape
VEHICLE_HEIGHTS_M = 0.9, 2.6  # m above the ground, but for lorries
VEHICLE_LENGTHS_M, VEHICLE_WIDTHS_M = (1.5, 6.5), (0.5, 2.6)  # m; of the visible part of a vehicle
WALL_SHARE = 0.5  # share of the points in a column of a wall that lie on upright planes
SMOOTH_SHARE = 0.1  # share of a vehicle's points that lie on planes; leaves have hardly any
POLE_WIDTH_M, LEAST_POLE_HEIGHT_M = 0.8, 1.2  # m; width of a pole in squares of CUBE_M, and its least height


def classify(points: NDArray[Any]) -> NDArray[np.uint16]:
    """Classes (N,), as SemanticKITTI's numbers, of the points (N, 3), m, of a submap whose z points up; 0 where it cannot say."""
    cloud = np.asarray(points, np.float32).reshape(-1, 3)
    labels = np.full(len(cloud), _GROUND, np.uint16)
    height = _heights(cloud)
    off = np.flatnonzero(height > ROUGHNESS_M)
    if len(off):
        labels[off] = _standing(cloud[off].astype(np.float64), height[off])
    return labels


def _heights(cloud: NDArray[np.float32]) -> Floats:
    """(N,) m above the ground below each point."""
    if not len(cloud):
        return np.zeros(0)
    level, half = lowest_levels(cloud)
    # What panes mirror seems to lie far below: no street falls so from where the sensor is.
    away = CELL_M * np.hypot(*(np.indices(level.shape) - (half - 0.5)))
    here = level[(away < NEAR_M) & (level < ground.NO_HEIGHT)]
    if len(here):
        level[level < np.median(here) - SLOPE * away - ROUGHNESS_M] = ground.NO_HEIGHT
    top = np.asarray(ground.envelope(level, SLOPE * CELL_M, ROUGHNESS_M)).reshape(level.shape)
    i, j = (np.floor(cloud[:, :2] / CELL_M).astype(np.int64) + half).T
    return np.asarray(cloud[:, 2] - top[i, j], np.float64)


def _standing(points: Floats, height: Floats) -> NDArray[np.uint16]:
    """Classes of points above the ground: by the shape of their cubes, then by what stands together."""
    cells = np.floor(points / CUBE_M).astype(np.int64)
    keys, member = np.unique(_packed(cells), return_inverse=True)
    is_flat, is_upright, is_rough = _shapes(points, keys, member)
    flat, upright = is_flat[member], is_upright[member]
    labels = np.where(is_rough[member], _VEGETATION, _OTHER).astype(np.uint16)
    labels[flat & ~upright & (height < VEHICLE_HEIGHTS_M[0])] = _GROUND
    # A wall is higher than a vehicle: as far as planes rise that stand together.
    planes = _things(cells[upright])
    rise = np.zeros(planes.max(initial=-1) + 1)
    np.maximum.at(rise, planes, height[upright])
    is_wall = upright.copy()
    is_wall[upright] = (rise > VEHICLE_HEIGHTS_M[1])[planes]
    # Windows and balconies are no planes: most of what stands in their columns is.
    column = np.unique(_packed(cells * [1, 1, 0]), return_inverse=True)[1]
    share = np.bincount(column, is_wall) / np.bincount(column)
    labels[is_wall | (share > WALL_SHARE)[column] | (flat & (height > VEHICLE_HEIGHTS_M[1]))] = _WALL
    low = (height < VEHICLE_HEIGHTS_M[1]) & np.isin(labels, (_OTHER, _VEGETATION))
    things = _things(cells[low])
    labels[low] = _by_size(points[low], height[low], things, labels[low], flat[low])
    return labels


def _shapes(points: Floats, keys: Longs, member: Longs) -> tuple[Bools, Bools, Bools]:
    """Whether the neighbourhood of each cube is a plane, whether that is upright, and whether it has points and is none."""
    relative = points - points.mean(0)
    moments = np.column_stack(
        [np.ones(len(points)), relative, *(relative[:, i] * relative[:, j] for i in range(3) for j in range(i, 3))]
    )
    sums = np.stack([np.bincount(member, column, len(keys)) for column in moments.T], axis=1)
    total = np.zeros_like(sums)
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    for step in _packed(steps, 0):
        at = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        there = keys[at] == keys + step
        total[there] += sums[at[there]]
    mean = total[:, 1:4] / total[:, :1]
    covariance = np.empty((len(keys), 3, 3))
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    for k, (i, j) in enumerate(pairs):
        covariance[:, i, j] = covariance[:, j, i] = total[:, 4 + k] / total[:, 0] - mean[:, i] * mean[:, j]
    values, vectors = np.linalg.eigh(covariance)
    is_known = total[:, 0] >= SHAPED_POINTS
    is_flat = is_known & (values[:, 0] < THICKNESS**2) & (values[:, 1] > FLATNESS * np.maximum(values[:, 0], 0.0))
    return is_flat, is_flat & (np.abs(vectors[:, 2, 0]) < UPRIGHT_SINE), is_known & ~is_flat


def _things(cells: Longs) -> Longs:
    """Number of the thing that each point is of, seen from above; `cells` (N, 3) of the points."""
    from scipy import ndimage

    if not len(cells):
        return np.zeros(0, np.int64)
    first = cells[:, :2].min(0)
    i, j = (cells[:, :2] - first).T
    taken = np.zeros(np.ptp(cells[:, :2], axis=0) + 1, np.bool_)
    taken[i, j] = True
    return np.asarray(ndimage.label(taken)[0][i, j] - 1, np.int64)


def _by_size(
    points: Floats, height: Floats, things: Longs, labels: NDArray[np.uint16], is_flat: Bools
) -> NDArray[np.uint16]:
    """Classes of the points of low things: vehicles and poles by their size, the rest as they are."""
    if not len(points):
        return labels
    count = np.bincount(things)
    top = np.zeros(len(count))
    np.maximum.at(top, things, height)
    mean = np.stack([np.bincount(things, points[:, k]) / count for k in (0, 1)], axis=1)
    relative = points[:, :2] - mean[things]
    xx, xy, yy = (np.bincount(things, relative[:, i] * relative[:, j]) / count for i, j in ((0, 0), (0, 1), (1, 1)))
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    axes = np.stack([np.cos(turn), np.sin(turn)], axis=1)[things]
    along = (relative * axes).sum(1)
    across = relative[:, 1] * axes[:, 0] - relative[:, 0] * axes[:, 1]
    length, width = _extent(things, along, len(count)), _extent(things, across, len(count))
    smooth = np.bincount(things, is_flat) / count
    is_vehicle = _within(length, VEHICLE_LENGTHS_M) & _within(width, VEHICLE_WIDTHS_M)
    is_vehicle &= (top > VEHICLE_HEIGHTS_M[0]) & (smooth > SMOOTH_SHARE)
    is_pole = (length < POLE_WIDTH_M) & (top > LEAST_POLE_HEIGHT_M)
    return np.where(is_vehicle[things], _VEHICLE, np.where(is_pole[things], _POLE, labels)).astype(np.uint16)


def _within(values: Floats, limits: tuple[float, float]) -> Bools:
    return (values > limits[0]) & (values < limits[1])


def _extent(things: Longs, values: Floats, count: int) -> Floats:
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, things, values)
    np.maximum.at(high, things, values)
    extent: Floats = high - low
    return extent


def _packed(cells: NDArray[Any], offset: int = 1 << 20) -> Longs:
    """One number per cell (N, 3), in which neighbours lie at constant steps."""
    x, y, z = (cells + offset).T
    return np.asarray((x << 42) + (y << 21) + z, np.int64)
