"""From run folders back to numbers: what each run left behind, as one score per run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lslam.config.eval import EvalConfig
from lslam.errors import InputError
from lslam.evaluation.metrics import METRICS
from lslam.evaluation.timing import Timing, read_timing
from lslam.studies.grid import Job
from lslam.studies.states import FINAL, State, read_state
from lslam.types.comparison import Group, Metric, RunScore
from lslam.untrusted import parse_json

COUNTS = {
    "bridged": "bridged scans of a run", "skipped": "skipped scans of a run", "degenerate": "degenerate scans of a run",
    "fallback": "scans of a run that a recovery policy or another method posed",
}  # fmt: skip
IMU = "imu_used"
NO_TRUTH = "no ground truth"


def collect_run(job: Job, is_reused: bool = False) -> RunScore:
    """The score of a job that has ended, whatever it ended with; what cannot be read is a failure with its reason."""
    state = read_state(job.state_file)
    if state is None:
        return RunScore(job.sequence, job.method, job.seed, job.folder, "crashed", "the process left no state behind")
    score = RunScore(
        job.sequence, job.method, job.seed, job.folder, state.status, state.reason, jobs=state.jobs, load=state.load,
        is_reused=is_reused,
    )  # fmt: skip
    if state.status not in FINAL:
        return score  # what lies in the folder may be an earlier run's
    try:
        return _filled(score, state)
    except (InputError, KeyError, TypeError) as error:
        return replace(score, status="failed", reason=f"its results cannot be read: {error}")


def _filled(score: RunScore, state: State) -> RunScore:
    manifest = _read_json(score.folder / "manifest.json")
    timing = read_timing(score.folder / "timing.csv")
    values = {key: float(n) for key, n in manifest["counts"].items()} | _times(timing)
    if "resumed_after_scans" not in manifest:  # otherwise they are of the last attempt only
        values["run_s"] = state.seconds
    if manifest["peak_memory_mb"] is not None:
        values["memory"] = float(manifest["peak_memory_mb"])
    if "imu" in manifest:
        values[IMU] = float(manifest["imu"]["used"])
    note = _add_errors(score.folder / "evaluation.json", manifest, values)
    return replace(
        score, values=values, stages={name: stage.mean for name, stage in timing.stages.items()}, limit=timing.period,
        note=note, machine={"lslam": manifest["lslam"], **manifest["machine"]},
    )  # fmt: skip


def _read_json(path: Path) -> dict[str, Any]:
    try:
        tree = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None
    if not isinstance(tree, dict):
        raise InputError(f"{path} holds no object")
    return tree


def _times(timing: Timing) -> dict[str, float]:
    """Milliseconds per scan; the factor is recorded time over processing time."""
    values = {"time.total": 1e3 * timing.total.median, "time.p95": 1e3 * timing.total.p95}
    values |= {"time.mean": 1e3 * timing.total.mean, "time.max": 1e3 * timing.total.max}
    for name, stage in timing.stages.items():
        values[f"time.{name}.median"], values[f"time.{name}.p95"] = 1e3 * stage.median, 1e3 * stage.p95
    if timing.period and timing.total.mean > 0:
        values["factor"] = timing.period / timing.total.mean
        values["over_limit"] = float(timing.over_limit)
    return values


def _add_errors(path: Path, manifest: dict[str, Any], values: dict[str, float]) -> str:
    """Errors of evaluation.json into `values`; the reason when there are none."""
    score = _read_json(path) if path.is_file() else {}
    for key in ("entropy", "plane_variance"):
        if score.get("map", {}).get(key) is not None:
            values[f"map.{key}"] = float(score["map"][key])
    if "ate" not in score:
        return f"not scored: {manifest['unscored']}" if "unscored" in manifest else NO_TRUTH
    for metric in METRICS:
        values |= metric.values(score[metric.key])
    values["path"] = score["path_length_m"]
    for key in [key for key, value in values.items() if value is None]:
        del values[key]
    return ""


def metrics_of(configs: Sequence[EvalConfig], runs: Sequence[RunScore]) -> list[Metric]:
    """Every number the runs may have, in the order of the table; those for programs alone come last."""
    errors = [metric for entry in METRICS for metric in entry.compared(configs)]
    stages = list(dict.fromkeys(name for run in runs for name in run.stages))
    return [
        *(metric for metric in errors if metric.is_main),
        *(Metric(f"time.{name}.median", name, "ms", "time", f"stage {name}: median over scans", "") for name in stages),
        Metric("time.total", "total", "ms", "time", "all stages of a scan: median over scans"),
        Metric("time.p95", "p95", "ms", "time", "all stages of a scan: 95th percentile over scans"),
        Metric("factor", "real time", "x", "time", "recorded time over processing time (mean)", "high"),
        *(Metric(key, key, "scans", "health", recipe, "") for key, recipe in COUNTS.items()),
        *(metric for metric in errors if not metric.is_main),
        _more("path", "m", "error"),
        _more("map.entropy", "nats", "error"),
        _more("map.plane_variance", "m2", "error"),
        *(_more(f"time.{name}.p95", "ms", "time") for name in stages),
        *(_more(key, unit, "time") for key, unit in (("time.mean", "ms"), ("time.max", "ms"), ("run_s", "s"))),
        *(_more(key, unit, "health") for key, unit in (("scans", "scans"), ("ok", "scans"), ("over_limit", "scans"))),
        _more("memory", "MB", "health"),
        _more(IMU, "0 or 1", "health"),
    ]


def _more(key: str, unit: str, group: Group) -> Metric:
    """What stands in CSV and JSON only."""
    return Metric(key, key, unit, group, is_main=False)
