"""Curves of a study, one per sequence, method, IMU and value of the second parameter; and laws over a parameter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lslam.core.arrays import Bools, Floats
from lslam.core.types.study import Curve, Divergence, Interval, Law, LawKind, Optimum, StudyRow, Value

# Everything else is registration: what Girolimetto's times per iteration hold (equation 5.2).
NOT_REGISTRATION = ("read", "prepare", "standing", "keyframe", "integrity")
# A run is lost when its error is that many times the best of the study ...
LOST_FACTOR = 10.0
# ... and more than Girolimetto takes for a result: its largest rmse that is one (LOAM, large eight) is 2.156 m.
LOST_FLOOR_M = 2.2
CONFIDENCE = 0.95
FLAT_SHARE = 0.1  # what differs by less than a tenth is as good
ELBOW = 1.5  # an error above so many times the plateau's is not on the plateau
Rise = Literal["worse", "as good", "unknown"]
FEWEST = 6
BAND_LEVEL = 0.99  # as the bands of Girolimetto's figure 5.19
_ROUNDS = 5


def t_half_width(level: float, freedom: ArrayLike) -> Floats:
    """Half width of the two-sided interval of confidence `level`, in standard errors, by Student's t of `freedom` degrees.

    As `scipy.stats.t.ppf`, whose import takes longer than the rest of a study's evaluation.

    >>> round(float(t_half_width(0.95, 2)), 3)
    4.303
    """
    from scipy.special import stdtrit

    return np.asarray(stdtrit(np.asarray(freedom, np.float64), 0.5 + level / 2), np.float64)


def lost_above(rows: Sequence[StudyRow]) -> float:
    """Error, m, above which a run counts as lost: 10 times the best of all rows, at least 2.2 m."""
    errors = [row.error for row in rows if row.is_usable and np.isfinite(row.error)]
    return max(LOST_FLOOR_M, LOST_FACTOR * min(errors, default=0.0))


def curves_of(rows: Sequence[StudyRow], limit: float | None = None) -> list[Curve]:
    """Curves in the order their rows appear; the first studied parameter is the abscissa.

    rows : of one study; runs beside it are left out; limit : m, `lost_above` of the rows by default
    """
    rows = [row for row in rows if row.parameters and not row.is_beside]
    limit = lost_above(rows) if limit is None else limit
    groups: dict[tuple[object, ...], list[StudyRow]] = {}
    for row in rows:
        abscissa, *_ = row.parameters
        others = tuple((key, value) for key, value in row.parameters.items() if key != abscissa)
        groups.setdefault((row.sequence, row.method, row.uses_imu, abscissa, others), []).append(row)
    return [_curve(group, limit) for group in groups.values()]


def registration_ms(row: StudyRow) -> float:
    """Mean time per scan of registration in all its stages; nan when nothing was timed."""
    own = [ms for name, ms in row.stages_ms.items() if name not in NOT_REGISTRATION]
    return sum(own) if own else float("nan")


def _curve(rows: Sequence[StudyRow], limit: float) -> Curve:
    """Curve of runs with one method over their first parameter: tables (V, S) of value and seed, NaN where no run is usable.

    limit : error, m, above which a run is lost
    """
    parameter, *_ = rows[0].parameters
    at = [(key, value) for key, value in rows[0].parameters.items() if key != parameter]
    given: list[Value] = [row.parameters[parameter] for row in rows]
    is_number = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in given)
    order = sorted(set(given)) if is_number else list(dict.fromkeys(given))
    seeds = tuple(sorted({row.seed for row in rows}))
    cells = {(order.index(value), seeds.index(row.seed)): row for value, row in zip(given, rows, strict=True)}

    def table(number: Callable[[StudyRow], float]) -> Floats:
        out = np.full((len(order), len(seeds)), np.nan)
        for cell, row in cells.items():
            out[cell] = number(row) if row.is_usable else np.nan
        return out

    def mask(holds: Callable[[StudyRow], bool]) -> Bools:
        out = np.zeros((len(order), len(seeds)), bool)
        for cell, row in cells.items():
            out[cell] = holds(row)
        return out

    translation, angular = table(lambda row: row.error), table(lambda row: row.angular_rmse_deg)
    per_scan, total = table(registration_ms), table(lambda row: row.total_time_s)
    lost = mask(lambda row: row.diverges) | (translation > limit)
    stages = list(dict.fromkeys(name for row in rows for name in row.stages_ms))
    return Curve(
        sequence=rows[0].sequence,
        method=rows[0].method,
        uses_imu=rows[0].uses_imu,
        parameter=parameter,
        values=np.array(order if is_number else range(len(order)), np.float64),
        seeds=seeds,
        quantities={
            "translation": translation,
            "angular": angular,
            "time_per_scan": per_scan,
            "total_time": total,
            "fallback": 100 * table(lambda row: row.fallback_share),
            "efficiency": np.where(lost, 0.0, efficiency(translation, angular, per_scan / 1e3)),
            "total_efficiency": np.where(lost, 0.0, efficiency(translation, angular, total)),
        },
        stages={name: table(lambda row, name=name: row.stages_ms.get(name, np.nan)) for name in stages},  # type: ignore[misc]
        losses=lost,
        # A run that failed otherwise, for want of memory or a file, says nothing about its parameters.
        ran=mask(lambda row: row.is_usable or row.diverges),
        at=tuple(at),
        words=() if is_number else tuple(str(value) for value in order),
        is_timed_alone=all(row.is_timing_comparable for row in rows if row.is_usable),
    )


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


def over_seeds(table: Floats) -> Interval:
    """Mean over the seeds (V, S) that have a number, with Student's t interval of `CONFIDENCE`.

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
    error[several] = std[several] / np.sqrt(n[several]) * t_half_width(CONFIDENCE, n[several] - 1)
    return Interval(mean, mean - error, mean + error, n, std)


