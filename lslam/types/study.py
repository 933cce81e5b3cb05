"""The rows of a sensitivity study: one per run, failures included."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

from lslam.types.comparison import USABLE

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
    def is_diverged(self) -> bool:
        """Whether the method lost the motion; a run that failed otherwise says nothing about its parameters."""
        return self.status == "diverged"

    @property
    def time_per_scan_ms(self) -> float:
        """Of all stages, mean; nan without any."""
        return sum(self.stages_ms.values()) if self.stages_ms else nan


def series_of(method: str, uses_imu: bool) -> str:
    """A method as people read it.

    >>> series_of("icp", uses_imu=True)
    'icp+imu'
    """
    return f"{method}+imu" if uses_imu else method
