"""What surface a source point lies on, from its own scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.discs import source_discs
from lslam.registration.gaussian_map import GaussianMap

# m; a sparse sensor's neighbouring rings share a cell of the second size, where the first holds one of them.
CELL = 1.0
WIDENING = 2


def source_covariance(
    source: NDArray[np.float64], map_points: NDArray[np.float32], thin: float
) -> NDArray[np.float64]:  # fmt: skip
    """Covariances (S, 6), m2, LiDAR frame, of source points (S, 3): discs of variance `thin` along their normal.

    The normal is that of the scan's own points in the cell around. A ring by itself has none: a disc across it would be
    a guess that holds the sensor to where the ring was. Such points get no normal but their noise, `thin` in all
    directions, and the map's normal alone decides.
    """
    scan = GaussianMap(CELL, capacity=1 << int(np.ceil(np.log2(max(len(map_points), 256)))), reach=np.inf)
    scan.insert(map_points, np.eye(4))
    out = np.tile([thin, 0.0, 0.0, thin, 0.0, thin], (len(source), 1))
    for cells in (scan.coarsen(WIDENING), scan):
        source_discs(source, cells.size, cells.planes, cells.keys, cells.table, thin, out)
    return out
