"""Where a curve is best, where it is lost, where its elbow is."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lslam.types.sensitivity import Bools, Curve, Divergence, Floats, Optimum

FLAT = 0.1  # what differs by less than a tenth is as good
Rise = Literal["worse", "as good", "unknown"]
ELBOW = 1.5  # an error above so many times the plateau's is not on the plateau


def divergence(curve: Curve) -> Divergence:
    """From which value on the curve is lost.

    A value is lost when more than half of its runs are; the curve is lost from the first lost value above which, itself
    counted, more than half of the values are. What is lost below stands alone: one unlucky value is not a divergence.
    """
    ran = curve.ran.any(1)
    values, bad = curve.values[ran], curve.is_lost[ran]
    for i in np.flatnonzero(bad):
        if 2 * bad[i:].sum() > len(bad) - i:
            before = float(values[i - 1]) if i else None
            return Divergence(before, float(values[i]), tuple(float(v) for v in values[:i][bad[:i]]))
    return Divergence(None, None, tuple(float(v) for v in values[bad]))


def optimum(values: Floats, means: Floats, *, is_highest_best: bool = True) -> Optimum | None:
    """The best value and its flat surroundings: all values next to it, without a gap, that are at most a tenth worse.

    means : (V,) above 0, nan or 0 where there is nothing; None when there is nothing at all
    """
    known = np.isfinite(means) & (means > 0)
    if not known.any():
        return None
    values, score = values[known], means[known] if is_highest_best else 1 / means[known]
    best = int(np.argmax(score))
    good = score >= (1 - FLAT) * score[best]
    low = high = best
    while low > 0 and good[low - 1]:
        low -= 1
    while high + 1 < len(good) and good[high + 1]:
        high += 1
    return Optimum(float(values[best]), float(values[low]), float(values[high]))


def elbow(values: Floats, errors: Floats, is_lost: Bools) -> float | None:
    """The value from which on the error lies on its plateau, None when it does not at the largest value.

    The plateau is the median error of the upper half of the values, and reaches 1.5 times that high.
    errors : (V,) nan where unknown
    """
    known = np.isfinite(errors) | is_lost
    values, errors, is_lost = values[known], errors[known], is_lost[known]
    upper = errors[len(errors) // 2 :][~is_lost[len(errors) // 2 :]]
    if not len(upper):
        return None
    good = ~is_lost & (np.nan_to_num(errors, nan=np.inf) <= ELBOW * np.median(upper))
    bad = np.flatnonzero(~good)
    first = int(bad[-1]) + 1 if len(bad) else 0
    return float(values[first]) if first < len(values) else None


def rise_below(curve: Curve, value: float) -> Rise:
    """Whether the error below a value is worse than from there on: by a tenth, and by more than the seeds scatter.

    Seed by seed against its own median from `value` on; a value at which most runs are lost is worse. It takes one that is
    worse, or all that are as good.
    """
    errors = np.where(curve.lost, np.nan, curve.quantities["translation"])
    from_there = np.isfinite(errors) & (curve.values >= value)[:, None]
    plateau = np.array(
        [
            np.median(column[known]) if known.any() else np.nan
            for column, known in zip(errors.T, from_there.T, strict=True)
        ]
    )
    below = np.flatnonzero((curve.values < value) & curve.ran.any(1))
    are_as_good = []
    for v in below:
        if curve.is_lost[v]:
            return "worse"
        more = errors[v] - plateau
        more = more[np.isfinite(more)]
        if len(more) < 2:
            are_as_good.append(False)
        elif more.mean() > max(more.std(ddof=1), FLAT * float(np.nanmean(plateau))):
            return "worse"
        else:
            are_as_good.append(True)
    return "as good" if are_as_good and all(are_as_good) else "unknown"