def divergence(curve: Curve) -> Divergence:
    """Value from which on the curve is lost.

    A value is lost when more than half of its runs are. The curve is lost from the first lost value from which on more than
    half of the values are lost. So one unlucky value is not a divergence.
    """
    scored = curve.with_score.any(1)
    values, bad = curve.values[scored], curve.loses_most[scored]
    for i in np.flatnonzero(bad):
        if 2 * bad[i:].sum() > len(bad) - i:
            before = float(values[i - 1]) if i else None
            return Divergence(before, float(values[i]), tuple(float(v) for v in values[:i][bad[:i]]))
    return Divergence(None, None, tuple(float(v) for v in values[bad]))


def optimum(values: Floats, means: Floats, *, is_highest_best: bool = True) -> Optimum | None:
    """Best value and its flat surroundings: the adjacent values whose mean is at most a tenth worse.

    means : (V,) above 0, nan or 0 where there is nothing; None when there is nothing at all
    """
    known = np.isfinite(means) & (means > 0)
    if not known.any():
        return None
    values, score = values[known], means[known] if is_highest_best else 1 / means[known]
    best = int(np.argmax(score))
    good = score >= (1 - FLAT_SHARE) * score[best]
    low = high = best
    while low > 0 and good[low - 1]:
        low -= 1
    while high + 1 < len(good) and good[high + 1]:
        high += 1
    return Optimum(float(values[best]), float(values[low]), float(values[high]))


