"""The local map of `dlo`: keyframes around the sensor, spaced by the room about it (Chen et al. 2022)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import se3, so3
from lslam.registration.local_map import LocalMap, MapScans
from lslam.registration.preprocessing.prepare import PreparedPoints

# Median range beyond which keyframes stand so far apart, m, and how far they do where it is less.
SPACING_M = ((20.0, 10.0), (10.0, 5.0), (5.0, 1.0))
NARROW_SPACING_M = 0.5
# Of the median range, what stays from scan to scan: a door is passed in a second, a keyframe later is soon enough.
FORGETTING_FACTOR = 0.95
KEYFRAME_TURN_RAD = np.deg2rad(30.0)
NEARBY_SPACINGS = 1.5  # spacings within which another keyframe already looks another way
NEAREST_KEYFRAMES = 10
HULL_KEYFRAMES = 10
# Share of the longest axis below which keyframes have no extent along another.
FLAT_SHARE = 0.01


class KeyframeSubmap(MapScans):
    """Keyframes spaced by the room around the sensor, of which the nearest and those of the hull make the local map.

    The map has the `NEAREST_KEYFRAMES`, and of the convex hull the `HULL_KEYFRAMES` nearest. Chen, Lopez, Agha-mohammadi and
    Mehta: Direct LiDAR Odometry (RA-L 2022), sections III-D and III-E.
    """

    STATE = ("clouds", "poses", "chosen", "spaciousness", "hull")

    def __init__(self) -> None:
        self.clouds: list[tuple[NDArray[np.float32], Floats]] = []
        self.poses: list[Floats] = []
        self.chosen: tuple[int, ...] = ()
        self.spaciousness = 0.0
        self.hull: tuple[int, ...] = ()

    def enter(self, target: LocalMap, points: PreparedPoints, T_world_lidar: Floats) -> None:
        """Add a keyframe when it is due; the map is built anew when other keyframes are nearest."""
        median = float(np.median(np.linalg.norm(points.source, axis=1))) if len(points.source) else 0.0
        self.spaciousness = (
            FORGETTING_FACTOR * self.spaciousness + (1 - FORGETTING_FACTOR) * median if self.poses else median
        )
        if self._is_due(T_world_lidar):
            self.clouds.append((points.map_points, points.source))
            self.poses.append(T_world_lidar.copy())
            self.hull = hull_of(self._positions())
        chosen = self._select(T_world_lidar[:3, 3])
        if chosen == self.chosen:
            return
        if not set(self.chosen) <= set(chosen):
            target.clear()
            self.chosen = ()
        for k in chosen:
            if k not in self.chosen:
                target.insert(*self.clouds[k], self.poses[k])
        self.chosen = chosen

    def _positions(self) -> Floats:
        """(K, 3) m, world, of all keyframes."""
        return np.stack([pose[:3, 3] for pose in self.poses])

    def _is_due(self, T: Floats) -> bool:
        """Whether a pose T (4, 4) is far from every keyframe, or turned away from the only one near by."""
        if not self.poses:
            return True
        spacing = spacing_of(self.spaciousness)
        distances = np.linalg.norm(self._positions() - T[:3, 3], axis=1)
        nearest = int(np.argmin(distances))
        if distances[nearest] > spacing:
            return True
        turned = float(so3.angle(se3.relative(self.poses[nearest], T)[:3, :3]))
        return turned > KEYFRAME_TURN_RAD and int((distances < NEARBY_SPACINGS * spacing).sum()) <= 1

    def _select(self, position: Floats) -> tuple[int, ...]:
        """Numbers of the keyframes that are the map around `position` (3,), in the order they were made."""
        distances = np.linalg.norm(self._positions() - position, axis=1)
        nearest = np.argsort(distances, kind="stable")[:NEAREST_KEYFRAMES]
        hull = np.array(self.hull, np.int64)
        outer = hull[np.argsort(distances[hull], kind="stable")[:HULL_KEYFRAMES]]
        return tuple(int(k) for k in np.union1d(nearest, outer))


def spacing_of(spaciousness: float) -> float:
    """Distance between keyframes, m, where points are `spaciousness`, m, away in the median."""
    return next((spacing for beyond, spacing in SPACING_M if spaciousness > beyond), NARROW_SPACING_M)


def hull_of(positions: Floats) -> tuple[int, ...]:
    """Rows of `positions` (N, 3), m, on their convex hull, in the space that they have an extent in."""
    centred = positions - positions.mean(axis=0)
    if len(positions) < 3:
        return tuple(range(len(positions)))
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    dimensions = int((extents > FLAT_SHARE * extents[0]).sum()) if extents[0] > 0 else 0
    along = centred @ axes[:dimensions].T
    if dimensions == 0:
        return (0,)
    if dimensions == 1:
        return tuple(sorted({int(along[:, 0].argmin()), int(along[:, 0].argmax())}))
    if len(positions) <= dimensions + 1:
        return tuple(range(len(positions)))
    from scipy.spatial import ConvexHull

    return tuple(sorted(int(k) for k in ConvexHull(along).vertices))
