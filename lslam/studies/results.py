"""The rows of a study on their way to results.csv and results.parquet."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from math import nan
from pathlib import Path

from lslam.formats.study_files import read_study_csv, write_study_csv, write_study_parquet
from lslam.remote import RemotePath
from lslam.studies.collect import collect_run
from lslam.studies.grid import Job
from lslam.studies.states import State, read_state
from lslam.studies.variants import Variant
from lslam.types.study import StudyRow

RESULTS = "results.csv"
PARQUET = "results.parquet"
# Data stay read from one run to the next, so reading is no part of a run's time.
_NOT_TIMED = ("read",)
# A run that waited longer for its core was held up by somebody.
_MOST_WAITED = 0.05
# A table of so many rows takes its time to write, and no more than one part in so many of all time.
_MANY, _PARTS = 1000, 10


class Results:
    """Rows of finished runs in the order of the study; the files are whole at any moment.

    Those of thousands of runs may be some seconds behind, until `flush`.
    """

    def __init__(
        self, study: str, out: Path, jobs: Sequence[Job], variants: dict[str, Variant], metric: str = "ate_se3"
    ) -> None:
        self.study, self.out, self.variants, self.metric = study, out, variants, metric
        self._order = {job.folder: k for k, job in enumerate(jobs)}
        self._rows: dict[int, StudyRow] = {}
        self._next_s, self._is_behind = 0.0, False

    @property
    def rows(self) -> list[StudyRow]:
        """Of all runs that have ended."""
        return [self._rows[k] for k in sorted(self._rows)]

    def check(self) -> None:
        """Raise InputError when the files are there and another version of lslam wrote them."""
        if (self.out / RESULTS).is_file():
            read_study_csv(self.out / RESULTS)

    def add(self, jobs: Sequence[Job]) -> None:
        """Take up the runs of jobs that have ended and write the files; raises OutputError."""
        for job in jobs:
            self._rows[self._order[job.folder]] = self._row(job)
        self._is_behind = True
        if time.monotonic() >= self._next_s:
            self.flush()

    def flush(self) -> None:
        """Write what the files are behind; raises OutputError."""
        if not self._is_behind:
            return
        began = time.monotonic()
        write_study_csv(self.out / RESULTS, self.rows)
        write_study_parquet(self.out / PARQUET, self.rows)
        self._is_behind, ended = False, time.monotonic()
        self._next_s = ended + (_PARTS * (ended - began) if len(self._rows) >= _MANY else 0.0)

    def _row(self, job: Job) -> StudyRow:
        score, variant = collect_run(job), self.variants[job.method]
        state = read_state(job.state_file) or State(job.digest, score.status)
        values, scans = score.values, int(score.values.get("scans", 0))
        stages_ms = {name: 1e3 * seconds for name, seconds in score.stages.items() if name not in _NOT_TIMED}
        return StudyRow(
            run=f"{job.sequence}/{job.folder.name}",
            study=self.study,
            sequence=job.sequence,
            seed=job.seed,
            method=variant.method,
            uses_imu=variant.uses_imu,
            parameters=variant.parameters,
            is_beside=variant.is_beside,
            status=score.status,
            reason=score.reason or score.note,
            thesis_rmse=values.get("thesis_rmse", nan),
            ate_se3=values.get("ate.se3", nan),
            ate_origin=values.get("ate.origin", nan),
            angular_rmse_deg=values.get("thesis_angular", nan),
            scans=scans,
            stages_ms=stages_ms,
            total_time_s=sum(stages_ms.values()) * scans / 1e3 if stages_ms else nan,
            run_s=values.get("run_s", nan),
            bridged_share=values["bridged"] / scans if scans else nan,
            fallback_share=values.get("fallback", nan) / scans if scans else nan,
            is_timing_comparable=is_comparable(state),
            at_once=state.jobs,
            digest=job.digest,
            machine=state.machine,
            folder=_seen_from(self.out, job.folder),
            metric=self.metric,
        )


def _seen_from(out: Path, folder: Path) -> str:
    """The folder of a run as a reader of the table finds it: relative where both are of one storage or this machine's."""
    if isinstance(folder, RemotePath) or isinstance(out, RemotePath):
        return folder.relative_to(out).as_posix() if folder.is_relative_to(out) else str(folder.absolute())
    return Path(os.path.relpath(folder, out)).as_posix()


def is_comparable(state: State) -> bool:
    """Whether the times of a run are its own: a core to itself, which nobody else took away."""
    return state.is_alone and state.waited <= _MOST_WAITED
