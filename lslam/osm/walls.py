"""Walls as directed segments on level ground: extracted from a cloud, and those of a map.

Del Tufo, section 3.2: low points are removed, then points off vertical planes; the rest is projected on the ground, and lines
are found by RANSAC. Heights are above the ground below each point, since the sensor may fly. All segments are directed so that
the outside, from where a wall is seen, lies to the right: the two sides of a wall are not matched with each other.

Classes of points by the geometry of a submap alone (ground, wall, pole, vegetation, vehicle) serve recordings without labels.
Moments of the points in cubes tell planes, lines and scatter (Demantke et al. 2011, Weinmann et al. 2015); what stands together
below the height of a vehicle is one by its size; a pole is what is narrow.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config.backend import OsmConfig
from lslam.core.kernels import ground
from lslam.core.labels import CLASSES
from lslam.core.types.building import (
    Building,
    BuildingMatch,
    Footprint,
    KeyframeMatch,
    OsmMatches,
    footprint_polygon,
    is_canopy,
)
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm.kernels import segments

WALL_RANGE_M = 60.0  # m; walls are looked for so far from the sensor
WALL_TILT_DEG = 15.0  # largest tilt of a wall's surface
WALL_GAP_M = 1.0  # m; a wider gap parts two walls on one line
MIN_CLUSTER = 20  # points a wall has at least
CELL_M = 2.0  # m; of the grid in which the ground is found
SLOPE = 0.3  # m per m; steepest street
ROUGHNESS_M = 0.3  # m; of the ground within a cell
NEIGHBOURHOOD = 0.6  # m; half the window in which the points of a wall lie on a plane
THICKNESS = 0.1  # m; largest standard deviation across that plane
WALL_STEP_M = 0.5  # m; three of them reach from the last such neighbourhood of a wall to its corner
THIN = 0.25  # m; points above one another within it are merged, with their count
AGREEMENT = np.cos(np.radians(20.0))  # cosine of the angle between a point's plane and the line
TRIES = 12  # RANSAC hypotheses per segment
MOST = 200  # most segments
HIGHEST = 1e4  # m; points higher or lower, or not finite, are left out
STRAIGHT_M = 0.1  # m; corners of a footprint nearer to the line through their neighbours are removed


@dataclass(frozen=True)
class Walls:
    """Segments seen in a cloud, in its frame.

    segments : (S, 2, 2) float64, m, both ends, the outside to the right of the way from first to second
    counts : (S,) int64 points of each; rms : (S,) float64, m, of its points about the line
    """

    segments: Floats
    counts: Longs
    rms: Floats

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def lengths(self) -> Floats:
        """(S,) m."""
        return np.asarray(np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=1))


def find_walls(
    points: NDArray[Any],
    config: OsmConfig | None = None,
    views: NDArray[Any] | None = None,
    is_wall: Bools | None = None,
) -> Walls:
    """Extract walls from the points (N, 3), m, of a scan or of a submap, in a frame whose z points up.

    Points farther than `WALL_RANGE_M` along x or y count for nothing.
    is_wall : (N,) points that may be of walls; the others serve to find the ground
    views : (V, 2) or (V, 3) positions of the sensor, m, which direct the walls; the origin by default
    The same input gives the same result, which is empty without walls.
    """
    config = config or OsmConfig()
    cloud = np.asarray(points, np.float32).reshape(-1, 3)
    x, y, z = np.abs(cloud.T)
    near = (x < WALL_RANGE_M) & (y < WALL_RANGE_M) & (z < HIGHEST)
    cloud = cloud[near]
    if len(cloud) < MIN_CLUSTER:
        return Walls(np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros(0))
    high = _high(cloud, config.wall_height)
    flat, every = segments.flat_walls(
        cloud,
        high if is_wall is None else high[is_wall[near][high]],
        NEIGHBOURHOOD,
        np.sin(np.radians(WALL_TILT_DEG)),
        THICKNESS,
        THIN,
    )
    tries = np.random.default_rng(0).integers(0, 2**31, (MOST, TRIES))
    found = segments.find_segments(
        flat,
        every,
        tries,
        config.wall_tolerance,
        AGREEMENT,
        WALL_GAP_M,
        float(MIN_CLUSTER),
        config.min_length,
        WALL_STEP_M,
    )
    seen_from = np.zeros((1, 2)) if views is None else np.asarray(views, np.float64)[:, :2]
    return Walls(_direct(found[:, :4].reshape(-1, 2, 2), seen_from), found[:, 4].astype(np.int64), found[:, 5])


# What is a metre off is turned by so much, one sigma: 35 cm over 10 m, for outlines keep their shape better than their place.
TURN_DEG_PER_M = 2.0
# One sigma of a building over that of its neighbourhood on the map: buildings are drawn one by one.
BUILDING_RATIO = 2.0


def planar_sigmas(sigma_m: float) -> Floats:
    """Prior sigmas (3,), x and y, m, and heading, rad, of a pose or building with an error of `sigma_m` on the map."""
    return np.array([sigma_m, sigma_m, np.radians(TURN_DEG_PER_M * sigma_m)])


def walls_of(buildings: Iterable[Building]) -> tuple[Floats, Longs]:
    """Walls (T, 2, 2), m, of the footprints of `buildings`, the outside to the right, and the number (T,) of each one's building.

    Nodes on straight walls are left out; canopies have no walls.
    """
    rows: list[Floats] = []
    owners: list[int] = []
    for number, building in enumerate(buildings):
        if is_canopy(building):
            continue
        for footprint in building.footprints:
            for ring in _simplify(footprint).rings:
                rows.append(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1))
                owners += [number] * len(ring)
    found = np.concatenate(rows) if rows else np.zeros((0, 2, 2))
    return np.asarray(found, np.float64), np.array(owners, np.int64)


def lowest_levels(cloud: NDArray[np.float32]) -> tuple[Floats, int]:
    """(2 half, 2 half) height, m, of the lowest point in each cell about the sensor, `NO_HEIGHT` without points; and half."""
    half = int(np.ceil(float(np.abs(cloud[:, :2]).max()) / CELL_M)) + 1
    lowest = ground.lowest(cloud, np.eye(3), CELL_M, half)
    return np.where(lowest >= 0, cloud[lowest, 2].astype(np.float64), ground.NO_HEIGHT).reshape(
        2 * half, 2 * half
    ), half


def _high(cloud: NDArray[np.float32], height: float) -> Longs:
    """Indices of the points more than `height` m above the ground."""
    level, half = lowest_levels(cloud)
    return ground.above(cloud, np.eye(3), CELL_M, half, ground.envelope(level, SLOPE * CELL_M, ROUGHNESS_M), height)


def _direct(lines: Floats, views: Floats) -> Floats:
    """The segments (S, 4), each directed so that most views lie to its right.

    A view counts by its distance from the line, divided by its range cubed.
    """
    to_view = views[None] - lines.mean(axis=1)[:, None]
    along = (lines[:, 1] - lines[:, 0])[:, None]
    left = along[..., 0] * to_view[..., 1] - along[..., 1] * to_view[..., 0]
    share = left / np.maximum(np.linalg.norm(to_view, axis=2), 1.0) ** 3
    return np.where((share.sum(axis=1) > 0)[:, None, None], lines[:, ::-1], lines)


def _simplify(footprint: Footprint) -> Footprint:
    """The footprint without nodes on straight walls, or unchanged when no polygon would remain."""
    from shapely import Polygon

    polygon = footprint_polygon(footprint)
    rings = []
    for ring in (polygon.exterior, *polygon.interiors):
        # Simplification keeps the first node: the farthest one is a corner.
        corners = np.asarray(ring.coords, np.float64)[:-1]
        corners = np.roll(corners, -int(np.argmax(np.linalg.norm(corners - corners.mean(0), axis=1))), axis=0)
        rings.append(np.asarray(Polygon(corners).simplify(STRAIGHT_M).exterior.coords, np.float64)[:-1])
    return Footprint(rings[0], tuple(rings[1:])) if all(len(ring) >= 3 for ring in rings) else footprint


class OsmMap:
    """Buildings and their walls (T, 2, 2), m, map frame; owners : (T,) number of each one's building."""

    def __init__(self, buildings: Sequence[Building]) -> None:
        self.buildings = tuple(buildings)
        self.walls, self.owners = walls_of(self.buildings)
        corners = [np.concatenate([f.outer for f in b.footprints]) for b in self.buildings]
        self._low = np.array([c.min(0) for c in corners]).reshape(-1, 2)
        self._high = np.array([c.max(0) for c in corners]).reshape(-1, 2)

    def collect(
        self,
        extract: BuildingExtract,
        keyframes: Iterable[KeyframeMatch],
        local: Iterable[BuildingMatch],
        **shift: Any,
    ) -> OsmMatches:
        """All matches of a run with the buildings of `extract`; shift : `shift` and `shift_sigma` of `OsmMatches`."""
        places, about = (self.buildings, self.walls, self.owners), shift | {"attribution": extract.attribution}
        return OsmMatches(extract.origin, *places, tuple(keyframes), tuple(local), source=extract.source, **about)

    def near(self, place: Floats, reach: float) -> Longs:
        """Numbers of the buildings whose box comes within `reach` m of `place` (2,)."""
        return np.flatnonzero(self._away(place) <= reach)

    def distance(self, place: Floats) -> float:
        """From `place` (2,) to the box of the nearest building, m; inf without one."""
        return float(self._away(place).min(initial=np.inf))

    def walls_near(self, place: Floats, reach: float) -> Longs:
        """Numbers of the walls of the buildings within `reach`, m, of `place` (2,)."""
        return np.flatnonzero(np.isin(self.owners, self.near(place, reach)))

    def _away(self, place: Floats) -> Floats:
        """(B,) distance, m, from `place` (2,) to the box round each building."""
        outside = np.maximum(np.maximum(self._low - place, place - self._high), 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))


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
    """SemanticKITTI classes (N,) of the points (N, 3), m, of a submap whose z points up; 0 for unclassified points."""
    cloud = np.asarray(points, np.float32).reshape(-1, 3)
    labels = np.full(len(cloud), _GROUND, np.uint16)
    height = _heights(cloud)
    off = np.flatnonzero(height > ROUGHNESS_M)
    if len(off):
        labels[off] = _standing(cloud[off].astype(np.float64), height[off])
    return labels


