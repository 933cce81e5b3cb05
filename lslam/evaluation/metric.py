"""Trajectory metrics: how they are measured, written, shown and compared; and their results with recipes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.config.outputs import EvalConfig
from lslam.core.printable import significant
from lslam.core.types.comparison import Metric, Table
from lslam.evaluation import ALIGNMENTS

Document = dict[str, Any]
Score = TypeVar("Score")
# A path this short, m, is the rounding of poses that do not move.
STANDS_M = 1e-3
UNITS = {"scan": "scans", "m": "m", "s": "s"}


@dataclass(frozen=True)
class Statistics:
    """Seven numbers and the count, in the unit of the errors (`sse` in its square). `std` divides by n (ddof 0)."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float
    n: int


def describe(errors: NDArray[Any]) -> Statistics | None:
    """Statistics of errors (N,), None when there are none."""
    e = np.asarray(errors, np.float64)
    if len(e) == 0:
        return None
    squares = np.power(e, 2)
    return Statistics(
        rmse=float(np.sqrt(np.mean(squares))),
        mean=float(np.mean(e)),
        median=float(np.median(e)),
        std=float(np.std(e)),
        min=float(np.min(e)),
        max=float(np.max(e)),
        sse=float(np.sum(squares)),
        n=len(e),
    )


def percent_of_length(rmse: float, truth: Floats) -> float:
    """An error, m, in % of the path of the poses `truth` (N, 4, 4); NaN for a sensor that stood still."""
    length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return 100 * rmse / length if length > STANDS_M else float("nan")


@dataclass(frozen=True)
class AbsoluteError:
    """ATE under one alignment: q_i - S p_i over the N matched poses.

    translation, horizontal, vertical : m; rotation_deg : |log(inv(R_est) R_gt)|; percent_of_length : rmse in % of the
        ground truth's path length; nan when the path has none
    T_gt_est, scale : the alignment, q ~ scale * R p + t
    errors : (N, 3) estimate minus ground truth in the ground truth's world axes, m; aligned_positions : (N, 3) m
    available : False when the alignment is not determined; `note` then says why, and the statistics are None
    """

    alignment: str
    available: bool
    note: str
    translation: Statistics | None
    rotation_deg: Statistics | None
    horizontal: Statistics | None
    vertical: Statistics | None
    percent_of_length: float
    T_gt_est: Floats
    scale: float
    errors: Floats
    rotation_errors_deg: Floats
    aligned_positions: Floats

    @property
    def recipe(self) -> str:
        """Alignment and number of poses, for people."""
        return f"alignment {self.alignment}: {ALIGNMENTS[self.alignment]}; {len(self.errors)} poses"


@dataclass(frozen=True)
class RelativeError:
    """RPE at one distance: E = inv(inv(Q_i) Q_j) (inv(P_i) P_j) over pairs (i, j).

    translation : |E_t|, m; rotation_deg : |log E_R|; both None when no pair exists, and `note` says so
    pair_ends : (n_pairs,) index j of each pair among the matched poses; translation_errors, rotation_errors_deg : (n_pairs,)
    """

    delta: float
    unit: str
    pairs: str
    n_pairs: int
    translation: Statistics | None
    rotation_deg: Statistics | None
    note: str
    rule: str = ""
    pair_ends: Longs = field(default_factory=lambda: np.zeros(0, np.int64))
    translation_errors: Floats = field(default_factory=lambda: np.zeros(0))
    rotation_errors_deg: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def name(self) -> str:
        """For example `10 m, all pairs`."""
        unit = "scan" if self.unit == "scan" and self.delta == 1 else UNITS[self.unit]
        return f"{self.delta:g} {unit}, {self.pairs} pairs"

    @property
    def recipe(self) -> str:
        """Distance, pair rule and number of pairs, for people."""
        return f"{self.name}: {self.rule}; {self.n_pairs} pairs; no alignment"


@dataclass(frozen=True)
class Evaluation:
    """One estimate against one ground truth.

    matched, possible : pairs found, pairs at most; stamps_ns : (N,) of the matched poses, on the ground truth's clock
    distance : (N,) m travelled along the ground truth; gt_positions : (N, 3) m; path_length : m
    scores : by key of the metric (`evaluation.evaluate`), each with its recipe; words : words of `eval.metrics`
    time_offset : s added to the estimate's stamps; association : recipe sentence; notes : decisions and warnings
    faults : those of the notes that say what makes the numbers wrong
    odometry : the evaluation before the pose graph, for a run with one
    """

    estimate: str
    ground_truth: str
    matched: int
    possible: int
    stamps_ns: Longs
    distance: Floats
    gt_positions: Floats
    path_length: float
    scores: dict[str, Any]
    time_offset: float
    association: str
    notes: list[str]
    faults: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    odometry: Evaluation | None = None

    @property
    def ate(self) -> dict[str, AbsoluteError]:
        """Absolute errors by alignment."""
        errors: dict[str, AbsoluteError] = self.scores["ate"]
        return errors

    @property
    def rpe(self) -> list[RelativeError]:
        """Relative errors by distance."""
        errors: list[RelativeError] = self.scores["rpe"]
        return errors


