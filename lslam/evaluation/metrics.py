"""The table of trajectory metrics; its order is that of evaluation.json and of all that is shown."""

from __future__ import annotations

from typing import Any

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


def shown_metrics(evaluation: Evaluation) -> list[TrajectoryMetric[Any]]:
    """Those that are always shown, and those of the words of `eval.metrics`."""
    return [metric for metric in METRICS if not metric.word or metric.word in evaluation.shown]