def elbow(values: Floats, errors: Floats, lost_mask: Bools) -> float | None:
    """Value from which on the error is on its plateau, None when it is not even at the largest value.

    The plateau is the median error of the upper half of the values; errors up to 1.5 times that belong to it.

    errors : (V,) nan where unknown; lost_mask : (V,) whether runs at a value are lost, which is off the plateau
    """
    known = np.isfinite(errors) | lost_mask
    values, errors, lost_mask = values[known], errors[known], lost_mask[known]
    upper = errors[len(errors) // 2 :][~lost_mask[len(errors) // 2 :]]
    if not len(upper):
        return None
    good = ~lost_mask & (np.nan_to_num(errors, nan=np.inf) <= ELBOW * np.median(upper))
    bad = np.flatnonzero(~good)
    first = int(bad[-1]) + 1 if len(bad) else 0
    return float(values[first]) if first < len(values) else None


@dataclass(frozen=True)
class Contrast:
    """Ratio seed by seed: mean and standard deviation of its natural logarithm over `n` seeds that have both numbers.

    With fewer than two seeds the scatter is unknown, so every test returns False.
    """

    mean: float
    std: float
    n: int

    def exceeds(self, ratio: float) -> bool:
        """Whether the ratio is above `ratio` by more than the scatter over seeds."""
        return self.n > 1 and self.mean - self.std > log(ratio)

    def stays_below(self, ratio: float) -> bool:
        """Whether the ratio is below `ratio` by more than the scatter over seeds."""
        return self.n > 1 and self.mean + self.std < log(ratio)

    @property
    def is_more(self) -> bool:
        """Whether the first is larger by a tenth, and by more than the scatter over seeds."""
        return self.exceeds(1) and self.mean > log(1 + FLAT_SHARE)

    @property
    def is_no_more(self) -> bool:
        """Whether the first is larger by less than a tenth, scatter included."""
        return self.stays_below(1 + FLAT_SHARE)


def contrast(first: Floats, second: Floats) -> Contrast:
    """Contrast of `first` over `second`, (S,) each, positive, nan where a seed has none.

    >>> contrast(np.array([2.0, 2.2, 1.9]), np.ones(3)).is_more
    True
    >>> contrast(np.array([2.0, 1.0, 0.5]), np.ones(3)).is_more
    False
    """
    known = np.isfinite(first) & np.isfinite(second) & (first > 0) & (second > 0)
    n = int(known.sum())
    if n < 2:
        return Contrast(float("nan"), float("nan"), n)
    logs = np.log(first[known] / second[known])
    return Contrast(float(logs.mean()), float(logs.std(ddof=1)), n)


def valid_runs(curve: Curve, name: str = "translation") -> Floats:
    """(V, S) a quantity of the runs that were not lost, by default the translation rmse, m; nan for the others."""
    return np.where(curve.losses, np.nan, curve.quantities[name])


def plateau(curve: Curve, value: float) -> Floats:
    """(S,) median error of each seed from a value on, m; nan where it has none."""
    return median_over_seeds(valid_runs(curve)[curve.values >= value].T)


def rise_at(curve: Curve, index: int, level: Floats) -> Rise:
    """Whether the error at the value number `index` is worse than a level (S,), m, of each seed.

    A value at which most runs are lost is worse.
    """
    if curve.loses_most[index]:
        return "worse"
    ratio = contrast(valid_runs(curve)[index], level)
    return "worse" if ratio.is_more else "as good" if ratio.is_no_more else "unknown"


def rise_below(curve: Curve, value: float) -> Rise:
    """Whether the error below a value is worse than from there on: `worse` if any value is, `as good` if all are."""
    below = np.flatnonzero((curve.values < value) & curve.with_score.any(1))
    rises = {rise_at(curve, int(index), plateau(curve, value)) for index in below}
    return "worse" if "worse" in rises else "as good" if rises == {"as good"} else "unknown"


def fit_law(
    kind: LawKind,
    names: Sequence[str],
    points: Floats,
    times: Floats,
    runs: Floats | None = None,
    level: float = BAND_LEVEL,
    scatter: Floats | None = None,
) -> Law | None:
    """Fit a law to mean times; None from fewer than 6 different points at which it says something.

    Timings scatter in proportion to themselves, so the standard deviation of an observation is taken as proportional to the
    law over the root of its number of runs, and the fit is repeated with the weights of the law found before.

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
    coefficients, weights = _fit(columns, t, n)
    law_times = columns @ coefficients
    freedom = len(t) - columns.shape[1]
    weighted = columns * weights[:, None]
    variance = float(np.sum(((t - law_times) * weights) ** 2) / freedom)
    covariance = np.asarray(variance * np.linalg.inv(weighted.T @ weighted), np.float64)
    margins = float(t_half_width(level, freedom)) * np.sqrt(np.diag(covariance))
    r2 = _r2(t, law_times)
    return Law(kind, tuple(names), coefficients, margins, covariance, freedom, level, x, t, law_times, r2, std)


def law_over(kind: LawKind, curve: Curve, times: Interval) -> Law | None:
    """Law, as by `fit_law`, of the total times of a curve over its own parameter."""
    return fit_law(kind, (curve.parameter,), curve.values, times.mean, times.n.astype(np.float64), scatter=times.std)


def rival(law: Law) -> tuple[str, float]:
    """Alternative law that the times may follow, as text, and its R2; empty and -inf where there is none.

    Over a narrow range a line and a hyperbola are alike, and a product is not tested by a parameter that hardly varied.
    """
    x, t = law.points, law.times
    inverse = [] if (x[:, 0] == 0).any() else [("a / x", design("inverse", x))]
    designs = {
        "linear": inverse,
        "inverse": [("a x + b", design("linear", x))],
        "product": [*inverse, ("a y", x[:, 1:])],
    }[law.kind]
    fits = {said: _r2(t, columns @ _fit(columns, t, np.ones(len(t)))[0]) for said, columns in designs}
    return max(fits.items(), key=lambda fit: fit[1], default=("", float("-inf")))


def _fit(columns: Floats, t: Floats, n: Floats) -> tuple[Floats, Floats]:
    """(P,) coefficients of columns (N, P), and the (N,) weights they were found with; n : (N,) runs."""
    from scipy.linalg import lstsq

    law_times = t
    coefficients, weights = np.zeros(columns.shape[1]), np.zeros(len(t))
    for _ in range(_ROUNDS):
        # A line may cross zero on its way: no weight is larger than that of the shortest time.
        weights = np.sqrt(n) / np.maximum(law_times, t.min())
        coefficients = lstsq(columns * weights[:, None], t * weights)[0]
        law_times = columns @ coefficients
    return coefficients, weights


def _r2(times: Floats, law_times: Floats) -> float:
    """Coefficient of determination; nan where all observations are equal."""
    spread = float(np.sum((times - times.mean()) ** 2))
    return 1 - float(np.sum((times - law_times) ** 2)) / spread if spread > 0 else float("nan")


def design(kind: LawKind, points: Floats) -> Floats:
    """(N, P) design matrix of a law at points (N, K)."""
    x = points[:, 0]
    if kind == "linear":
        return np.stack([x, np.ones(len(x))], 1)
    return (1 / x if kind == "inverse" else points[:, 1] / x)[:, None]


def band(law: Law, points: Floats) -> tuple[Floats, Floats]:
    """Value of the law at points (N,) or (N, K), and half width of its confidence band there, s."""
    columns = design(law.kind, _columns(points))
    deviation = np.sqrt(np.einsum("ni,ij,nj->n", columns, law.covariance, columns))
    return columns @ law.coefficients, float(t_half_width(law.level, law.freedom)) * deviation


def _columns(points: Floats) -> Floats:
    """Points as columns (N, K), also of one parameter."""
    points = np.asarray(points, np.float64)
    return points[:, None] if points.ndim == 1 else points
