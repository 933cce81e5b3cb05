"""Whether numbers of a study differ by more than its seeds scatter."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Literal

import numpy as np

from lslam.evaluation.curves import FLAT
from lslam.types.study import Curve, Floats

Rise = Literal["worse", "as good", "unknown"]


@dataclass(frozen=True)
class Contrast:
    """A ratio seed by seed: mean and standard deviation of its natural logarithm over `n` seeds that have both numbers.

    With fewer than two seeds nothing is known of the scatter, so none of the questions is answered with yes.
    """

    mean: float
    std: float
    n: int

    def exceeds(self, ratio: float) -> bool:
        """Whether it lies above `ratio` by more than the seeds scatter."""
        return self.n > 1 and self.mean - self.std > log(ratio)

    def stays_below(self, ratio: float) -> bool:
        """Whether it lies below `ratio` by more than the seeds scatter."""
        return self.n > 1 and self.mean + self.std < log(ratio)

    @property
    def is_more(self) -> bool:
        """Whether it is more by a tenth, and by more than the seeds scatter."""
        return self.exceeds(1) and self.mean > log(1 + FLAT)

    @property
    def is_no_more(self) -> bool:
        """Whether it is less than a tenth more, scatter included."""
        return self.stays_below(1 + FLAT)


def contrast(first: Floats, second: Floats) -> Contrast:
    """`first` over `second`, (S,) each and above 0, nan where a seed has none.

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


def errors_of(curve: Curve) -> Floats:
    """(V, S) m, translation rmse of the runs that were not lost."""
    return np.where(curve.lost, np.nan, curve.quantities["translation"])


def plateau(curve: Curve, value: float) -> Floats:
    """(S,) m, median error of each seed from a value on; nan where it has none."""
    errors = errors_of(curve)[curve.values >= value]
    known = np.isfinite(errors).any(0)
    out = np.full(errors.shape[1], np.nan)
    out[known] = np.nanmedian(errors[:, known], axis=0)
    return out


def rise_at(curve: Curve, index: int, level: Floats) -> Rise:
    """Whether the error at a value is worse than a level (S,); a value at which most runs are lost is."""
    if curve.is_lost[index]:
        return "worse"
    ratio = contrast(errors_of(curve)[index], level)
    return "worse" if ratio.is_more else "as good" if ratio.is_no_more else "unknown"


def rise_below(curve: Curve, value: float) -> Rise:
    """Whether the error below a value is worse than from there on: it takes one that is, or all that are as good."""
    below = np.flatnonzero((curve.values < value) & curve.scored.any(1))
    rises = {rise_at(curve, int(index), plateau(curve, value)) for index in below}
    return "worse" if "worse" in rises else "as good" if rises == {"as good"} else "unknown"
