"""The table of trajectory metrics; its order is that of evaluation.json and of all that is shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lslam.errors import UsageError, nearest
from lslam.evaluation.absolute import AbsoluteTrajectoryError
from lslam.evaluation.kitti_drift import KittiOdometry
from lslam.evaluation.metric import TrajectoryMetric
from lslam.evaluation.relative import RelativePoseError
from lslam.evaluation.results import Evaluation
from lslam.evaluation.thesis import DelTufo, Girolimetto

METRICS: tuple[TrajectoryMetric[Any], ...] = (
    AbsoluteTrajectoryError(),
    RelativePoseError(),
    KittiOdometry(),
    Girolimetto(),
    DelTufo(),
)


def check_words(words: Sequence[str]) -> None:
    """Raise UsageError for a word of `eval.metrics` that shows no metric."""
    known = dict.fromkeys(metric.word for metric in METRICS if metric.word)
    for word in words:
        if word not in known:
            raise UsageError(f"no metrics {word!r}; {nearest(word, known)}")


def shown_metrics(evaluation: Evaluation) -> list[TrajectoryMetric[Any]]:
    """Those that are always shown, and those of the words of `eval.metrics`."""
    return [metric for metric in METRICS if not metric.word or metric.word in evaluation.shown]
