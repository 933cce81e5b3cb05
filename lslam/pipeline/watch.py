"""How a caller follows a run, and what it gets in the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lslam.evaluation.evaluate import Evaluation
from lslam.types.run_record import RunRecord
from lslam.types.trajectory import Trajectory


@dataclass(frozen=True)
class RunOutcome:
    """What a run gives back to Python: the record the report is written from, and the score when truth is known."""

    record: RunRecord
    evaluation: Evaluation | None

    @property
    def trajectory(self) -> Trajectory:
        """T_world_lidar per scan, at its stamp."""
        return self.record.trajectory


@dataclass(frozen=True)
class Watch:
    """How a caller follows a run and ends it early.

    on_start(stage, scans), then on_step() per scan; on_end(outcome) also when the run then raises because it diverged,
    was interrupted or missed a gate
    """

    on_start: Callable[[str, int], None] = lambda stage, total: None
    on_step: Callable[[], None] = lambda: None
    on_end: Callable[[RunOutcome], None] = lambda outcome: None
    should_stop: Callable[[], bool] = lambda: False
