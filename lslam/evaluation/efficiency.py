"""How good a run is for the time it takes (Girolimetto, equations 5.2 and 5.3), and means over seeds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lslam.evaluation.student import two_sided
from lslam.types.study import Floats, Interval

LEVEL = 0.95


def efficiency(translation: ArrayLike, angular: ArrayLike, seconds: ArrayLike) -> Floats:
    """1 / (translation rmse in m, angular rmse in deg, time in s); nan where one of them is not above 0 or unknown.

    Time is that of registration per scan for equation 5.2 and the total for equation 5.3 of Girolimetto.

    >>> float(efficiency(0.5, 2.0, 0.1))
    10.0
    """
    product = np.asarray(translation, np.float64) * np.asarray(angular, np.float64) * np.asarray(seconds, np.float64)
    return np.asarray(np.divide(1.0, product, out=np.full_like(product, np.nan), where=product > 0))


def normalise(values: Floats) -> Floats:
    """Values over the largest of them, as Girolimetto shows efficiency; all nan where there is none above 0."""
    known = values[np.isfinite(values)]
    top = float(known.max()) if len(known) else 0.0
    return values / top if top > 0 else np.full_like(values, np.nan)


def median_over_seeds(table: Floats) -> Floats:
    """(V,) median over the seeds (V, S) that have a number: one lucky or unlucky seed of three does not move it."""
    out = np.full(len(table), np.nan)
    known = np.isfinite(table).any(1)
    out[known] = np.nanmedian(table[known], axis=1)
    return out


def over_seeds(table: Floats, level: float = LEVEL) -> Interval:
    """Mean over the seeds (V, S) that have a number, with Student's t interval of `level`.

    Seeds are few, so the interval is wide: three of them stand for 4.3 standard errors either way. One has none.
    """
    known = np.isfinite(table)
    n = known.sum(1)
    total = np.where(known, table, 0.0).sum(1)
    mean = np.divide(total, n, out=np.full(len(n), np.nan), where=n > 0)
    squares = np.where(known, (table - mean[:, None]) ** 2, 0.0).sum(1)
    several = n > 1
    std, error = np.full(len(n), np.nan), np.full(len(n), np.nan)
    std[several] = np.sqrt(squares[several] / (n[several] - 1))
    error[several] = std[several] / np.sqrt(n[several]) * two_sided(level, n[several] - 1)
    return Interval(mean, mean - error, mean + error, n, std)
