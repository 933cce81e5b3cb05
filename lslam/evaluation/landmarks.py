"""Where a curve is best, where it is lost, where its elbow is."""

from __future__ import annotations

import numpy as np

from lslam.types.study import Bools, Curve, Divergence, Floats, Optimum

FLAT = 0.1  # what differs by less than a tenth is as good
ELBOW = 1.5  # an error above so many times the plateau's is not on the plateau


def divergence(curve: Curve) -> Divergence:
    """From which value on the curve is lost.

    A value is lost when more than half of its runs are; the curve is lost from the first lost value above which, itself
    counted, more than half of the values are. What is lost below stands alone: one unlucky value is not a divergence.
    """
    scored = curve.scored.any(1)
    values, bad = curve.values[scored], curve.is_lost[scored]
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
