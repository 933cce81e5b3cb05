"""Walls as directed segments on level ground: extracted from a cloud, and those of a map.

Del Tufo, section 3.2: low points are removed, then points off vertical planes; the rest is projected on the ground, and lines
are found by RANSAC. Heights are above the ground below each point, since the sensor may fly. All segments are directed so that
the outside, from where a wall is seen, lies to the right: the two sides of a wall are not matched with each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.config.backend import OsmConfig
from lslam.core.kernels import ground
from lslam.core.types.arrays import Bools, Floats, Longs
from lslam.core.types.building import Building, Footprint, footprint_polygon, is_canopy
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
    """Walls in the points (N, 3), m, of a scan or of a submap, in a frame whose z points up.

    is_wall : (N,) which points may be of walls; the others tell where the ground is
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
    return Walls(_directed(found[:, :4].reshape(-1, 2, 2), seen_from), found[:, 4].astype(np.int64), found[:, 5])


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
            for ring in _simplified(footprint).rings:
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


def _directed(found: Floats, views: Floats) -> Floats:
    """The segments, directed with the side of most views to the right; a view weighs by distance from the line / range^3."""
    to_view = views[None] - found.mean(axis=1)[:, None]
    along = (found[:, 1] - found[:, 0])[:, None]
    left = along[..., 0] * to_view[..., 1] - along[..., 1] * to_view[..., 0]
    share = left / np.maximum(np.linalg.norm(to_view, axis=2), 1.0) ** 3
    return np.where((share.sum(axis=1) > 0)[:, None, None], found[:, ::-1], found)


def _simplified(footprint: Footprint) -> Footprint:
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
    """Buildings and their walls, in the map frame.

    walls : (T, 2, 2) m; owners : (T,) number of each one's building
    """

    def __init__(self, buildings: Sequence[Building]) -> None:
        self.buildings = tuple(buildings)
        self.walls, self.owners = walls_of(self.buildings)
        corners = [np.concatenate([f.outer for f in b.footprints]) for b in self.buildings]
        self._low = np.array([c.min(0) for c in corners]).reshape(-1, 2)
        self._high = np.array([c.max(0) for c in corners]).reshape(-1, 2)

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
        outside = np.maximum(np.maximum(self._low - place, place - self._high), 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))
