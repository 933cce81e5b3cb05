"""Progress callbacks of a run, and its result for the caller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.stopping import Stop
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import RunRecord
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import Evaluation
from lslam.pipeline.stored_map import map_of
from lslam.reports.figures import ON_THE_MAP, PlottedRun, draw_figure
from lslam.reports.picture import WIDTH, as_html, draw_svg
from lslam.reports.plots import first_available
from lslam.reports.text import summary

# Stages before the first scan: what is asked to stop there need not wait for the end of anything.
BEFORE_SCANS = ("preparing", "kernels")


@dataclass(frozen=True)
class RunOutcome:
    """Result of `run`: the record behind the report, and the score when truth is known."""

    record: RunRecord
    evaluation: Evaluation | None

    @property
    def trajectory(self) -> Trajectory:
        """T_world_lidar per scan, at its stamp."""
        return self.record.trajectory

    @property
    def map(self) -> ArrayCloud | None:
        """The merged map in the run's world, read from its folder; None where none was written."""
        if self.record.folder is None or not self.record.map_file:
            return None
        return map_of(self.record.folder / self.record.map_file).read()

    @property
    def errors(self) -> Floats | None:
        """(N,) m, position errors of the matched poses, aligned as the report draws them; None without ground truth."""
        absolute = first_available(self.evaluation)
        return None if absolute is None else np.linalg.norm(absolute.errors, axis=1)

    def plot(self, what: str = "trajectory") -> Any:
        """matplotlib figure of `lslam plot`: trajectory, map, errors, features, imu or buildings.

        Raises UsageError for another name, InputError for what the run does not have.
        """
        return draw_figure(self._figure_data(self.map if what in ON_THE_MAP else None), what)

    def _figure_data(self, cloud: ArrayCloud | None = None) -> PlottedRun:
        """The parts of the record that figures are drawn from; `cloud` is the map, if it was read."""
        record = self.record
        return PlottedRun(
            record.name,
            record.trajectory,
            None if record.odometry is record.trajectory else record.odometry,
            self.evaluation,
            cloud,
            record.imu,
            record.features,
            record.buildings,
            record.georeference,
        )

    def _repr_html_(self) -> str:
        """Summary and trajectory, for notebooks."""
        return as_html(
            summary(self.record, self.evaluation),
            draw_svg(lambda: draw_figure(self._figure_data(), "trajectory", WIDTH)),
        )


@dataclass(frozen=True)
class Watch:
    """Progress callbacks of a run, and a way to stop it early.

    on_start(stage, scans, 0 for a stage without any), then on_step() per scan; on_end(outcome) also when the run then raises
    because it diverged, was interrupted or missed a gate
    """

    on_start: Callable[[str, int], None] = lambda stage, total: None
    on_step: Callable[[], None] = lambda: None
    on_end: Callable[[RunOutcome], None] = lambda outcome: None
    should_stop: Callable[[], bool] = lambda: False


SILENT = Watch()


def watch_run(
    stop: Stop,
    on_start: Callable[[str, int], None] = lambda stage, total: None,
    on_step: Callable[[], None] = lambda: None,
    on_end: Callable[[RunOutcome], None] = lambda outcome: None,
) -> Watch:
    """Watch of a run that a signal ends at once before the first stage of scans, and after the scan in work from there on."""

    def begin(stage: str, total: int) -> None:
        on_start(stage, total)
        stop.is_gentle = stage not in BEFORE_SCANS

    return Watch(begin, on_step, on_end, stop)
