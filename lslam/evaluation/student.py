"""How far a mean of few observations may lie from the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lslam.types.study import Floats


def two_sided(level: float, freedom: ArrayLike) -> Floats:
    """Standard errors either way that hold the truth with confidence `level`, by Student's t of `freedom` degrees.

    As `scipy.stats.t.ppf`, whose import takes longer than the rest of a study's evaluation.

    >>> round(float(two_sided(0.95, 2)), 3)
    4.303
    """
    from scipy.special import stdtrit

    return np.asarray(stdtrit(np.asarray(freedom, np.float64), 0.5 + level / 2), np.float64)
