"""Removal of moving objects from a map: a point moved if beams of earlier or later scans pass through its place."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import se3, so3
from lslam.core.stopping import checking
from lslam.core.types.state import State
from lslam.maps.observations import Observations
from lslam.registration.preprocessing.ground import Z

# The ground is the lowest of some scans around a place, by squares of so many m; what is higher stands on it. On slopes
# above some 7 % ground does, too, as one large thing that does not move.
SQUARE, ABOVE = 1.0, 0.2
# m between two things, seen from above: beams of one ring are closer on a thing, and from ring to ring none is asked.
GAP = 0.3
# m from the sensor along each axis: farther, a thing is a few points.
REACH_M = 100.0
_SIDE = int(2 * REACH_M / SQUARE) + 2


@dataclass(frozen=True)
class Floor:
    """The lowest point of one scan in each square.

    first : (2,) number of the square in the corner, counted from the world's origin; lowest : (S, S) float32, m of the
        world's z, inf where there is no point
    """

    first: Longs
    lowest: NDArray[np.float32]

    def lower(self, image: NDArray[np.float32], first: Longs) -> None:
        """Update with the lower points of `image`, whose corner is the square `first`."""
        shift = np.clip(self.first - first, -_SIDE, _SIDE)
        (x, y), (u, v) = np.maximum(shift, 0), np.maximum(-shift, 0)
        there = image[x : _SIDE - u, y : _SIDE - v]
        np.minimum(there, self.lowest[u : _SIDE - x, v : _SIDE - y], out=there)


def floor_of(points: NDArray[np.float32], sensor: Floats) -> Floor:
    """Floor of points (N, 3), m, relative to the sensor, in world axes with z up; sensor : (3,) its position, m."""
    near = points[_within_reach(points)]
    first, squares = _squares(near, sensor)
    lowest = np.full((_SIDE, _SIDE), np.inf, np.float32)
    np.minimum.at(lowest.reshape(-1), squares, (near[:, 2] + sensor[2]).astype(np.float32))
    return Floor(first, lowest)


def standing(points: NDArray[np.float32], sensor: Floats, floors: Iterable[Floor]) -> Bools:
    """(N,) whether a point is within reach and above the ground, as far as `floors` cover it.

    points, sensor : as for `floor_of`; floors : of this scan and of others around it
    """
    from scipy import ndimage

    stands = np.zeros(len(points), np.bool_)
    within = np.flatnonzero(_within_reach(points))
    near = points[within]
    first, squares = _squares(near, sensor)
    ground = np.full((_SIDE, _SIDE), np.inf, np.float32)
    for floor in floors:
        floor.lower(ground, first)
    # A wheel hides the ground below: the squares around it know.
    ground = ndimage.minimum_filter(ground, 3, mode="constant", cval=np.inf)
    stands[within] = near[:, 2] + sensor[2] > ground.reshape(-1)[squares] + ABOVE
    return stands


def label_objects(points: NDArray[np.float32], subset: Bools) -> Longs:
    """Object number of each of the `subset` points (N, 3), from 1, by connected squares; 0 for the others.

    points : as for `floor_of`; subset : (N,), within reach
    """
    from scipy import ndimage

    labels = np.zeros(len(points), np.int64)
    x, y = np.floor((points[subset, :2] + REACH_M) / GAP).astype(np.int64).T
    taken = np.zeros((int(2 * REACH_M / GAP) + 1,) * 2, np.bool_)
    taken[x, y] = True
    numbered, _ = ndimage.label(taken, np.ones((3, 3)))
    labels[subset] = numbered[x, y]
    return labels


def whole(moves: Bools, labels: Longs, share: float, least: int) -> Bools:
    """Mask `moves` (N,) extended to all points of objects of which at least a `share` and at least `least` points are masked.

    labels : (N,) object of each point, 0 for none
    """
    total, moving = np.bincount(labels), np.bincount(labels, moves)
    subset = (moving >= least) & (moving >= share * total)
    subset[:1] = False  # 0 is no thing
    return np.asarray(moves | subset[labels])


def _squares(near: NDArray[np.float32], sensor: Floats) -> tuple[Longs, Longs]:
    """(2,) corner square of the area within reach, and (N,) index of each point's square in its flattened image."""
    first = np.floor((sensor[:2] - REACH_M) / SQUARE).astype(np.int64)
    at = np.floor((near[:, :2] + sensor[:2]) / SQUARE).astype(np.int64) - first
    return first, at[:, 0] * _SIDE + at[:, 1]


def _within_reach(points: NDArray[np.float32]) -> Bools:
    """(N,) whether a point is within reach; False for NaN."""
    x, y, z = np.abs(points).T
    return np.asarray((x < REACH_M) & (y < REACH_M) & (z < REACH_M))


