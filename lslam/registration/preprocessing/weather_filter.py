"""Weather filter: removes returns of rain, snow, dust and multi-path by the number of neighbouring pulses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels import voxel
from lslam.core.types.arrays import Longs

# The field of view of a spinning scanner, 360 x 45 deg. With a smaller one the test is more lenient.
FIELD_OF_VIEW_SR = 4.8

# m; wide enough for several pulses of one ring at fifty metres, and as the source points' grid begins.
WIDE_CELL = 1.0

# Least share of sparse cells: edges make up to a fifth of a clear scan's cells sparse.
CLEAR = 0.25


# Largest share of returns to remove: beyond, the scan was downsampled before.
MOSTLY = 0.5


def on_surfaces(centroids: NDArray[np.float32], counts: NDArray[np.int32], leaf: float, least_line: float) -> Longs:
    """Indices of the centroids (M, 3), m, LiDAR frame, of cells of edge `leaf`, m, that a surface may lie in.

    A drop occupies a cell of its own where a surface has many returns per cell: a tenth of the returns can be two thirds of
    the cells. `counts` (M,) are the returns in each. The angle between pulses is the root of field of view over returns, so a
    surface at range r that crosses a cell has a line of edge / (r times that) returns, part of a ring or of a column; a drop
    has one. Cells with less than `least_line` of such a line are removed if their surroundings of WIDE_CELL have less, too:
    far away a small cell has one return at most. (The radius in which Charron et al. 2018 count neighbours of snow grows with
    range for the same reason.) All are kept where few cells would be removed, or most returns.
    """
    pulses = int(counts.sum())
    needed = least_line / np.sqrt(FIELD_OF_VIEW_SR / max(pulses, 1))
    is_accompanied = voxel.accompanied(centroids, counts, leaf * needed, WIDE_CELL, WIDE_CELL * needed)
    is_clear = len(counts) - len(is_accompanied) < CLEAR * len(counts)
    return np.arange(len(counts)) if is_clear or int(counts[is_accompanied].sum()) < MOSTLY * pulses else is_accompanied


def dense_points(points: NDArray[np.float32], neighbours: int, deviations: float) -> Longs:
    """Indices of the points (N, 3), m, that are no outliers, increasing.

    As Rusu et al. (2008), with the counting of Open3D: a point's mean distance to its `neighbours` nearest, itself
    among them, must lie below the mean of all points plus `deviations` standard deviations (ddof 1). Points whose
    neighbours all coincide with them have no distance and go too.
    """
    from scipy.spatial import cKDTree

    if len(points) <= neighbours:
        return np.arange(len(points))
    cloud = points.astype(np.float64)
    # Splitting in the middle builds in a tenth of the time; a scan has no clusters that would unbalance the tree.
    tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)
    distances, _ = tree.query(cloud, neighbours)
    mean = np.reshape(distances, (len(cloud), neighbours)).mean(1)
    positive = mean[mean > 0]
    if len(positive) < 2:
        return np.arange(len(points))
    limit = mean.mean() + deviations * np.sqrt(((positive - mean.mean()) ** 2).sum() / (len(mean) - 1))
    return np.flatnonzero((mean > 0) & (mean < limit))