def _heights(cloud: NDArray[np.float32]) -> Floats:
    """Heights (N,), m, of the points (N, 3) above the ground below them."""
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
    """SemanticKITTI classes (N,) of points (N, 3) above the ground, by the shape of voxels, then of connected objects.

    height : (N,) m above the ground
    """
    cells = np.floor(points / CUBE_M).astype(np.int64)
    keys, member = np.unique(_pack_cells(cells), return_inverse=True)
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
    column = np.unique(_pack_cells(cells * [1, 1, 0]), return_inverse=True)[1]
    share = np.bincount(column, is_wall) / np.bincount(column)
    labels[is_wall | (share > WALL_SHARE)[column] | (flat & (height > VEHICLE_HEIGHTS_M[1]))] = _WALL
    low = (height < VEHICLE_HEIGHTS_M[1]) & np.isin(labels, (_OTHER, _VEGETATION))
    things = _things(cells[low])
    labels[low] = _by_size(points[low], height[low], things, labels[low], flat[low])
    return labels


def _shapes(points: Floats, keys: Longs, member: Longs) -> tuple[Bools, Bools, Bools]:
    """(V,) per voxel of `keys`: is its neighbourhood a plane, is that plane vertical, and has it points but no plane.

    member : (N,) voxel of each point
    """
    relative = points - points.mean(0)
    moments = np.column_stack(
        [np.ones(len(points)), relative, *(relative[:, i] * relative[:, j] for i in range(3) for j in range(i, 3))]
    )
    sums = np.stack([np.bincount(member, column, len(keys)) for column in moments.T], axis=1)
    total = np.zeros_like(sums)
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    for step in _pack_cells(steps, 0):
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
    """Index (N,) of the connected object, seen from above, that each point belongs to; cells : (N, 3) voxels of the points."""
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
    """Classes (N,) of points (N, 3) lower than a vehicle's top: vehicles and poles by their object's size, else `labels` (N,).

    height : (N,) m above ground; things : (N,) index of each point's object; is_flat : (N,) whether its voxel is a plane
    """
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
    """Mask of the values strictly between two limits."""
    return (values > limits[0]) & (values < limits[1])


def _extent(things: Longs, values: Floats, count: int) -> Floats:
    """Range (count,) of the values of each object's points; things : (N,) object of each point."""
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, things, values)
    np.maximum.at(high, things, values)
    extent: Floats = high - low
    return extent


def _pack_cells(cells: NDArray[Any], offset: int = 1 << 20) -> Longs:
    """One number per cell (N, 3), in which neighbours lie at constant steps."""
    x, y, z = (cells + offset).T
    return np.asarray((x << 42) + (y << 21) + z, np.int64)
