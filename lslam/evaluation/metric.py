"""What a trajectory metric is: how it is measured, written to evaluation.json, shown, and compared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from lslam.core.config.outputs import EvalConfig
from lslam.core.printable import significant
from lslam.core.types.arrays import Floats
from lslam.core.types.comparison import Metric, Table
from lslam.evaluation.results import Evaluation, Statistics

Document = dict[str, Any]
Score = TypeVar("Score")


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
    """A row of the table of `lslam eval`: one cell per estimate. Rows with `under` belong to the number of that name."""

    label: str
    unit: str
    cells: list[str]
    under: str = ""


class TrajectoryMetric(ABC, Generic[Score]):
    """One way to score matched poses.

    A metric is a subclass in a module of its own and an entry of `evaluation.evaluate.METRICS`. `measure` makes its score: a
    frozen dataclass with a `recipe`. From `columns` follows all that is shown; a metric with a form of its own overrides
    the methods.

    key : of the score in `Evaluation.scores` and evaluation.json; name : for people
    word : in `eval.metrics`, which shows it; empty: it is always shown
    columns : fields of the score that are numbers, and how each is called and in which unit
    gate_option : option of `lslam eval` that limits `gated`, without its dashes
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
        """Its score in an evaluation."""
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
            rows.append(MetricRow(metric.label, metric.unit, cells, self.name) if k else
                        MetricRow(self.name, metric.unit, cells))  # fmt: skip
        return rows

    def recipes(self, e: Evaluation) -> list[str]:
        """How the numbers are made, one sentence each."""
        return [f"{self.name}: {getattr(self.of(e), 'recipe', '')}"]

    def tables(self, e: Evaluation) -> list[Table]:
        """Tables for the report."""
        texts = self._texts(e)
        header = ("", *(f"{metric.label}, {metric.unit}" for metric, _ in texts))
        return [Table(self.name, header, ((self.name, *(value for _, value in texts)),), f"{self.recipes(e)[0]}.")]

    def cards(self, e: Evaluation) -> list[tuple[str, str, str]]:
        """Value, unit and name of headline numbers of the report."""
        return []

    def gated(self, e: Evaluation) -> tuple[str, float | None, str]:
        """Name, value and unit of what `gate_option` limits: the first column unless said; None when it is not available."""
        field, metric = self.columns[0]
        value = float(getattr(self.of(e), field))
        return self.name, None if np.isnan(value) else value, metric.unit

    def compared(self, configs: Sequence[EvalConfig]) -> list[Metric]:
        """The numbers that comparisons and studies read."""
        return [metric for _, metric in self.columns]

    def values(self, document: Any) -> dict[str, float]:
        """Those numbers by key, from the metric's part of evaluation.json; what is null is left out."""
        found = {metric.key: document[field] for field, metric in self.columns}
        return {key: value for key, value in found.items() if value is not None}

    def _texts(self, e: Evaluation) -> list[tuple[Metric, str]]:
        score = self.of(e)
        return [(metric, significant(getattr(score, field))) for field, metric in self.columns]


NO_ROTATIONS = "n/a (positions alone)"


def statistics_document(values: Statistics | None) -> Document:
    """Statistics as plain values."""
    if values is None:
        return {**dict.fromkeys(("rmse", "mean", "median", "std", "min", "max", "sse")), "n": 0}
    return asdict(values)


def two(values: object, a: str, b: str) -> str:
    """Two attributes of statistics, as text."""
    return "n/a" if values is None else f"{significant(getattr(values, a))} / {significant(getattr(values, b))}"


def cells_of(errors: Sequence[Any], is_known: Callable[[Any], bool], pick: Callable[[Any], str]) -> list[str]:
    """One text per error; the note of one that is not known."""
    return [pick(error) if is_known(error) else error.note for error in errors]
