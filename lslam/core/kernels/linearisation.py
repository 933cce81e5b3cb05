"""The signature of every residual's `linearise`: one protocol, so that one optimiser takes all of them.

    linearise(points, target, settings, search, pose, width, sums) -> None

points : source points (S, 3), LiDAR frame, m, and the attributes of each
target : arrays of one map
settings : constant numbers. For voxels: size, m; variance of a point, m2; weights of planes and of non-planar voxels;
    factor on the latter along the sensor's axis; whether the map is the coarsest of several, which takes all remaining points.
search : results kept from one iteration to the next, and from one map to the next coarser one, see `Search`
pose : R (3, 3) and t (3,), m, world from LiDAR
width : width of the robust kernel, m; its final width, m; squared distance, m2, beyond which correspondences are rejected
sums : H and S (6, 6), whose upper triangles are added to, g (6,) and `facts`. S is the information of the surfaces alone, for
    residuals with full information matrices, see `residuals.thin_information`; the other residuals do not change it.

Pose update: t <- t + d[:3], R <- exp(d[3:]) R, so a residual n . (R s + t - m) has the Jacobian [n, (R s) x n].
"""

from __future__ import annotations

from lslam.core.arrays import Bools, Floats, Ints, Longs

Settings = tuple[float, float, float, float, float, bool]
# Octant cell (S,) and slots (S, 8) of each point; its nearest planar and non-planar voxel (S, 2), and the sphere within which
# these are the nearest (S, 4), see `residuals.nearest`; whether it is matched (S,); its squared distance (S,), m2, -1 where it
# is not.
Search = tuple[Longs, Ints, Ints, Floats, Bools, Floats]
Pose = tuple[Floats, Floats]
Width = tuple[float, float, float]
Sums = tuple[Floats, Floats, Floats, Floats]

# Indices of `facts`, an array of `COUNT` sums over the points beside the normal equations: information of the correspondences,
# 1/m2; squared residuals times robust weights, m2; points within the kernel's width; points with a correspondence; information
# times squared lever arm; robust weights; relative weights of the points, 0 for residuals without them, see
# `gauss_newton.scale_by_population`.
INFORMATION, SQUARED, INLIERS, MATCHED, LEVER, ROBUST, POPULATION = range(7)
COUNT = 7

# A value stands out of its noise: one in twenty does by chance.
SIGNIFICANT_SIGMAS = 2.0
# A value is none of its noise: one in four hundred is by chance.
OUTLIER_SIGMAS = 3.0
# Beyond so many hardly one value of a whole scan lies by chance: one in sixteen thousand does.
RARE_SIGMAS = 4.0
