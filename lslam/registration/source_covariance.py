"""What surface a source point lies on, from its own scan."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.kernels.discs import EXTENT_M2, source_discs

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
    """As generalized ICP has it: the normal of the nearest points, whether these are of several rings or of one."""
    from scipy.spatial import cKDTree

    cloud = map_points.astype(np.float64)
    near = cloud[cKDTree(cloud).query(source, min(COVARIANCE_POINTS, len(cloud)))[1].reshape(len(source), -1)]
    away = near - near.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.swapaxes(away, 1, 2) @ away)[1][:, :, 0]
    discs = EXTENT_M2 * np.eye(3) - (EXTENT_M2 - thin) * normal[:, :, None] * normal[:, None, :]
    return np.ascontiguousarray(discs[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


def _of_voxels(source: Floats, map_points: NDArray[np.float32], thin: float) -> Floats:
    """The normal is that of the scan's own points in the cell around. A ring by itself has none: a disc across it would be
    a guess that holds the sensor to where the ring was. Such points get no normal but their noise, `thin` in all
    directions, and the map's normal alone decides.
    """
    scan = GaussianMap(COVARIANCE_CELL_M, capacity=1 << int(np.ceil(np.log2(max(len(map_points), 256)))), reach=np.inf)
    scan.insert(map_points, np.eye(4))
    out = np.tile([thin, 0.0, 0.0, thin, 0.0, thin], (len(source), 1))
    for cells in (scan.coarsen(CELL_FACTOR), scan):
        source_discs(source, cells.size, cells.planes, cells.keys, cells.table, thin, out)
    return out
