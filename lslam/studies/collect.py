"""From run folders back to numbers: what each run left behind, as one score per run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lslam.errors import InputError
from lslam.evaluation.results import ALIGNMENTS
from lslam.evaluation.timing import Timing, read_timing
from lslam.studies.grid import Job
from lslam.studies.states import FINAL, State, read_state
from lslam.types.comparison import Metric, RunScore
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
    for name, error in score["ate"].items():
        if error["available"]:
            values[f"ate.{name}"] = error["rmse"]
            values[f"ate.{name}.max"] = error["max"]
            values[f"ate.{name}.rotation"] = error["rotation_deg"]["rmse"]
    for error in score["rpe"]:
        if error["n_pairs"]:
            key = rpe_key(error["delta"], error["unit"], error["pairs"])
            values[key], values[f"{key}.rotation"] = error["translation"]["rmse"], error["rotation_deg"]["rmse"]
    drift = score["kitti_drift"]
    if drift["available"]:
        values["drift"], values["drift.rotation"] = drift["translation_percent"], drift["rotation_deg_per_100m"]
    values["thesis_rmse"] = score["thesis1"]["thesis_rmse"]
    values["thesis_angular"] = score["thesis1"]["angular_rmse_deg"]
    values["path"] = score["path_length_m"]
    for key in [key for key, value in values.items() if value is None]:
        del values[key]
    return ""


def metrics_of(
    alignments: Sequence[str], deltas: Sequence[tuple[float, str, str]], runs: Sequence[RunScore]
) -> list[Metric]:
    """Every number the runs may have, in the order of the table; deltas as (distance, unit, pair rule)."""
    metrics = []
    for name in alignments:
        recipe = f"alignment {name}: {ALIGNMENTS[name]}; rmse over poses"
        metrics.append(Metric(f"ate.{name}", f"ATE {name}", "m", "error", recipe))
    metrics.append(Metric("drift", "drift", "%", "error", "KITTI: 100 to 800 m of ground truth, mean over segments"))
    for delta, unit, pairs in deltas:
        recipe = f"{delta:g} {unit}, {pairs} pairs, no alignment; rmse of the translation"
        metrics.append(Metric(rpe_key(delta, unit, pairs), f"RPE {delta:g} {unit}", "m", "error", recipe))
    stages = list(dict.fromkeys(name for run in runs for name in run.stages))
    metrics += [
        Metric(f"time.{name}.median", name, "ms", "time", f"stage {name}: median over scans", "") for name in stages
    ]
    metrics += [
        Metric("time.total", "total", "ms", "time", "all stages of a scan: median over scans"),
        Metric("time.p95", "p95", "ms", "time", "all stages of a scan: 95th percentile over scans"),
        Metric("factor", "real time", "x", "time", "recorded time over processing time (mean)", "high"),
    ]
    metrics += [Metric(key, key, "scans", "health", recipe, "") for key, recipe in COUNTS.items()]
    return metrics + _for_programs(alignments, deltas, stages)


def rpe_key(delta: float, unit: str, pairs: str) -> str:
    """Key of an RPE among a run's values.

    >>> rpe_key(10.0, "m", "all")
    'rpe.10m.all'
    """
    return f"rpe.{delta:g}{unit}.{pairs}"


def _for_programs(
    alignments: Sequence[str], deltas: Sequence[tuple[float, str, str]], stages: Sequence[str]
) -> list[Metric]:
    """What stands in CSV and JSON only."""

    def more(key: str, unit: str, group: Any = "error") -> Metric:
        return Metric(key, key, unit, group, is_main=False)

    metrics = [
        more(f"ate.{name}.{what}", unit) for name in alignments for what, unit in (("max", "m"), ("rotation", "deg"))
    ]
    metrics += [more(f"{rpe_key(*delta)}.rotation", "deg") for delta in deltas]
    metrics += [more("drift.rotation", "deg/100m"), more("thesis_rmse", "m"), more("thesis_angular", "deg")]
    metrics += [more("path", "m")]
    metrics += [more("map.entropy", "nats"), more("map.plane_variance", "m2")]
    metrics += [more(f"time.{name}.p95", "ms", "time") for name in stages]
    metrics += [more(key, unit, "time") for key, unit in (("time.mean", "ms"), ("time.max", "ms"), ("run_s", "s"))]
    counts = (("scans", "scans"), ("ok", "scans"), ("over_limit", "scans"), ("memory", "MB"), (IMU, "0 or 1"))
    return metrics + [more(key, unit, "health") for key, unit in counts]
