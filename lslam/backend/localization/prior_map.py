"""The map that a drive is located in: its points, its vertical, and the part of it round the sensor as Gaussian voxels."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lslam.backend.loops.level_submap import find_up, level_rotation
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.kernels.transform import transform
from lslam.core.types.arrays import Floats, Points
from lslam.core.types.gnss import Georeference
from lslam.registration.alignment import MapAlignment
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import LocalMap
from lslam.registration.preprocessing.ground import Z

# m, edge of the blocks that points are sorted into; the local map is made anew where the sensor enters another.
BLOCK_M = 32.0
# Local maps kept: a drive along the border of two blocks needs both.
KEPT = 3
# Points that the vertical is estimated from, at most, and that one insertion takes.
LOOKED_AT, AT_ONCE = 400_000, 1 << 17
# On a map of another day no earlier scan tells how many points can agree: the shares of a scan that the map has, and that agree.
MAP_MIN_OVERLAP = 0.2
MAP_MIN_INLIERS = 0.3


@dataclass
class PriorMap:
    """A cloud in level axes, z up, about an origin near its middle.

    points : (N, 3) float32, m, sorted by block; T_map_level : (4, 4) from these axes into the map's own coordinates
    georeference : of the map's own coordinates, None when unknown; source : for messages
    origin : (3,) m, what was taken from the coordinates of its file
    """

    points: Points
    T_map_level: Floats
    georeference: Georeference | None = None
    source: str = ""
    origin: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        blocks = np.floor(self.points[:, :2] / BLOCK_M).astype(np.int64)
        self._low = blocks.min(axis=0)
        self._shape = blocks.max(axis=0) - self._low + 1
        numbers = (blocks[:, 0] - self._low[0]) * self._shape[1] + blocks[:, 1] - self._low[1]
        order = np.argsort(numbers, kind="stable")
        self.points = np.ascontiguousarray(self.points[order])
        self._begins = np.searchsorted(numbers[order], np.arange(int(self._shape.prod()) + 1))

    def __len__(self) -> int:
        return len(self.points)

    def around(self, centre: Floats, reach: float) -> Points:
        """Points (M, 3), m, of the blocks within `reach` m of `centre` (2,) or (3,), level axes."""
        low, high = (np.floor((centre[:2] + s * reach) / BLOCK_M).astype(np.int64) - self._low for s in (-1, 1))
        low, high = np.maximum(low, 0), np.minimum(high, self._shape - 1)
        if (low > high).any():
            return np.zeros((0, 3), np.float32)
        rows = np.arange(low[0], high[0] + 1) * self._shape[1]
        parts = [self.points[self._begins[row + low[1]] : self._begins[row + high[1] + 1]] for row in rows]
        return np.concatenate(parts)

    def along(self, positions: Floats, reach: float) -> Points:
        """Points (M, 3), m, within `reach` m horizontally of the blocks that positions (N, 3) lie in, level axes."""
        entered = np.unique(np.floor(positions[:, :2] / BLOCK_M).astype(np.int64), axis=0)
        steps = np.arange(-int(np.ceil(reach / BLOCK_M)), int(np.ceil(reach / BLOCK_M)) + 1)
        near = entered[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) - self._low
        near = near[((near >= 0) & (near < self._shape)).all(axis=-1)]
        parts = [self.points[self._begins[n] : self._begins[n + 1]] for n in np.unique(near @ [self._shape[1], 1])]
        return np.concatenate([self.points[:0], *parts])


def make_prior_map(
    points: Floats,
    config: RegistrationConfig,
    georeference: Georeference | None = None,
    source: str = "",
    origin: Floats | None = None,
    up: Floats = Z,
) -> PriorMap:
    """Level a cloud (N, 3), m, of the map's coordinates, which may be as large as those of a projection.

    origin : (3,) m, what is taken from the coordinates of the file; up : (3,) unit vector in them, about which it is looked for
    Raises InputError for a cloud without finite points.
    """
    origin = np.zeros(3) if origin is None else origin
    points = points[np.isfinite(points).all(axis=1)] - origin
    if not len(points):
        raise InputError(f"{source} has no finite point: it is no map")
    middle = np.round(np.median(points, axis=0))
    local = (points - middle).astype(np.float32)
    planes = GaussianMap(
        config.voxel_size,
        reach=np.inf,
    )
    insert_all(planes, local[:: max(len(local) // LOOKED_AT, 1)])
    T = se3.make(level_rotation(find_up([planes], up)).T, middle)
    level = np.empty_like(local)
    transform(local, se3.make(T[:3, :3].T, np.zeros(3)), level)
    return PriorMap(level, T, georeference, source, origin)


def insert_all(target: GaussianMap | LocalMap, points: Points) -> None:
    """Enter points (N, 3), m, level axes, in parts, so that the room for them grows with the voxels and not with the points."""
    for first in range(0, len(points), AT_ONCE):
        part = points[first : first + AT_ONCE]
        if isinstance(target, LocalMap):
            target.insert(part, part.astype(np.float64), np.eye(4))
        else:
            target.insert(part, np.eye(4))


class LocalView:
    """The map round the sensor as registration wants it, a function of the block that the sensor is in.

    reach : m, how far points are needed
    """

    def __init__(self, prior_map: PriorMap, config: RegistrationConfig, reach: float) -> None:
        self._map, self._config, self._reach = prior_map, config, reach
        self._alignments: OrderedDict[tuple[int, int], MapAlignment] = OrderedDict()

    def at(self, position: Floats) -> MapAlignment:
        """Alignment with the map round a position (3,), level axes."""
        block = (int(np.floor(position[0] / BLOCK_M)), int(np.floor(position[1] / BLOCK_M)))
        if block not in self._alignments:
            self._alignments[block] = self._make(block)
        self._alignments.move_to_end(block)
        while len(self._alignments) > KEPT:
            self._alignments.popitem(last=False)
        return self._alignments[block]

    def _make(self, block: Sequence[int]) -> MapAlignment:
        c = self._config
        centre = (np.array(block) + 0.5) * BLOCK_M
        # Nobody knows which beams saw a point of a finished map.
        target = LocalMap(c.voxel_size, reach=np.inf, breadth=0.0)
        insert_all(target, self._map.around(centre, self._reach + BLOCK_M / 2))
        return MapAlignment(target, c)
