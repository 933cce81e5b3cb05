"""Laws of computing time over a parameter, by weighted least squares, with their confidence (first thesis, section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lslam.evaluation.student import two_sided
from lslam.types.sensitivity import Floats, Law, LawKind

FEWEST = 6
LEVEL = 0.99  # as the bands of the thesis' figure 5.19
_ROUNDS = 5


def fit_law(
    kind: LawKind, names: Sequence[str], points: Floats, times: Floats, runs: Floats | None = None, level: float = LEVEL
) -> Law | None:
    """Fit a law to mean times; None from fewer than 6 different points at which it says something.

    Timings scatter in proportion to themselves, so the standard deviation of an observation is taken as proportional to the
    law over the root of its number of runs, and the fit is repeated with the weights of the law found before.

    Parameters
    ----------
    points : (N,) values of the parameter, for `product` (N, 2) of x and y; times : (N,) s, means over `runs` (N,) runs each
    level : of the confidence intervals, 0..1
    """
    x, t = _columns(points), np.asarray(times, np.float64)
    n = np.ones(len(t)) if runs is None else np.asarray(runs, np.float64)
    known = np.isfinite(t) & (t > 0) & (n > 0) & np.isfinite(x).all(1)
    if kind != "linear":  # a time of infinity, or of zero, is no observation
        known &= (x != 0).all(1)
    x, t, n = x[known], t[known], n[known]
    if len(np.unique(x, axis=0)) < FEWEST:
        return None
    from scipy.linalg import lstsq

    columns = design(kind, x)
    expected = t
    coefficients, weights = np.zeros(columns.shape[1]), np.zeros(len(t))
    for _ in range(_ROUNDS):
        # A line may cross zero on its way: no weight is larger than that of the shortest time.
        weights = np.sqrt(n) / np.maximum(expected, t.min())
        coefficients = lstsq(columns * weights[:, None], t * weights)[0]
        expected = columns @ coefficients
    freedom = len(t) - columns.shape[1]
    weighted = columns * weights[:, None]
    variance = float(np.sum(((t - expected) * weights) ** 2) / freedom)
    covariance = np.asarray(variance * np.linalg.inv(weighted.T @ weighted), np.float64)
    margins = float(two_sided(level, freedom)) * np.sqrt(np.diag(covariance))
    spread = float(np.sum((t - t.mean()) ** 2))
    r2 = 1 - float(np.sum((t - expected) ** 2)) / spread if spread > 0 else float("nan")
    return Law(kind, tuple(names), coefficients, margins, covariance, freedom, level, x, t, expected, r2)


def design(kind: LawKind, points: Floats) -> Floats:
    """(N, P) what the coefficients of a law are multiplied with at points (N, K)."""
    x = points[:, 0]
    if kind == "linear":
        return np.stack([x, np.ones(len(x))], 1)
    return (1 / x if kind == "inverse" else points[:, 1] / x)[:, None]


def band(law: Law, points: Floats) -> tuple[Floats, Floats]:
    """The law at points (N,) or (N, K) and the half width of its confidence band there, s."""
    columns = design(law.kind, _columns(points))
    deviation = np.sqrt(np.einsum("ni,ij,nj->n", columns, law.covariance, columns))
    return columns @ law.coefficients, float(two_sided(law.level, law.freedom)) * deviation


def _columns(points: Floats) -> Floats:
    points = np.asarray(points, np.float64)
    return points[:, None] if points.ndim == 1 else points
