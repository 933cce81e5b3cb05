"""A sensitivity study: its rows, one per run, failures included, and what was found on them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import nan
from typing import Literal

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.types.comparison import USABLE

Value = bool | int | float | str


@dataclass(frozen=True)
class StudyRow:
    """One run of a study.

    run : names it within the study; study : its name; seed : of the simulation, or of what the method draws
    method : of the method or preset, without its IMU; uses_imu : whether it was to use it
    parameters : what is studied, by configuration key; empty for a run beside the study, at its own values (`is_beside`)
    status : `done`, `degraded`, `diverged`, `failed` or `crashed`; reason : why it is not done
    thesis_rmse : m, origin alignment, sqrt(sum |e|^2 / 3N); ate_se3, ate_origin : m, rmse; angular_rmse_deg : equation 2.15 of
        Girolimetto; nan where there is none
    metric : which of them the study judges by
    scans : processed; stages_ms : mean ms per scan by stage, in the order they are passed; total_time_s : of all stages over
        all scans; run_s : of the whole run with its reading and writing
    bridged_share : of the scans, 0..1; fallback_share : likewise, that a recovery policy or another method posed
    is_timing_comparable : nothing else ran on the machine that the study knows of
    at_once : runs of the study that shared the machine
    digest : of the resolved configuration, the input and lslam's version; machine : name of the host
    folder : of the run, from the study's; path : of the recording, from the study's where it lies in there
    """

    run: str
    study: str
    sequence: str
    seed: int
    method: str
    uses_imu: bool = False
    parameters: dict[str, Value] = field(default_factory=dict)
    is_beside: bool = False
    status: str = "failed"
    reason: str = ""
    thesis_rmse: float = nan
    ate_se3: float = nan
    ate_origin: float = nan
    angular_rmse_deg: float = nan
    scans: int = 0
    stages_ms: dict[str, float] = field(default_factory=dict)
    total_time_s: float = nan
    run_s: float = nan
    bridged_share: float = nan
    fallback_share: float = nan
    is_timing_comparable: bool = True
    at_once: int = 1
    digest: str = ""
    machine: str = ""
    folder: str = ""
    path: str = ""
    metric: str = "ate_se3"

    @property
    def series(self) -> str:
        """The method as people read it, with its IMU."""
        return series_of(self.method, self.uses_imu)

    @property
    def error(self) -> float:
        """m, by the metric of the study; nan where there is none."""
        return float(getattr(self, self.metric))

    @property
    def is_usable(self) -> bool:
        """Whether its numbers count: a diverged run has numbers that mean nothing."""
        return self.status in USABLE

    @property
    def diverges(self) -> bool:
        """Whether the method lost the motion; a run that failed otherwise says nothing about its parameters."""
        return self.status == "diverged"

    @property
    def time_per_scan_ms(self) -> float:
        """Of all stages, mean; nan without any."""
        return sum(self.stages_ms.values()) if self.stages_ms else nan


def series_of(method: str, uses_imu: bool) -> str:
    """Label of a method in tables and plots: its name, with `+imu` if it uses the IMU.

    >>> series_of("icp", uses_imu=True)
    'icp+imu'
    """
    return f"{method}+imu" if uses_imu else method


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
    stages : ms per scan by name; losses : runs that diverged, by their status or by their error; ran : runs there are
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
    losses: Bools
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
        """Name of the series, with the value of the other parameter in a two-way study."""
        return ", ".join(
            [
                self.series,
                *(
                    f"{key.rpartition('.')[2]} {value:g}"
                    if isinstance(value, float)
                    else f"{key.rpartition('.')[2]} {value}"
                    for key, value in self.at
                ),
            ]
        )

    @property
    def with_score(self) -> Bools:
        """(V, S) runs that say whether their values work: with an error, or lost. One without ground truth does not."""
        return np.asarray(self.losses | np.isfinite(self.quantities["translation"]))

    @property
    def loses_most(self) -> Bools:
        """(V,) values at which more than half of the runs that say so were lost."""
        return np.asarray(2 * self.losses.sum(1) > self.with_score.sum(1))

    def of_seed(self, index: int) -> Curve:
        """The same curve for a single seed, by its index."""
        one = slice(index, index + 1)
        return replace(
            self,
            seeds=self.seeds[one],
            quantities={name: table[:, one] for name, table in self.quantities.items()},
            stages={name: table[:, one] for name, table in self.stages.items()},
            losses=self.losses[:, one],
            ran=self.ran[:, one],
        )

    def name_of(self, value: float) -> str:
        """Text for a value of the parameter: its word, or the number."""
        return self.words[int(value)] if self.words else f"{value:g}"


@dataclass(frozen=True)
class Interval:
    """Means over seeds (V,) with confidence interval, and std of single runs; nan where fewer than two runs count."""

    mean: Floats
    low: Floats
    high: Floats
    n: Longs
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
    points : (N, K) where it was fitted, times and law_times : (N,) s; r2 : of those
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
    times: Floats
    law_times: Floats
    r2: float
    scatter: Floats

    @property
    def residuals(self) -> Floats:
        """(N,) relative to the law."""
        return (self.times - self.law_times) / self.law_times

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
    numbers: str
    source: str = ""

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self.outcome}: {self.text.rstrip('.')}; here {self.numbers}"


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
