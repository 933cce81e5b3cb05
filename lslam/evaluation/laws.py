"""Laws of computing time over a parameter, by weighted least squares, with their confidence (Girolimetto, section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lslam.core.types.arrays import Floats
from lslam.core.types.study import Curve, Interval, Law, LawKind
from lslam.evaluation.curves import two_sided

FEWEST = 6
LEVEL = 0.99  # as the bands of Girolimetto's figure 5.19
_ROUNDS = 5


def fit_law(
    kind: LawKind,
    names: Sequence[str],
    points: Floats,
    times: Floats,
    runs: Floats | None = None,
    level: float = LEVEL,
    scatter: Floats | None = None,
) -> Law | None:
    """Fit a law to mean times; None from fewer than 6 different points at which it says something.

    Timings scatter in proportion to themselves, so the standard deviation of an observation is taken as proportional to the
    law over the root of its number of runs, and the fit is repeated with the weights of the law found before.

    Parameters
    ----------
    points : (N,) values of the parameter, for `product` (N, 2) of x and y; times : (N,) s, means over `runs` (N,) runs each
    level : of the confidence intervals, 0..1; scatter : (N,) s, of the runs behind each mean, as the law keeps it
    """
    x, t = _columns(points), np.asarray(times, np.float64)
    n = np.ones(len(t)) if runs is None else np.asarray(runs, np.float64)
    std = np.full(len(t), np.nan) if scatter is None else np.asarray(scatter, np.float64)
    known = np.isfinite(t) & (t > 0) & (n > 0) & np.isfinite(x).all(1)
    if kind != "linear":  # a time of infinity, or of zero, is no observation
        known &= (x != 0).all(1)
    x, t, n, std = x[known], t[known], n[known], std[known]
    if len(np.unique(x, axis=0)) < FEWEST:
        return None
    columns = design(kind, x)
    coefficients, weights = _fitted(columns, t, n)
    expected = columns @ coefficients
    freedom = len(t) - columns.shape[1]
    weighted = columns * weights[:, None]
    variance = float(np.sum(((t - expected) * weights) ** 2) / freedom)
    covariance = np.asarray(variance * np.linalg.inv(weighted.T @ weighted), np.float64)
    margins = float(two_sided(level, freedom)) * np.sqrt(np.diag(covariance))
    r2 = _r2(t, expected)
    return Law(kind, tuple(names), coefficients, margins, covariance, freedom, level, x, t, expected, r2, std)


def law_over(kind: LawKind, curve: Curve, times: Interval) -> Law | None:
    """As `fit_law`, of the total times of a curve over its own parameter."""
    return fit_law(kind, (curve.parameter,), curve.values, times.mean, times.n.astype(np.float64), scatter=times.std)


def rival(law: Law) -> tuple[str, float]:
    """What else the times may follow, in letters, and the R2 of that.

    A line and a hyperbola are alike over a narrow range, and a product says nothing of a parameter that hardly varied.
    """
    x, t = law.points, law.observed
    inverse = [] if (x[:, 0] == 0).any() else [("a / x", design("inverse", x))]
    designs = {
        "linear": inverse,
        "inverse": [("a x + b", design("linear", x))],
        "product": [*inverse, ("a y", x[:, 1:])],
    }[law.kind]
    fits = {said: _r2(t, columns @ _fitted(columns, t, np.ones(len(t)))[0]) for said, columns in designs}
    return max(fits.items(), key=lambda fit: fit[1], default=("", float("-inf")))


def _fitted(columns: Floats, t: Floats, n: Floats) -> tuple[Floats, Floats]:
    """(P,) coefficients of columns (N, P), and the (N,) weights they were found with; n : (N,) runs."""
    from scipy.linalg import lstsq

    expected = t
    coefficients, weights = np.zeros(columns.shape[1]), np.zeros(len(t))
    for _ in range(_ROUNDS):
        # A line may cross zero on its way: no weight is larger than that of the shortest time.
        weights = np.sqrt(n) / np.maximum(expected, t.min())
        coefficients = lstsq(columns * weights[:, None], t * weights)[0]
        expected = columns @ coefficients
    return coefficients, weights


def _r2(observed: Floats, expected: Floats) -> float:
    """nan where all are the same."""
    spread = float(np.sum((observed - observed.mean()) ** 2))
    return 1 - float(np.sum((observed - expected) ** 2)) / spread if spread > 0 else float("nan")


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
