"""Rows of a study, collected from its runs for results.csv and results.parquet."""

from __future__ import annotations

import csv
import logging
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from math import nan
from pathlib import Path
from typing import Any

from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import InputError, input_errors
from lslam.core.extras import install_command
from lslam.core.types.comparison import Group, Metric, RunScore
from lslam.core.types.study import StudyRow
from lslam.core.untrusted import parse_json
from lslam.evaluation.evaluate import METRICS
from lslam.evaluation.timing import Timing, read_timing
from lslam.io.remote import RemotePath
from lslam.reports.compare_table import HEALTH
from lslam.studies.grid import Job
from lslam.studies.results_csv import FINAL, State, read_state, read_study_csv, write_study_csv, write_study_parquet
from lslam.studies.variants import Variant

log = logging.getLogger("lslam")

COUNTS = {
    "bridged": "bridged scans of a run",
    "skipped": "skipped scans of a run",
    "degenerate": "degenerate scans of a run",
    "fallback": "scans of a run that a recovery policy or a fallback posed",
}
IMU = "imu_used"
# The metric that is told of a run's odometry too, before the graph moved it.
ONLY_BEFORE = next(metric for metric in METRICS if metric.key == "thesis1")
NO_TRUTH = "no ground truth"
RESULTS = "results.csv"
PARQUET = "results.parquet"
# Data stay read from one run to the next, so reading is no part of a run's time.
_WITHOUT_TIME = ("read",)
# A run that waited longer for its core was held up by somebody.
_LONGEST_WAIT = 0.05
# A table of so many rows takes its time to write, and no more than one part in so many of all time.
_MANY, _PARTS = 1000, 10


def collect_run(job: Job, is_reused: bool = False) -> RunScore:
    """Score of a job that has ended in any way; unreadable results give a failure with the reason.

    is_reused : an earlier command made the run
    """
    state = read_state(job.state_file)
    if state is None:
        return RunScore(job.sequence, job.method, job.seed, job.folder, "crashed", "the process left no state behind")
    score = RunScore(
        job.sequence,
        job.method,
        job.seed,
        job.folder,
        state.status,
        state.reason,
        jobs=state.jobs,
        load=state.load,
        is_reused=is_reused,
        is_timed_alone=state.jobs == 1 and is_comparable(state),
    )
    if state.status not in FINAL:
        return score  # what lies in the folder may be an earlier run's
    try:
        return _with_values(score, state)
    except (InputError, KeyError, TypeError) as error:
        return replace(score, status="failed", reason=f"its results cannot be read: {error}")


def _with_values(score: RunScore, state: State) -> RunScore:
    """Score of a usable run with its numbers, times and machine."""
    manifest = _read_json(score.folder / "manifest.json")
    timing = read_timing(score.folder / "timing.csv")
    values = {key: float(n) for key, n in manifest["counts"].items()} | _times(timing)
    values |= _means_of_scans(score.folder / "scans.csv")
    if "resumed_after_scans" not in manifest:  # otherwise they are of the last attempt only
        values["run_s"] = state.seconds
    if manifest["peak_memory_mb"] is not None:
        values["memory"] = float(manifest["peak_memory_mb"])
    if "imu" in manifest:
        values[IMU] = float(manifest["imu"]["used"])
    note = _add_errors(score.folder / "evaluation.json", manifest, values)
    return replace(
        score,
        values=values,
        stages={name: stage.mean for name, stage in timing.stages.items()},
        limit=timing.period,
        note=note,
        machine={"lslam": manifest["lslam"], **manifest["machine"]},
    )


def _read_json(path: Path) -> dict[str, Any]:
    """Object in a JSON file; raises InputError when it is unreadable or no object."""
    try:
        tree = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None
    if not isinstance(tree, dict):
        raise InputError(f"{path} holds no object")
    return tree


def _times(timing: Timing) -> dict[str, float]:
    """Times per scan, ms, by the names of results.csv; if a period is known, also the real-time factor and `over_limit`.

    The factor is recorded time over processing time.
    """
    values = {"time.total": 1e3 * timing.total.median, "time.p95": 1e3 * timing.total.p95}
    values |= {"time.mean": 1e3 * timing.total.mean, "time.max": 1e3 * timing.total.max}
    for name, stage in timing.stages.items():
        for statistic in ("mean", "median", "p95"):
            values[f"time.{name}.{statistic}"] = 1e3 * getattr(stage, statistic)
    if timing.period and timing.total.mean > 0:
        values["factor"] = timing.period / timing.total.mean
        values["over_limit"] = float(timing.over_limit)
    return values


def _means_of_scans(path: Path) -> dict[str, float]:
    """Mean share of inliers, and mean error of the motion prior, of the scans that were registered."""
    with input_errors(f"scans {path}", csv.Error, ValueError), path.open(newline="", encoding="utf-8") as stream:
        registered = [row for row in csv.DictReader(stream) if row["status"] == "ok" and int(row["source_points"])]
        means = {
            "inlier_share": [int(row["inliers"]) / int(row["source_points"]) for row in registered],
            "prior_norm": [float(row["prior_norm"]) for row in registered],
        }
    return {key: sum(each) / len(each) for key, each in means.items() if each}


