"""What is made of a sensitivity study: curves over a parameter, laws, optima, verdicts; plain values for reports."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.types.study import StudyRow, Value, series_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Outcome = Literal["confirmed", "refuted", "undecided"]
# And the numbers that say so.
Judged = tuple[Outcome, str]
LawKind = Literal["linear", "inverse", "product"]


@dataclass(frozen=True)
class Curve:
    """One method over the studied parameter, as tables over values and seeds (V, S).

    values : (V,) of `parameter`, ascending; 0, 1, 2 .. when they are words, and then `words` names them
    at : the other studied parameter and its value; empty in a one-way study
    quantities : translation (m), angular (deg), time_per_scan (ms, of registration), total_time (s), fallback (% of the scans
        that the method did not pose), efficiency (equation 5.2 of Girolimetto), total_efficiency (5.3); nan where a run
        has no such number or is not usable
    stages : ms per scan by name; lost : runs that diverged, by their status or by their error; ran : runs there are
    is_timed_alone : no run shared the machine with another
    """

    sequence: str
    method: str
    uses_imu: bool
    parameter: str
    values: Floats
    seeds: tuple[int, ...]
    quantities: dict[str, Floats]
    stages: dict[str, Floats]
    lost: Bools
    ran: Bools
    at: tuple[tuple[str, Value], ...] = ()
    words: tuple[str, ...] = ()
    is_timed_alone: bool = True

    @property
    def series(self) -> str:
        """The method for people, with its IMU."""
        return series_of(self.method, self.uses_imu)

    @property
    def label(self) -> str:
        """The series and where it stands in a two-way study."""
        return ", ".join([self.series, *(f"{key.rpartition('.')[2]} {value:g}" if isinstance(value, float) else
                                         f"{key.rpartition('.')[2]} {value}" for key, value in self.at)])  # fmt: skip

    @property
    def scored(self) -> Bools:
        """(V, S) runs that say whether their values work: with an error, or lost. One without ground truth does not."""
        return np.asarray(self.lost | np.isfinite(self.quantities["translation"]))

    @property
    def is_lost(self) -> Bools:
        """(V,) values at which more than half of the runs that say so were lost."""
        return np.asarray(2 * self.lost.sum(1) > self.scored.sum(1))

    def of_seed(self, index: int) -> Curve:
        """The same curve of one of its seeds alone."""
        one = slice(index, index + 1)
        return replace(
            self,
            seeds=self.seeds[one],
            quantities={name: table[:, one] for name, table in self.quantities.items()},
            stages={name: table[:, one] for name, table in self.stages.items()},
            lost=self.lost[:, one],
            ran=self.ran[:, one],
        )

    def name_of(self, value: float) -> str:
        """A value of the parameter for people."""
        return self.words[int(value)] if self.words else f"{value:g}"


@dataclass(frozen=True)
class Interval:
    """Mean over seeds with its confidence interval, (V,) each; without one (nan) where fewer than two runs count.

    std : of single runs, likewise nan
    """

    mean: Floats
    low: Floats
    high: Floats
    n: NDArray[np.int64]
    std: Floats


@dataclass(frozen=True)
class Divergence:
    """From which value on a curve is lost; None for both where it never is.

    last_good : the value before `first_bad`, None when that is the first; alone : lost values below `first_bad`
    """

    last_good: float | None
    first_bad: float | None
    alone: tuple[float, ...] = ()


@dataclass(frozen=True)
class Optimum:
    """The best value and the range around it, low to high, over which it is at most a tenth worse: how flat it is."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Law:
    """A fitted law of total time in s.

    linear: a x + b; inverse: a / x; product: a y / x
    names : of x and, for a product, y; coefficients : (P,), margins : (P,) half width of their confidence intervals
    covariance : (P, P); freedom : degrees of freedom; level : of margins and bands, 0..1
    points : (N, K) where it was fitted, observed and fitted : (N,) s; r2 : of those
    scatter : (N,) s, standard deviation of the runs behind each observation, nan where there is one
    """

    kind: LawKind
    names: tuple[str, ...]
    coefficients: Floats
    margins: Floats
    covariance: Floats
    freedom: int
    level: float
    points: Floats
    observed: Floats
    fitted: Floats
    r2: float
    scatter: Floats

    @property
    def residuals(self) -> Floats:
        """(N,) relative to the law."""
        return (self.observed - self.fitted) / self.fitted

    @property
    def text(self) -> str:
        """The law with numbers, for example `T = 46.8 / skip_frames`."""
        x, y = (name.rpartition(".")[2] for name in (*self.names, "")[:2])
        a = f"{self.coefficients[0]:.4g}"
        if self.kind == "linear":
            b = self.coefficients[1]
            return f"T = {a} {x} {'-' if b < 0 else '+'} {abs(b):.4g}"
        return f"T = {a} / {x}" if self.kind == "inverse" else f"T = {a} {y} / {x}"


@dataclass(frozen=True)
class CurveResult:
    """What was found on one curve; the optimum is that of the median `efficiency`, None where no run counts.

    means, medians : by quantity over the runs that were not lost, for the efficiencies a lost run counts as 0; means say how
        sure a number is, medians what is best, because the mean efficiency is that of the luckiest seed
    stage_means : ms per scan by stage, likewise of runs that were not lost
    law : None where there is none, and `no_law` says why
    """

    curve: Curve
    means: dict[str, Interval]
    medians: dict[str, Floats]
    stage_means: dict[str, Interval]
    divergence: Divergence
    optimum: Optimum | None
    law: Law | None
    no_law: str = ""


@dataclass(frozen=True)
class FindingVerdict:
    """Whether a finding holds here, in one sentence with its numbers."""

    text: str
    outcome: Outcome
    measured: str
    source: str = ""

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self.outcome}: {self.text.rstrip('.')}; here {self.measured}"


@dataclass(frozen=True)
class StudyResult:
    """A study on one sequence.

    parameters : one or two studied keys, the first is the abscissa
    products : laws of both parameters by series, of a two-way study
    beside : runs at their own values, our defaults; failed : rows without a usable result
    metric : the error that is judged; lost_above : m, the error above which a run counts as lost
    """

    study: str
    sequence: str
    parameters: tuple[str, ...]
    results: tuple[CurveResult, ...]
    products: dict[str, Law]
    verdicts: tuple[FindingVerdict, ...]
    beside: tuple[StudyRow, ...]
    failed: tuple[StudyRow, ...]
    lost_above: float
    metric: str = "ate_se3"
