"""Sums over the points of a linearisation beside its normal equations: the indices in `facts`, an array of `COUNT` sums.

INFORMATION : information of the correspondences, 1/m2
SQUARED : squared residuals times robust weights, m2
INLIERS : points within the kernel's width
MATCHED : points with a correspondence
LEVER : information times squared lever arm
ROBUST : robust weights
POPULATION : relative weights of the points, 0 for residuals without them, see `gauss_newton.scale_by_population`
"""

INFORMATION, SQUARED, INLIERS, MATCHED, LEVER, ROBUST, POPULATION = range(7)
COUNT = 7
