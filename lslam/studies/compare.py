"""The comparison of methods in order: simulate what is a scenario, run the grid, collect, weigh, write."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lslam.errors import InterruptedRunError, LslamError, UsageError
from lslam.reports import compare_html, compare_json, compare_table
from lslam.studies.collect import IMU, collect_run, metrics_of
from lslam.studies.drawings import draw
from lslam.studies.grid import Cell, Job, expand, fitted_scene, recorded_cell
from lslam.studies.jobs import finished, pool_of, run_jobs
from lslam.studies.output import SIMULATED, lock_output, release_output
from lslam.studies.paired import TIE_M, compare_pairs, summarise
from lslam.studies.runner import StudyProgress
from lslam.studies.scenes import Scene, simulate_once
from lslam.studies.subjects import Subject, scans_needed, with_range
from lslam.studies.variants import Variant
from lslam.types.comparison import Comparison, Drawing, RunScore
from lslam.types.trajectory import Trajectory

# More than this many busy cores before the first run, and its times are somebody else's too.
BUSY = 0.5
RESULT = "compare.json"
ONE_TRUTH = "--gt belongs to one recorded sequence: a scenario has its own, and several need one each"


@dataclass(frozen=True)
class Plan:
    """What is to be compared.

    truth : replaces the ground truth of the only sequence; jobs : runs at once, with more than one times cannot be compared
    crop : (x, y, size) of the map crop, m, None to choose; overwrite : run everything anew; resume : keep finished runs, go
        on with the others
    data_root : where the IMU of a KITTI odometry sequence is looked for
    """

    subjects: tuple[Subject, ...]
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    out: Path
    jobs: int = 1
    truth: Trajectory | None = None
    crop: tuple[float, float, float] | None = None
    overwrite: bool = False
    resume: bool = False
    data_root: Path | None = None
    command: str = ""


def check_plan(plan: Plan) -> None:
    """Raise UsageError for what cannot be compared."""
    if not plan.variants:
        raise UsageError("no method is named")
    if not plan.subjects:
        raise UsageError("no sequence is named")
    if len(set(plan.seeds)) < len(plan.seeds) or not plan.seeds or min(plan.seeds) < 0:
        raise UsageError(f"--seeds {','.join(map(str, plan.seeds))}: different whole numbers from 0, for example 0,1,2")
    if plan.jobs < 1:
        raise UsageError(f"--jobs {plan.jobs}: at least one run at a time")
    if plan.truth is not None and (len(plan.subjects) > 1 or plan.subjects[0].scenario):
        raise UsageError(ONE_TRUTH)
    if plan.crop is not None and not plan.crop[2] > 0:
        raise UsageError(f"--crop: the size of {plan.crop[2]:g} m must be above 0")
    if plan.crop is not None and not all(v.config.map.write for v in plan.variants):
        raise UsageError("--crop needs maps, and map.write is off")


def compare(plan: Plan, progress: StudyProgress | None = None) -> Comparison:
    """Run every method on every sequence and seed, and write compare.csv, .tex, .json and .html into `plan.out`.

    Raises
    ------
    UsageError : methods or numbers that make no sense, before anything runs; OutputExistsError : `out` holds something and
        neither `overwrite` nor `resume` is set; OutputError; InputError : a sequence that cannot be opened
    InterruptedRunError : Ctrl-C or SIGTERM; finished runs are kept, and `resume` goes on
    """
    progress = progress or StudyProgress()
    check_plan(plan)
    lock_output(plan.out, RESULT, "comparison", plan.overwrite, plan.resume)
    if not (plan.out / RESULT).is_file():
        compare_json.write_running(plan.out / RESULT, plan.command)
    jobs: list[Job] = []
    try:
        jobs = expand(_cells(plan, progress), plan.variants, plan.seeds, plan.out, plan.command)
        kept = set() if plan.overwrite else finished(jobs)
        left = [replace(job, goes_on=plan.resume) for job in jobs if job.folder not in kept]
        run_jobs(left, pool_of(plan.jobs, len(left)), progress)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; {len(finished(jobs))} of {len(jobs) or 'all'} runs are finished in {plan.out}: the same command with "
            "--resume goes on"
        ) from None
    except LslamError:
        release_output(plan.out, RESULT)
        raise
    scores = [collect_run(job, job.folder in kept) for job in jobs]
    comparison, drawings = _weigh(plan, jobs, scores)
    compare_table.write_files(plan.out, comparison)
    compare_html.write_page(plan.out / "compare.html", comparison, drawings, plan.crop)
    compare_json.write_result(plan.out / RESULT, comparison)
    return comparison


def _cells(plan: Plan, progress: StudyProgress) -> list[Cell]:
    """Recordings as they are, scenarios simulated once per seed."""
    needs_imu = any(variant.config.imu.use for variant in plan.variants)
    # What cannot be opened, or has no IMU though one is asked for, is said before anything is simulated.
    recorded = {
        s.label: recorded_cell(
            s.label, s.path, needs_imu=needs_imu, truth=plan.truth, data_root=plan.data_root, own=s.range
        )
        for s in plan.subjects
        if s.path is not None
    }
    scenes = {s.label: _scene(plan, s) for s in plan.subjects if s.scenario is not None}
    cells = []
    for subject in plan.subjects:
        if subject.label in recorded:
            cells.append(recorded[subject.label])
            continue
        for seed in plan.seeds:
            path = simulate_once(
                scenes[subject.label], seed, plan.out / SIMULATED,
                lambda stage, total: progress.on_start(stage, total, "scans"), lambda: progress.on_step(""),
            )  # fmt: skip
            cells.append(recorded_cell(subject.label, path, seed, needs_imu=needs_imu, own=subject.range))
    return cells


def _scene(plan: Plan, subject: Subject) -> Scene:
    """What is simulated of a scenario; raises UsageError when it ends before the scans that are used."""
    assert subject.scenario is not None
    needed = scans_needed([with_range(v.config, subject.range).input for v in plan.variants])
    return fitted_scene(Scene(subject.scenario), needed, subject.range, plan.seeds)


def _notes(scores: Sequence[RunScore]) -> list[str]:
    """What the reader of the times must know."""
    notes = []
    if any(score.jobs > 1 for score in scores if score.is_usable):
        notes.append("times marked ~ are not comparable: several runs shared the machine (--jobs)")
    refused = [f"{score.sequence} {score.method}" for score in scores if score.values.get(IMU) == 0]
    if refused:
        notes.append(f"went on without the IMU, which was refused: {', '.join(refused)}; each run's report says why")
    load = max((score.load for score in scores if score.is_usable), default=0.0)
    if load > BUSY:
        cores = os.cpu_count() or 1
        notes.append(
            f"others were using the machine before the runs (load {load:.1f}, {cores} cores): times are too long"
        )
    return notes


def _weigh(plan: Plan, jobs: Sequence[Job], scores: Sequence[RunScore]) -> tuple[Comparison, list[Drawing]]:
    drawings, differences = draw(jobs, scores)
    methods = tuple(variant.name for variant in plan.variants)
    return Comparison(
        command=plan.command,
        methods=methods,
        sequences=tuple(subject.label for subject in plan.subjects),
        metrics=tuple(metrics_of([variant.config.eval for variant in plan.variants], scores)),
        runs=tuple(scores),
        rows=tuple(summarise(scores)),
        paired=tuple(compare_pairs(scores, methods, ((v.name, v.without) for v in plan.variants if v.without))),
        differences=tuple(differences),
        notes=tuple(_notes(scores)),
        configs={v.name: v.config.model_dump(mode="json") for v in plan.variants},
        tie=TIE_M,
    ), drawings