@dataclass(frozen=True)
class MatchedPoses:
    """Poses in one body frame: estimate, truth (N, 4, 4); seconds (N,), None when nothing is known about time.

    has_rotations : False when one of both has positions alone: what needs a rotation is not available then
    """

    estimate: Floats
    truth: Floats
    seconds: Floats | None
    has_rotations: bool = True


@dataclass(frozen=True)
class MetricRow:
    """Row of the table of `lslam eval`: one cell per estimate. A row with `under` belongs to the number of that name."""

    label: str
    unit: str
    cells: list[str]
    under: str = ""


class TrajectoryMetric(ABC, Generic[Score]):
    """Interface of a score of matched poses.

    A metric is a subclass in a module of its own and an entry of `evaluation.evaluate.METRICS`. `measure` makes its score: a
    frozen dataclass with a `recipe`. From `columns` follows all that is shown; a metric with a form of its own overrides
    the methods.

    key : of the score in `Evaluation.scores` and evaluation.json; name : for people
    word : in `eval.metrics`, which shows it; empty: it is always shown
    columns : fields of the score that are numbers, and how each is called and in which unit
    gate_option : option of `lslam eval` that limits `gate_value`, without its dashes
    """

    key: str
    name: str
    word = ""
    columns: tuple[tuple[str, Metric], ...] = ()
    gate_option = ""

    @abstractmethod
    def measure(self, poses: MatchedPoses, config: EvalConfig) -> Score:
        """The score of matched poses."""

    def of(self, evaluation: Evaluation) -> Score:
        """The score of this metric in an evaluation."""
        score: Score = evaluation.scores[self.key]
        return score

    def document(self, score: Score) -> Any:
        """The score as plain values for evaluation.json, without its arrays."""
        values = asdict(score)  # type: ignore[call-overload]
        return {name: value for name, value in values.items() if not isinstance(value, np.ndarray)}

    def summary(self, e: Evaluation) -> list[tuple[str, str]]:
        """Names and values for the summary of a run."""
        return [(self.name, ", ".join(f"{value} {m.unit}" for m, value in self._texts(e)))]

    def rows(self, es: Sequence[Evaluation]) -> list[MetricRow]:
        """Rows for the table of `lslam eval`."""
        rows = []
        for k, metric in enumerate(metric for _, metric in self.columns):
            cells = [self._texts(e)[k][1] for e in es]
            rows.append(
                MetricRow(metric.label, metric.unit, cells, self.name)
                if k
                else MetricRow(self.name, metric.unit, cells)
            )
        return rows

    def recipes(self, e: Evaluation) -> list[str]:
        """Definitions of the numbers, one sentence each."""
        return [f"{self.name}: {getattr(self.of(e), 'recipe', '')}"]

    def tables(self, e: Evaluation) -> list[Table]:
        """Tables for the report."""
        texts = self._texts(e)
        header = ("", *(f"{metric.label}, {metric.unit}" for metric, _ in texts))
        return [Table(self.name, header, ((self.name, *(value for _, value in texts)),), f"{self.recipes(e)[0]}.")]

    def cards(self, e: Evaluation) -> list[tuple[str, str, str]]:
        """Value, unit and name of headline numbers of the report."""
        return []

    def gate_value(self, e: Evaluation) -> tuple[str, float | None, str]:
        """Name, value and unit that `gate_option` limits, by default the first column; None when it is not available."""
        field, metric = self.columns[0]
        value = float(getattr(self.of(e), field))
        return self.name, None if np.isnan(value) else value, metric.unit

    def comparison_metrics(self, configs: Sequence[EvalConfig]) -> list[Metric]:
        """Numbers that comparisons and studies read."""
        return [metric for _, metric in self.columns]

    def values(self, document: Any) -> dict[str, float]:
        """Numbers by key, from the metric's part of evaluation.json; null values are left out."""
        numbers = {metric.key: document[field] for field, metric in self.columns}
        return {key: value for key, value in numbers.items() if value is not None}

    def _texts(self, e: Evaluation) -> list[tuple[Metric, str]]:
        """Numbers of the score as texts, each with its metric."""
        score = self.of(e)
        return [(metric, significant(getattr(score, field))) for field, metric in self.columns]


NO_ROTATIONS = "n/a (positions alone)"


def statistics_document(values: Statistics | None) -> Document:
    """Statistics as plain values."""
    if values is None:
        return {**dict.fromkeys(("rmse", "mean", "median", "std", "min", "max", "sse")), "n": 0}
    return asdict(values)


def two(values: object, a: str, b: str) -> str:
    """Attributes `a` and `b` of statistics as text; `n/a` for None."""
    return "n/a" if values is None else f"{significant(getattr(values, a))} / {significant(getattr(values, b))}"


def cells_of(errors: Sequence[Any], has_value: Callable[[Any], bool], pick: Callable[[Any], str]) -> list[str]:
    """Texts of errors; the note of one that is not available."""
    return [pick(error) if has_value(error) else error.note for error in errors]
