"""What every residual's `linearise` takes and gives: one protocol, so that one loop steps by all of them.

    linearise(points, target, settings, search, pose, width, sums) -> None

points : source points (S, 3), LiDAR frame, and what goes with each; target : arrays of one map
settings : numbers that stay as they are; on voxels size, m, variance of a point, m2, weights of planes and of blobs, the
    blobs' part along the sensor's axis, and whether this is the coarsest of several maps, which takes what the others left
search : what is remembered from one iteration to the next, and of one map for the next coarser one, see `Search`
pose : R (3, 3) and t (3,); width : of the robust kernel, m, the one it ends with, and the squared distance, m2, beyond
    which correspondences are rejected
sums : H and S (6, 6), of which the upper triangles are added to, g (6,) and facts. S is the information of the surfaces
    alone, for residuals whose matrices are full, see `surface_information`; the others leave it be.

Pose update: t <- t + d[:3], R <- exp(d[3:]) R, so a residual n . (R s + t - m) has the Jacobian [n, (R s) x n].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Flags = NDArray[np.bool_]

Settings = tuple[float, float, float, float, float, bool]
# Octant cell (S,) and slots (S, 8) of each point, its nearest plane and blob (S, 2) and where and how long that holds (S, 4),
# see `residuals.nearest`; whether it is matched, and its squared distance, -1 where it is not.
Search = tuple[Longs, Ints, Ints, Floats, Flags, Floats]
Pose = tuple[Floats, Floats]
Width = tuple[float, float, float]
Sums = tuple[Floats, Floats, Floats, Floats]
