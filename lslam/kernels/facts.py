"""Facts of a linearisation beside its normal equations: the indices in `facts`, an array of `COUNT` sums.

INFORMATION, 1/m2; SQUARED, weighted squared residuals, m2; INLIERS, points within the kernel's width; MATCHED, points that
found a counterpart; LEVER, information times squared lever arm; ROBUST, robust weights; POPULATION, what points weigh against
each other, where a residual weighs them, see `gauss_newton.scale_by_population`.
"""

INFORMATION, SQUARED, INLIERS, MATCHED, LEVER, ROBUST, POPULATION = range(7)
COUNT = 7