# Scans before and after that are asked: at 10 Hz a pedestrian has left its place after 0.3 s, a lorry after 2.5 s. Every
# one between: of sparse beams most pass beside what is far.
OFFSETS = tuple(range(3, 26))
# How far behind a point must lie what another scan sees there: m, and m per m of range for poses that are turned.
MARGIN, SLOPE = 0.15, 0.01
# Share of that by which ground seen at a point's range may lie above or below it and still be it.
STEP_SHARE = 0.3
# Where this share of the points in a cube of so many m moves, the rest of them moves, too, ...
CUBE, SHARE = 0.5, 0.3
# ... and where this share of a thing does, and so many points, all of it: few beams seldom look through where one was.
MOST, LEAST = 0.4, 3
# The same of what is left of a thing without the points at which others saw something, too.
MOST_LEFT, LEAST_LEFT = 0.25, 2

# Sizes of pixels that are tried, finest first, until a scan fills so many of them.
COLUMNS_DEG, ROWS_DEG, FILLED = (0.4, 0.8, 1.6, 3.2), 0.3 * 1.15 ** np.arange(18), 0.85


@dataclass(frozen=True)
class PosedScan:
    """A deskewed scan and where it was taken.

    points : (N, 3) float32, m, LiDAR frame at the scan's stamp; T_world_lidar : (4, 4); intensity : (N,) float32 or None
    observations : of the same points, None where a map needs none
    """

    points: NDArray[np.float32]
    T_world_lidar: Floats
    intensity: NDArray[np.float32] | None = None
    observations: Observations | None = None

    def select(self, mask: NDArray[Any]) -> PosedScan:
        """The points that `mask` (bool or indices) keeps, with their intensity and observations."""
        return replace(
            self,
            points=self.points[mask],
            intensity=None if self.intensity is None else self.intensity[mask],
            observations=None if self.observations is None else self.observations.select(mask),
        )


@dataclass(frozen=True)
class _Grid:
    """Pixels of range images: `low` elevation of the lowest row's lower edge, rad; `size` of a row, rad."""

    low: float
    size: float
    rows: int
    columns: int


@dataclass(frozen=True)
class _Look:
    """Data of a scan for checking others: its pose, range image and floor."""

    T_world_lidar: Floats
    image: NDArray[np.float32]
    floor: Floor


class Cleaner:
    """Removes moving points from a stream of scans; a scan comes out `OFFSETS[-1]` scans later.

    Visibility between scans, as in Pomerleau et al. (ICRA 2014) and Removert (Kim and Kim, IROS 2020), but scan against
    scan, so that neither the map nor its length has to fit into memory. The ground never moves: beams that graze it say
    little, and only points of objects above it are tested.

    up : (3,) unit vector, up in the world of the scans
    removed : number of points removed; seen : of all points
    """

    def __init__(self, up: Floats = Z) -> None:
        self._R_level = so3.level_frame(up)
        self._scans: deque[PosedScan] = deque()
        self._looks: deque[_Look] = deque()
        self._grid: _Grid | None = None
        self._begin = self._decided = self._count = 0
        self._known = 0  # scans that were given back before the state that was restored
        self.removed = self.seen = 0

    def add(self, scan: PosedScan) -> list[PosedScan]:
        """Add the next scan. Returns the cleaned scans that are decided with it: those with all scans around them."""
        from lslam.maps.kernels.views import nearest_ranges

        points = np.ascontiguousarray(scan.points, np.float32)
        scan = replace(scan, points=points)
        if self._grid is None:
            self._grid = _grid_of(points)
        T, (upright, sensor) = scan.T_world_lidar, self._upright(scan)
        floor = floor_of(upright, sensor)
        image = np.full((1, 1, 3), np.inf, np.float32)
        if self._grid is not None:
            g = self._grid
            stands = standing(upright, sensor, [floor])
            image = nearest_ranges(points, stands, g.rows, g.columns, g.low, 1 / g.size)
        self._scans.append(scan)
        self._looks.append(_Look(T, image, floor))
        self._count += 1
        return self._decide() if self._count - self._decided > OFFSETS[-1] else []

    def finish(self) -> list[PosedScan]:
        """The cleaned scans that remain after the last one was added."""
        return [scan for _ in checking(range(self._count - self._decided)) for scan in self._decide()]

    def state(self) -> State:
        """State for `restore`; the scans themselves must be added again."""
        grid = None if self._grid is None else astuple(self._grid)
        return {"grid": grid, "decided": self._decided, "removed": self.removed, "seen": self.seen}

    def restore(self, state: State) -> int:
        """Restore `state` in an empty cleaner. Returns the number of the scan, from 0, from which to add again.

        Scans that came out already do not come out again.
        """
        self._grid = None if state["grid"] is None else _Grid(*state["grid"])
        self._known, self.removed, self.seen = state["decided"], state["removed"], state["seen"]
        self._begin = self._decided = self._count = max(self._known - OFFSETS[-1], 0)
        return self._count

    def _decide(self) -> list[PosedScan]:
        """Oldest undecided scan without its moving points, in a list; empty if an earlier part of the run delivered it."""
        scan, number = self._scans.popleft(), self._decided
        moves = None if number < self._known else self._moves(scan, number)
        self._decided += 1
        while self._begin < self._decided - OFFSETS[-1]:
            self._looks.popleft()
            self._begin += 1
        if moves is None:
            return []
        self.seen += len(moves)
        self.removed += int(moves.sum())
        return [scan.select(~moves)]

    def _moves(self, scan: PosedScan, number: int) -> Bools:
        """(N,) whether each point of scan `number` moved: the scans `OFFSETS` before and after it saw through its position."""
        around = (number + sign * offset for offset in OFFSETS for sign in (-1, 1))
        others = [self._looks[k - self._begin] for k in around if self._begin <= k < self._count]
        floors = [look.floor for look in (self._looks[number - self._begin], *others)]
        upright, sensor = self._upright(scan)
        stands = standing(upright, sensor, floors)
        points, upright = scan.points[stands], upright[stands]
        free, hit = self._votes(points, scan.T_world_lidar, others)
        moving = extend_to_cubes((free >= 1) & (free >= hit), points)
        # Somebody beside a wall is a thing once the wall, which others saw, is left aside; then the feet join.
        moving = whole(moving, label_objects(upright, moving | (free >= hit)), MOST_LEFT, LEAST_LEFT)
        moving = whole(moving, label_objects(upright, np.ones(len(points), np.bool_)), MOST, LEAST)
        moves = np.zeros(len(stands), np.bool_)
        moves[stands] = moving
        return moves

    def _upright(self, scan: PosedScan) -> tuple[NDArray[np.float32], Floats]:
        """Points (N, 3) relative to the sensor, and the sensor's position, m, in world axes with z up."""
        T = self._R_level @ scan.T_world_lidar[:3]
        with np.errstate(invalid="ignore"):  # organised clouds mark what they did not see by infinity
            return scan.points @ T[:, :3].T.astype(np.float32), T[:, 3]

    def _votes(
        self, points: NDArray[np.float32], T_world_lidar: Floats, others: list[_Look]
    ) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
        """For each point (N, 3), number of the `others` that looked through its place, and number that measured a surface there.

        Counting of a point ends as soon as the majority for a surface is certain.
        """
        from lslam.maps.kernels.views import vote

        free, hit = np.zeros(len(points), np.int16), np.zeros(len(points), np.int16)
        if self._grid is not None:
            low, inverse = self._grid.low, 1 / self._grid.size
            poses = np.array([look.T_world_lidar for look in others]).reshape(-1, 4, 4)
            for k, (look, T) in enumerate(zip(others, se3.relative(poses, T_world_lidar), strict=True)):
                vote(points, T, look.image, low, inverse, MARGIN, SLOPE, STEP_SHARE, len(others) - k, free, hit)
        return free, hit


