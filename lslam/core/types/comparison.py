"""A table of texts, and a comparison of methods: plain values that reports, files and the page are written from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from lslam.core.arrays import Floats


@dataclass(frozen=True)
class Table:
    """Rows of texts under a header; the first column is the name. `recipe` says how the numbers came about."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    recipe: str


Group = Literal["error", "time", "health"]
USABLE = ("done", "degraded")


@dataclass(frozen=True)
class Metric:
    """One number per run.

    key : in `RunScore.values`, for example `ate.se3`; label, unit : for people; recipe : how it is made
    best : whether the lowest or the highest value is the good one, empty where neither is
    is_main : stands in the table; the others are for programs (CSV, JSON)
    """

    key: str
    label: str
    unit: str
    group: Group
    recipe: str = ""
    best: Literal["low", "high", ""] = "low"
    is_main: bool = True


@dataclass(frozen=True)
class RunScore:
    """One run of the grid.

    status : the manifest's word `done`, `degraded` or `diverged`; `failed` for an error; `crashed` for a process that died
    reason : why it is not done; values : by `Metric.key`, absent where unknown
    stages : mean seconds per scan of each stage, in order
    limit : seconds one scan may take, or None; note : why there are no errors, for example `no ground truth`
    jobs : runs of the study that shared the machine, 1 when it ran alone; load : of the machine before the study
    is_timed_alone : had the machine to itself, so that its times can be compared
    machine : versions of Python and libraries
    """

    sequence: str
    method: str
    seed: int
    folder: Path
    status: str
    reason: str = ""
    values: dict[str, float] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    limit: float | None = None
    note: str = ""
    jobs: int = 1
    load: float = 0.0
    is_timed_alone: bool = True
    is_reused: bool = False
    machine: dict[str, Any] = field(default_factory=dict)

    @property
    def is_usable(self) -> bool:
        """Whether its numbers count: a diverged run has numbers that mean nothing."""
        return self.status in USABLE


@dataclass(frozen=True)
class SeedStatistics:
    """Mean over seeds, sample standard deviation (ddof 1; nan for one run), and the number of runs."""

    mean: float
    std: float
    n: int


@dataclass(frozen=True)
class SummaryRow:
    """One method on one sequence over its seeds; `failed` of `runs` do not count in `values`, `degraded` ones do."""

    sequence: str
    method: str
    runs: int
    failed: int
    values: dict[str, SeedStatistics]
    note: str
    is_timed_alone: bool
    degraded: int = 0


@dataclass(frozen=True)
class PairedComparison:
    """A method against the reference over n pairs of one sequence and seed.

    ratio : geometric mean of its ATE over the reference's, of pairs in which both are usable; nan without any
    wins, losses : smaller or larger by more than the tie; a run that failed where the other did not is a loss
    p : two-sided Wilcoxon signed-rank of the log ratios, nan when there are too few, and `note` says so
    """

    method: str
    reference: str
    n: int
    ratio: float
    wins: int
    ties: int
    losses: int
    p: float
    note: str = ""


@dataclass(frozen=True)
class Difference:
    """Distance between the trajectories of a method and of the reference, m rmse: all there is without ground truth."""

    sequence: str
    method: str
    reference: str
    seed: int
    origin: float
    se3: float


@dataclass(frozen=True)
class DrawnRun:
    """One run as the page draws it, in the world of its drawing.

    positions : (N, 3) m; distance, errors : (M,) m along the ground truth and from it, or the drawing's reference; else None
    T_drawing_world : (4, 4) from the run's world; map_file : its merged map, or None
    """

    method: str
    positions: Floats
    distance: Floats | None
    errors: Floats | None
    T_drawing_world: Floats
    map_file: Path | None


@dataclass(frozen=True)
class Drawing:
    """The runs of one sequence and seed in one world: the ground truth's, or that of the LiDAR at the first scan.

    gt_positions : (N, 3) m or None; recipe : how the runs were brought there
    reference : without ground truth the method that `distance` and `errors` of the others are along and from, else empty
    """

    sequence: str
    seed: int
    gt_positions: Floats | None
    runs: tuple[DrawnRun, ...]
    recipe: str
    reference: str = ""


@dataclass(frozen=True)
class Comparison:
    """All of it; the first of `methods` is the reference of `differences` and of `pairs`.

    pairs : also each method with the IMU against itself without, when both were asked for
    configs : the resolved configuration of each method; tie : m
    beside : tables of what a thesis prints, beside these runs
    """

    command: str
    methods: tuple[str, ...]
    sequences: tuple[str, ...]
    metrics: tuple[Metric, ...]
    runs: tuple[RunScore, ...]
    rows: tuple[SummaryRow, ...]
    pairs: tuple[PairedComparison, ...]
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]
    configs: dict[str, dict[str, Any]]
    tie: float
    beside: tuple[Table, ...] = ()

    @property
    def degraded(self) -> tuple[RunScore, ...]:
        """The runs that count and doubt a part of themselves."""
        return tuple(run for run in self.runs if run.status == "degraded")

    @property
    def failed(self) -> tuple[RunScore, ...]:
        """Runs without a usable result."""
        return tuple(run for run in self.runs if not run.is_usable)

    @property
    def is_timing_comparable(self) -> bool:
        """Whether every run had the machine to itself."""
        return all(run.jobs == 1 for run in self.runs if run.is_usable)
