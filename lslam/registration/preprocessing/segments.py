"""What LeGO-LOAM (Shan and Englot 2018) asks of a scan first: what is ground, and what belongs to something large enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Bools, Floats, Ints, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import LoamConfig
from lslam.core.types.scan import Scan
from lslam.registration.kernels import range_image
from lslam.registration.preprocessing.features import (
    MAY_BE_EDGE,
    MAY_BE_FLAT,
    MAY_BE_PLANE,
    Features,
    RingWalk,
    features_along,
    walk_rings,
)
from lslam.registration.preprocessing.ground import GROUND_CELL_M, GROUND_REACH_M, levelling, up_of

# Steepest ground against the dominant plane.
GROUND_ANGLE_DEG = 10.0
# Neighbours whose line makes more with the beam belong together.
SEGMENT_ANGLE_DEG = 60.0
# Smaller clusters are clutter, unless they have so many points on so many rings, as poles have.
SEGMENT_POINTS, SMALL_SEGMENT_POINTS, SMALL_SEGMENT_RINGS = 30, 5, 3
# m; a ring's next neighbour on the ground is at least so far off, so that noise does not tilt the line between them.
_BASELINE = 0.3
# m; noise of height, and what a kerb may rise at once.
_TOLERANCE = 0.1
# m; points of one pixel that are so far apart are not the same thing.
_SAME = 0.3

# The floor is looked for up to so many times the range of the lowest rings, an eighth of all, in one of so many points.
_FLOOR_REACH = 3.0
_LOWEST = 8
_FLOOR_SHARE = 4


@dataclass(frozen=True)
class Segments:
    """What LeGO-LOAM keeps of a scan.

    ground : (N,) bool, of each point of the scan; labels : (N,) int32, 1, 2, ... of its clusters off the ground, 0 for the
    ground, for clusters that are too small, and for points outside the range gate
    """

    ground: Bools
    labels: Ints

    @property
    def count(self) -> int:
        """Number of clusters."""
        return int(self.labels.max(initial=0))


def lego_features(
    scan: Scan, config: LoamConfig | None = None, gate: PreprocessConfig | None = None
) -> tuple[Features, Segments]:
    """Features as LeGO-LOAM takes them: edges off the ground, planes on it, less planar points of both, clutter left out.

    Raises InputError as `extract_features` does.
    """
    config = config or LoamConfig()
    gate = gate or PreprocessConfig()
    walk = walk_rings(scan, gate)
    segments = _segment(scan, walk, up_of(gate))
    may_be = np.uint8(MAY_BE_EDGE | MAY_BE_FLAT) * (segments.labels > 0)
    may_be += np.uint8(MAY_BE_PLANE | MAY_BE_FLAT) * segments.ground
    return features_along(scan, walk, config, may_be), segments


def _segment(scan: Scan, walk: RingWalk, vertical: Floats) -> Segments:
    """Segment a scan in its range image into ground and clusters; vertical : (3,) approximate up."""
    slopes = range_image.row_slopes(walk.points, walk.starts) * (1.0 if vertical[2] >= 0 else -1.0)
    with_slope = np.flatnonzero(np.isfinite(slopes))
    row = np.zeros(len(slopes), np.int64)
    upwards = with_slope[np.argsort(slopes[with_slope], kind="stable")]
    if not len(upwards):
        return Segments(np.zeros(len(scan), bool), np.zeros(len(scan), np.int32))
    row[upwards] = np.arange(len(with_slope))
    elevation = np.arctan(np.sort(slopes[with_slope]))
    columns = max(round(2 * np.pi / walk.step), 1)
    pixel, nearest = range_image.project(walk.points, walk.ranges, walk.starts, row, len(with_slope), columns)
    up, floor = _floor(walk, upwards[: max(1, len(upwards) // _LOWEST)], vertical)
    ground = range_image.find_ground(
        walk.points, nearest, columns, up, floor, np.tan(np.radians(GROUND_ANGLE_DEG)), _BASELINE, _TOLERANCE
    )
    labels = range_image.cluster(
        walk.ranges,
        nearest,
        ground,
        columns,
        elevation,
        np.radians(SEGMENT_ANGLE_DEG),
        (SEGMENT_POINTS, SMALL_SEGMENT_POINTS, SMALL_SEGMENT_RINGS),
    )
    return Segments(
        *range_image.point_labels(walk.ranges, walk.order, pixel, nearest, ground, labels, _SAME, len(scan))
    )


def _floor(walk: RingWalk, lowest: Longs, vertical: Floats) -> tuple[Floats, float]:
    """The upward direction (3,) and the height of the dominant plane along it, m.

    It is looked for where the vehicle stands or the drone hovers: within a few times the range at which the `lowest` rings
    meet it. Without a plane the sensor counts as level and the floor lies where those rings end.
    """
    first = np.concatenate([np.arange(walk.starts[k], walk.starts[k + 1]) for k in lowest])
    reach = min(_FLOOR_REACH * float(np.median(walk.ranges[first])), GROUND_REACH_M)
    near = np.flatnonzero(walk.ranges < reach)[::_FLOOR_SHARE]
    R, floor = levelling(walk.points[near].astype(np.float32), _TOLERANCE, int(reach / GROUND_CELL_M) + 1, vertical)
    if floor == -np.inf:
        floor = float(np.median(walk.points[first] @ vertical))
    return np.ascontiguousarray(R[2]), floor