def extend_to_cubes(moves: Bools, points: NDArray[np.float32]) -> Bools:
    """Mask (N,) extended to all points (N, 3), m, of cubes with a good share of masked points, such as wheels."""
    if not moves.any():
        return moves
    # Only cubes with a masked point matter.
    cells = np.floor(np.clip(points / CUBE, -1e6, 1e6)).astype(np.int64) + (1 << 20)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    cubes, moving = np.unique(keys[moves], return_counts=True)
    at = np.minimum(np.searchsorted(cubes, keys), len(cubes) - 1)
    inside = cubes[at] == keys
    total = np.bincount(at[inside], minlength=len(cubes))
    subset = (moving >= 2) & (moving >= SHARE * total)
    return np.asarray(moves | (inside & subset[at]))


def _grid_of(points: NDArray[np.float32]) -> _Grid | None:
    """Finest range image grid that this scan nearly fills; None when the scan is empty.

    Rings are farther apart than the points on them: a row must be as high as the gap between two rings, a column need not
    be as wide.
    """
    good = points[np.isfinite(points).all(1) & (np.abs(points).sum(1) > 0)].astype(np.float64)
    if not len(good):
        return None
    elevation = np.arctan2(good[:, 2], np.hypot(good[:, 0], good[:, 1]))
    azimuth = np.arctan2(good[:, 1], good[:, 0]) + np.pi
    low, high = np.quantile(elevation, [0.001, 0.999])
    for width in COLUMNS_DEG:
        for size in np.radians(ROWS_DEG):
            grid = _Grid(float(low - size / 2), float(size), int((high - low) / size) + 2, int(360 / width))
            if _fill_share(grid, elevation, azimuth) >= FILLED:
                return grid
    return grid


def _fill_share(grid: _Grid, elevation: Floats, azimuth: Floats) -> float:
    """Share of pixels with a point between the lowest and the highest of each column."""
    row = ((elevation - grid.low) / grid.size).astype(np.int64)
    column = np.minimum((azimuth / (2 * np.pi) * grid.columns).astype(np.int64), grid.columns - 1)
    inside = (row >= 0) & (row < grid.rows)
    image = np.zeros((grid.rows, grid.columns), np.bool_)
    image[row[inside], column[inside]] = True
    used = image[:, image.any(0)]
    span = grid.rows - used[::-1].argmax(0) - used.argmax(0)
    return float(used.sum() / max(span.sum(), 1))