def _add_errors(path: Path, manifest: dict[str, Any], values: dict[str, float]) -> str:
    """Add the errors of evaluation.json to `values`. Returns the reason when there are none."""
    score = _read_json(path) if path.is_file() else {}
    for key in ("entropy", "plane_variance"):
        if score.get("map", {}).get(key) is not None:
            values[f"map.{key}"] = float(score["map"][key])
    if "ate" not in score:
        return f"not scored: {manifest['unscored']}" if "unscored" in manifest else NO_TRUTH
    for metric in METRICS:
        values |= metric.values(score[metric.key])
    # What no graph moved is its own odometry.
    before = ONLY_BEFORE.values((score.get("odometry") or score)[ONLY_BEFORE.key])
    values |= {f"odometry.{key}": value for key, value in before.items()}
    values["path"] = score["path_length_m"]
    for key in [key for key, value in values.items() if value is None]:
        del values[key]
    return ""


def metrics_of(configs: Sequence[EvalConfig], runs: Sequence[RunScore]) -> list[Metric]:
    """All numbers that the runs may have, in the order of the table; those for programs alone come last."""
    errors = [metric for entry in METRICS for metric in entry.comparison_metrics(configs)]
    stages = list(dict.fromkeys(name for run in runs for name in run.stages))
    return [
        *(metric for metric in errors if metric.is_main),
        # Means, as the page's bars show: those of the stages add up, their medians do not.
        *(Metric(f"time.{name}.mean", name, "ms", "time", f"stage {name}: mean over scans", "") for name in stages),
        Metric("time.mean", "mean", "ms", "time", "all stages of a scan: mean over scans"),
        Metric("time.p95", "p95", "ms", "time", "all stages of a scan: 95th percentile over scans"),
        Metric("factor", "real time", "x", "time", "recorded time over processing time (mean)", "high"),
        *(Metric(key, HEALTH[key], "scans", "health", recipe, "") for key, recipe in COUNTS.items()),
        *(metric for metric in errors if not metric.is_main),
        *(_more(f"odometry.{m.key}", m.unit, "error") for m in ONLY_BEFORE.comparison_metrics(configs)),
        _more("path", "m", "error"),
        _more("map.entropy", "nats", "error"),
        _more("map.plane_variance", "m2", "error"),
        *(_more(f"time.{name}.{statistic}", "ms", "time") for statistic in ("median", "p95") for name in stages),
        *(_more(key, unit, "time") for key, unit in (("time.total", "ms"), ("time.max", "ms"), ("run_s", "s"))),
        *(_more(key, unit, "health") for key, unit in (("scans", "scans"), ("ok", "scans"), ("over_limit", "scans"))),
        _more("memory", "MB", "health"),
        _more(IMU, "0 or 1", "health"),
        _more("inlier_share", "0 to 1", "health"),
        _more("prior_norm", "", "health"),
    ]


def _more(key: str, unit: str, group: Group) -> Metric:
    """Numbers that only CSV and JSON show."""
    return Metric(key, key, unit, group, is_main=False)


class Results:
    """Rows of finished runs in the study's order, in whole files, some seconds late for thousands, until `flush`.

    out : folder of the files; variants : of all jobs, by name; metric : key of the error of a row
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
        """Rows of all runs that have ended."""
        return [self._rows[k] for k in sorted(self._rows)]

    def check(self) -> None:
        """Raise InputError when the files exist and are of another version of lslam."""
        if (self.out / RESULTS).is_file():
            read_study_csv(self.out / RESULTS)

    def add(self, jobs: Sequence[Job]) -> None:
        """Add the runs of jobs that have ended and write the files. Raises OutputError."""
        for job in jobs:
            self._rows[self._order[job.folder]] = self._row(job)
        self._is_behind = True
        if time.monotonic() >= self._next_s:
            self.flush()

    def flush(self) -> None:
        """Write rows that are not in the files yet. Raises OutputError."""
        if not self._is_behind:
            return
        began = time.monotonic()
        write_study_csv(self.out / RESULTS, self.rows)
        if find_spec("pyarrow") is not None:
            write_study_parquet(self.out / PARQUET, self.rows)
        elif self._next_s == 0.0:
            log.info("%s is not written, it takes pyarrow: %s", PARQUET, install_command("parquet"))
        self._is_behind, ended = False, time.monotonic()
        self._next_s = ended + (_PARTS * (ended - began) if len(self._rows) >= _MANY else 0.0)

    def _row(self, job: Job) -> StudyRow:
        """Row of a job: variant, status, scores (NaN where missing) and time per stage, ms."""
        score, variant = collect_run(job), self.variants[job.method]
        state = read_state(job.state_file) or State(job.digest, score.status)
        values, scans = score.values, int(score.values.get("scans", 0))
        stages_ms = {name: 1e3 * seconds for name, seconds in score.stages.items() if name not in _WITHOUT_TIME}
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
            path=_seen_from(self.out, job.path) if job.path.is_relative_to(self.out) else str(job.path),
            metric=self.metric,
        )


def _seen_from(out: Path, folder: Path) -> str:
    """Folder of a run for a reader of the table: relative if both are on one disk or in one storage."""
    if isinstance(folder, RemotePath) or isinstance(out, RemotePath):
        return folder.relative_to(out).as_posix() if folder.is_relative_to(out) else str(folder.absolute())
    return Path(os.path.relpath(folder, out)).as_posix()


def is_comparable(state: State) -> bool:
    """Whether a run's times can be compared: it had a core to itself, without other load."""
    return state.is_alone and state.waited <= _LONGEST_WAIT
