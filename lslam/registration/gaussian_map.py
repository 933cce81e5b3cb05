"""Hashed voxels, each a running Gaussian with a normal, of the local map and of one scan.

The map forgets old ground as the sensor leaves it; a scan tells what surface a source point lies on.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError
from lslam.core.kernels import gaussians
from lslam.core.types.state import State, Stateful
from lslam.registration.kernels.gicp_residual import EXTENT_M2, source_discs

# Variance added to every voxel, (1 cm)2: a standing sensor would otherwise collapse the Gaussians.
FLOOR_M2 = 1e-4
# Points that a voxel needs before it is matched: a plane has three unknowns, and six points give its thickness too.
MIN_POINTS = 6
# (l1 - l0) / l2 of the eigenvalues above which a voxel is a plane: 1 on a disc, 0 on a line or a ball.
PLANARITY = 0.3
# Points that a voxel remembers: older ones fade, so that the map follows what changes.
COUNT_CAP = 200.0


class GaussianMap(Stateful):
    """Voxels of one size around the sensor.

    Parameters
    ----------
    size : m, edge of a voxel
    min_points : points that a voxel needs before it is matched; planarity : as `PLANARITY`, above which it is a plane
    count_cap : effective number of points of a voxel at most: older ones fade
    reach : m, voxels farther than this from the sensor are removed
    capacity : voxels that fit before the arrays are enlarged
    breadth : least spread of a plane's points across the beams that saw them, see `kernels.gaussians`; 0: any
    ring_gap : rad between neighbouring rings of the sensor; 0: unknown. A plane that several rings have seen needs less spread
    scan_variance : m2, variance that the points of one scan share, along the normal: of their pose, in a map of several scans
    """

    def __init__(
        self,
        size: float,
        *,
        min_points: int = MIN_POINTS,
        planarity: float = PLANARITY,
        count_cap: float = COUNT_CAP,
        reach: float = 150.0,
        capacity: int = 1 << 16,
        breadth: float = 0.0,
        ring_gap: float = 0.0,
        scan_variance: float = 0.0,
    ) -> None:
        self.size, self.min_points, self.planarity = size, min_points, planarity
        self.count_cap, self.reach = count_cap, reach
        self.breadth, self.ring_gap, self.scan_variance = breadth, ring_gap, scan_variance
        self.moments = np.zeros((capacity, 15))
        self.planes = np.zeros((capacity, 8))
        self.keys = np.full(capacity, gaussians.FREE, np.int64)
        self.refreshed = np.zeros(capacity)
        self.table = np.full(4 * capacity, -1, np.int32)
        self.pool = np.zeros(4, np.int64)
        self.free = np.zeros(capacity, np.int32)
        self._shapes = np.zeros((0, 14))

    def __len__(self) -> int:
        """Voxels that hold points."""
        return int(self.pool[gaussians.LIVE])

    def insert(self, points: NDArray[np.float32], T_world_lidar: Floats) -> int:
        """Add points (N, 3), m, LiDAR frame; returns how many lie too far from the origin to have a voxel.

        The pool grows before it can overflow: every point might open a voxel of its own.
        """
        while len(self.keys) - len(self) < len(points):
            self._grow()
        R, t = np.ascontiguousarray(T_world_lidar[:3, :3]), np.ascontiguousarray(T_world_lidar[:3, 3])
        rules = (
            self.size,
            self.count_cap,
            float(self.min_points),
            self.planarity,
            FLOOR_M2,
            self.scan_variance,
            self.breadth,
            self._ring_variance,
        )
        return gaussians.insert(points, R, t, *rules, self.reach, *self._arrays)

    def clear(self) -> None:
        """Remove all voxels; the arrays keep their size."""
        self.keys[:] = gaussians.FREE
        self.table[:] = -1
        self.pool[:] = 0
        self._shapes[:, 10] = 0.0

    def shapes(self) -> Floats:
        """(C, 14) full Gaussians of the voxels, as of `ndt_residual.describe`; brought up to date here."""
        from lslam.registration.kernels.ndt_residual import describe

        if len(self._shapes) < len(self.keys):
            self._shapes = np.zeros((len(self.keys), 14))
        describe(
            self.moments,
            self.planes,
            self.keys,
            self.refreshed,
            int(self.pool[gaussians.USED]),
            FLOOR_M2,
            max(EXTENT_M2, self.size**2),
            self._shapes,
        )
        return self._shapes

    def coarsen(self, factor: int) -> GaussianMap:
        """The same points in voxels `factor` times larger, from the exact moments.

        A ring leaves `factor` times more points in such a voxel, so that many more make a plane: it takes as many rings.
        """
        capacity = 1 << max(8, int(np.ceil(np.log2(len(self) + 1))))
        coarse = GaussianMap(
            self.size * factor,
            min_points=self.min_points * factor,
            planarity=self.planarity,
            count_cap=self.count_cap,
            reach=self.reach,
            capacity=capacity,
            breadth=self.breadth,
            ring_gap=self.ring_gap,
            scan_variance=self.scan_variance,
        )
        gaussians.coarsen(
            factor,
            coarse.size,
            float(coarse.min_points),
            self.planarity,
            FLOOR_M2,
            self.scan_variance,
            self.breadth,
            self._ring_variance,
            self.moments,
            self.keys,
            int(self.pool[gaussians.USED]),
            *coarse._arrays,
        )
        return coarse

    @property
    def _ring_variance(self) -> float:
        """Variance, rad2, of elevations that are spread evenly from one ring to the next."""
        return self.ring_gap**2 / 12

    @property
    def _arrays(self) -> tuple[Any, ...]:
        """All voxels, as the kernels take them."""
        return self.moments, self.planes, self.keys, self.refreshed, self.table, self.pool, self.free

    def state(self) -> State:
        """Voxels and free list as arrays, for a checkpoint."""
        used, freed = int(self.pool[gaussians.USED]), int(self.pool[gaussians.FREED])
        return {
            "capacity": len(self.keys),
            "moments": self.moments[:used],
            "planes": self.planes[:used],
            "keys": self.keys[:used],
            "refreshed": self.refreshed[:used],
            "free": self.free[:freed],
            "pool": self.pool,
            "shapes": self._shapes[:used] if len(self._shapes) else None,
        }

    def restore(self, state: State) -> None:
        """Replace all voxels by those of `state`; raises InputError when its arrays do not fit together."""
        capacity, numbers = int(state["capacity"]), np.asarray(state["pool"], np.int64)
        used, freed, hand, live = (int(v) for v in numbers)
        if not (0 <= freed <= used <= capacity <= 1 << 26 and 0 <= hand <= used and live == used - freed):
            raise InputError("a local map's voxels do not add up")
        pads = {"moments": 0, "planes": 0, "keys": gaussians.FREE, "refreshed": 0, "free": 0}
        for name, pad in pads.items():
            old = getattr(self, name)
            new = np.full((capacity, *old.shape[1:]), pad, old.dtype)
            new[: freed if name == "free" else used] = state[name]
            setattr(self, name, new)
        if np.count_nonzero(self.keys != gaussians.FREE) != live:
            raise InputError("a local map's voxels do not add up")
        if freed and not 0 <= self.free[:freed].min() <= self.free[:freed].max() < used:
            raise InputError("a local map gives back voxels that it does not have")
        self.pool = numbers.copy()
        self._shapes = np.zeros((0 if state["shapes"] is None else capacity, 14))
        if state["shapes"] is not None:
            self._shapes[:used] = state["shapes"]
        self._rehash()

    def _grow(self) -> None:
        """Double the room for voxels."""
        capacity = 2 * len(self.keys)
        for name in ("moments", "planes", "keys", "refreshed", "free"):
            old = getattr(self, name)
            new = np.full((capacity, *old.shape[1:]), gaussians.FREE if name == "keys" else 0, old.dtype)
            new[: len(old)] = old
            setattr(self, name, new)
        self._rehash()

    def _rehash(self) -> None:
        """Build the hash table anew for the present room."""
        self.table = np.full(4 * len(self.keys), -1, np.int32)
        gaussians.rehash(self.keys, self.table, int(self.pool[gaussians.USED]))


# m; a sparse sensor's neighbouring rings share a cell of the second size, where the first holds one of them.
COVARIANCE_CELL_M = 1.0
CELL_FACTOR = 2
# As many neighbours as Segal et al. (2009) take.
COVARIANCE_POINTS = 20

Neighbourhood = Literal["voxel", "knn"]


def source_covariance(
    source: Floats, map_points: NDArray[np.float32], thin: float, neighbourhood: Neighbourhood = "voxel"
) -> Floats:
    """Covariances (S, 6), m2, LiDAR frame, of source points (S, 3): discs of variance `thin` along their normal.

    neighbourhood : of which of the scan's own points (M, 3): `_of_voxels` or `_of_neighbours`
    """
    return (_of_neighbours if neighbourhood == "knn" else _of_voxels)(source, map_points, thin)


def _of_neighbours(source: Floats, map_points: NDArray[np.float32], thin: float) -> Floats:
    """Discs (S, 6), m2, of source points (S, 3): variance `thin` along the normal of the nearest map points (M, 3).

    These are of one ring or several, as in generalized ICP.
    """
    from scipy.spatial import cKDTree

    cloud = map_points.astype(np.float64)
    near = cloud[cKDTree(cloud).query(source, min(COVARIANCE_POINTS, len(cloud)))[1].reshape(len(source), -1)]
    away = near - near.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.swapaxes(away, 1, 2) @ away)[1][:, :, 0]
    discs = EXTENT_M2 * np.eye(3) - (EXTENT_M2 - thin) * normal[:, :, None] * normal[:, None, :]
    return np.ascontiguousarray(discs[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


def _of_voxels(source: Floats, map_points: NDArray[np.float32], thin: float) -> Floats:
    """Discs (S, 6), m2, whose normals are those of the scan's points in the voxel around.

    A single ring has no normal: a disc across it would hold the sensor to where the ring was. Its points get the variance
    `thin` in all directions, and the map's normal alone decides.
    """
    scan = GaussianMap(COVARIANCE_CELL_M, capacity=1 << int(np.ceil(np.log2(max(len(map_points), 256)))), reach=np.inf)
    scan.insert(map_points, np.eye(4))
    out = np.tile([thin, 0.0, 0.0, thin, 0.0, thin], (len(source), 1))
    for cells in (scan.coarsen(CELL_FACTOR), scan):
        source_discs(source, cells.size, cells.planes, cells.keys, cells.table, thin, out)
    return out
