"""Changes against the map: absent buildings, through which scans see, and new walls, where no building is.

Both are said only when several keyframes agree, and a building is called absent only when nothing at all stands near its
outline and walls behind it were seen through it from wherever they were seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se2
from lslam.kernels import wall_matching
from lslam.osm.wall_match import LIKENESS
from lslam.osm.walls import walls_of
from lslam.stopping import checking
from lslam.types.building import Building, KeyframeMatch, footprint_polygon, is_canopy

Floats = NDArray[np.float64]

VIEWS = 3  # keyframes that must agree
NEAR = 1.5  # m; what is seen so near an outline may be its building
STEP = 1.0  # m between the points of a wall that rays are drawn to
WIDE = 3.0  # m of wall that must be seen through a building
DEPTH = 0.5  # m that a ray must pass inside an outline at least
ONE_LINE = 0.5  # m; walls seen so near one line are one
ONE_WAY = np.sin(np.radians(10.0))
LONG = 6.0  # m; a shorter wall is a hedge, a van, a sign


@dataclass(frozen=True)
class _Sight:
    """The walls (S, 2, 2) seen about a keyframe and the sensor's places (V, 2) there, m, map frame."""

    keyframe: int
    walls: Floats
    views: Floats


def absent_buildings(
    buildings: Sequence[Building], sights: Sequence[KeyframeMatch], poses: Mapping[int, Floats]
) -> NDArray[np.bool_]:
    """(B,) true where nothing is seen near the outline and walls behind are seen through it.

    buildings : at their real places, m, map frame; poses : (3,) of each keyframe in it
    """
    from shapely import STRtree, linestrings, points

    looks = _placed(sights, poses)
    shapes = [_ground(building) for building in buildings]
    found = np.zeros(len(shapes), bool)
    everything = [_samples(look.walls) for look in looks]
    seen = np.concatenate(everything) if everything else np.zeros((0, 2))
    if not len(seen) or not shapes:
        return found
    near, _ = STRtree(points(seen)).query([s.buffer(NEAR) for s in shapes], predicate="intersects")
    is_near = np.isin(np.arange(len(shapes)), near)
    candidates = [k for k in range(len(shapes)) if not is_near[k] and not is_canopy(buildings[k])]
    cores = [shapes[k].buffer(-DEPTH / 2) for k in candidates]
    counts = np.zeros(len(candidates), np.int64)
    tree = STRtree(cores)
    for look, samples in zip(checking(looks), everything, strict=True):
        rays = np.stack(np.broadcast_arrays(look.views[:, None], samples[None]), axis=2)
        ray, core = tree.query(linestrings(rays.reshape(-1, 2, 2)), predicate="intersects")
        hits = np.zeros((len(samples), len(candidates)), np.int64)
        np.add.at(hits, (ray % max(len(samples), 1), core), 1)
        # Whichever of its places the sensor saw the wall from, the way led through the building.
        counts += (hits == len(look.views)).sum(axis=0) * STEP >= WIDE
    found[candidates] = counts >= VIEWS
    return found


def new_walls(buildings: Sequence[Building], sights: Sequence[KeyframeMatch], poses: Mapping[int, Floats]) -> Floats:
    """(S, 2, 2) walls, m, map frame, that `VIEWS` keyframes saw and that no building has, longest first.

    buildings, poses : as of `absent_buildings`
    """
    from shapely import points, prepare, union_all

    known = np.ascontiguousarray(walls_of(buildings)[0].reshape(-1, 4))
    ground = union_all([_ground(building).buffer(ONE_LINE) for building in buildings])
    prepare(ground)
    lines: list[_Line] = []
    for look in checking(_placed(sights, poses)):
        rows = np.ascontiguousarray(look.walls.reshape(-1, 4))
        # Which side of it is outside a wall seen askew does not always tell.
        pairs = [
            wall_matching.fit(side, known, np.zeros(3), NEAR, LIKENESS, False)[2]
            for side in (rows, np.ascontiguousarray(rows[:, [2, 3, 0, 1]]))
        ]
        is_inside = ground.contains(points(look.walls.mean(axis=1))) if len(rows) else np.zeros(0, bool)
        for wall in look.walls[(pairs[0] < 0) & (pairs[1] < 0) & ~is_inside]:
            for line in lines:
                if line.takes(wall, look.keyframe):
                    break
            else:
                lines.append(_Line(wall, look.keyframe))
    kept = [line.segment for line in lines if len(line.keyframes) >= VIEWS and line.length >= LONG]
    order = sorted(kept, key=lambda s: -float(np.linalg.norm(s[1] - s[0])))
    return np.array(order).reshape(-1, 2, 2)


class _Line:
    """Walls seen again and again on one line, as long as they reach together."""

    def __init__(self, wall: Floats, keyframe: int) -> None:
        self._from, along = wall[0], wall[1] - wall[0]
        self.length = float(np.linalg.norm(along))
        self._u = along / max(self.length, 1e-9)
        self._low, self._high = 0.0, self.length
        self.keyframes = {keyframe}

    def takes(self, wall: Floats, keyframe: int) -> bool:
        """Take a wall that lies on it and touches it, or nearly so."""
        away = wall - self._from
        s, d = away @ self._u, away @ [-self._u[1], self._u[0]]
        leaning = abs(d[1] - d[0]) > ONE_WAY * abs(s[1] - s[0])
        if leaning or np.abs(d).max() > ONE_LINE or s.min() > self._high + NEAR or s.max() < self._low - NEAR:
            return False
        self._low, self._high = min(self._low, float(s.min())), max(self._high, float(s.max()))
        self.length = self._high - self._low
        self.keyframes.add(keyframe)
        return True

    @property
    def segment(self) -> Floats:
        """(2, 2) m."""
        return np.asarray(self._from + np.outer([self._low, self._high], self._u))


def _placed(sights: Sequence[KeyframeMatch], poses: Mapping[int, Floats]) -> list[_Sight]:
    found = []
    for sight in sights:
        if sight.keyframe in poses:
            pose = poses[sight.keyframe]
            views = sight.views if len(sight.views) else np.zeros((1, 2))
            found.append(_Sight(sight.keyframe, se2.apply(pose, sight.walls), se2.apply(pose, views[:, :2])))
    return found


def _samples(walls: Floats) -> Floats:
    """(N, 2) points on all walls, `STEP` apart."""
    counts = [int(np.linalg.norm(wall[1] - wall[0]) / STEP) + 1 for wall in walls]
    shares = [(np.arange(n) + 0.5)[:, None] / n for n in counts]
    found = [wall[0] + share * (wall[1] - wall[0]) for wall, share in zip(walls, shares, strict=True)]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _ground(building: Building) -> Any:
    from shapely import union_all

    return union_all([footprint_polygon(f).buffer(0) for f in building.footprints])
