"""The comparison of methods in order: simulate what is a scenario, run the grid, collect, weigh, write."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import InterruptedRunError, LslamError
from lslam.core.types.arrays import Floats
from lslam.core.types.comparison import Comparison, Difference, Drawing, DrawnRun, RunScore
from lslam.core.types.sequence import Sequence as Recording
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation import ALIGNMENTS
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import AbsoluteError
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.reports import compare_html, compare_table
from lslam.studies.grid import Cell, Job, expand, fitted_scene, recorded_cell
from lslam.studies.jobs import finished, pool_of, run_jobs
from lslam.studies.output import COMPARISON, SIMULATED, lock_output, release_output
from lslam.studies.paired import TIE_M, compare_pairs, summarise
from lslam.studies.plan import Plan, check_plan
from lslam.studies.results import IMU, collect_run, metrics_of
from lslam.studies.runner import StudyProgress
from lslam.studies.subjects import Scene, Subject, scans_needed, simulate_once, with_range

log = logging.getLogger("lslam")
PREFERRED = EvalConfig(align=("se3", "origin"))
# rad; half a metre at a wall that stands 30 m beside the path.
LARGEST_TURN = 1 / 60
# More than this many busy cores before the first run, and its times are somebody else's too.
BUSY = 0.5


@dataclass(frozen=True)
class Finished:
    """A usable run with its trajectory."""

    job: Job
    trajectory: Trajectory


def draw(jobs: Sequence[Job], scores: Sequence[RunScore]) -> tuple[list[Drawing], list[Difference]]:
    """One drawing per sequence, of its first seed, and differences to the reference where there is no ground truth.

    The reference is the first method that is there; what cannot be read is left out and said.
    """
    with _only_warnings():  # what an evaluation remarks stands in the log of its run already
        return _draw(jobs, scores)


def _draw(jobs: Sequence[Job], scores: Sequence[RunScore]) -> tuple[list[Drawing], list[Difference]]:
    drawings, differences = [], []
    groups: dict[str, list[Finished]] = {}
    for job, score in zip(jobs, scores, strict=True):
        if score.is_usable:
            groups.setdefault(job.sequence, []).append(Finished(job, read_trajectory(job.folder)))
    for sequence, runs in groups.items():
        seed = runs[0].job.seed
        shown = [run for run in runs if run.job.seed == seed]
        recording = open_sequence(shown[0].job.path)
        truth = recording.ground_truth if shown[0].job.truth is None else shown[0].job.truth
        if truth is not None:
            try:
                drawings.append(_in_world_of_truth(sequence, seed, shown, recording, truth))
                continue
            except LslamError as error:
                log.warning("%s is drawn without its ground truth: %s", sequence, error)
        drawings.append(_in_own_world(sequence, seed, shown))
        differences += _differences(sequence, runs)
    return drawings, differences


@contextmanager
def _only_warnings() -> Iterator[None]:
    before = log.level
    log.setLevel(max(before, logging.WARNING))
    try:
        yield
    finally:
        log.setLevel(before)


def _in_world_of_truth(
    sequence: str, seed: int, runs: Sequence[Finished], recording: Recording, truth: Trajectory
) -> Drawing:
    scores = [evaluate(run.trajectory, truth, PREFERRED, calibration=recording.calibration) for run in runs]
    errors = [_available(list(score.ate.values())) for score in scores]
    turns = [_turn_about_path(error, score.gt_positions) for error, score in zip(errors, scores, strict=True)]
    # One alignment for all, or their errors could not be compared.
    if max(turns) > LARGEST_TURN and all(score.ate["origin"].available for score in scores):
        errors = [score.ate["origin"] for score in scores]
    drawn = tuple(
        DrawnRun(
            run.job.method,
            error.aligned_positions,
            score.distance,
            np.linalg.norm(error.errors, axis=1),
            error.T_gt_est,
            _map_file(run),
        )
        for run, score, error in zip(runs, scores, errors, strict=True)
    )
    names = {error.alignment for error in errors}
    recipe = "; ".join(f"{name}: {ALIGNMENTS[name]}" for name in sorted(names))
    return Drawing(sequence, seed, scores[-1].gt_positions, drawn, f"moved onto the ground truth, {recipe}")


def _turn_about_path(error: AbsoluteError, gt_positions: Floats) -> float:
    """What an alignment of positions leaves of the rotation about the path, rad: errors over the path's width."""
    width = np.linalg.svd(gt_positions - gt_positions.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(gt_positions))
    return np.inf if error.translation is None or width == 0 else float(error.translation.rmse / width)


def _available(errors: list[AbsoluteError]) -> AbsoluteError:
    return next((error for error in errors if error.available), errors[-1])


def _in_own_world(sequence: str, seed: int, runs: Sequence[Finished]) -> Drawing:
    """Without ground truth: every run from the start that all share, and how far it is from the first, scan by scan."""
    drawn = []
    for run in runs:
        distance, errors = (None, None) if run is runs[0] else _apart(run, runs[0])
        positions, file = run.trajectory.positions, _map_file(run)
        drawn.append(DrawnRun(run.job.method, positions, distance, errors, np.eye(4), file))
    recipe = "in the world of the LiDAR at the first scan"
    return Drawing(sequence, seed, None, tuple(drawn), recipe, runs[0].job.method)


def _apart(run: Finished, other: Finished) -> tuple[Floats | None, Floats | None]:
    """m along another run and from it at the poses that both have, from the same start; None where they share none."""
    try:
        score = evaluate(run.trajectory, other.trajectory, EvalConfig(align=("origin",)))
    except LslamError:  # `_differences` says so
        return None, None
    return score.distance, np.linalg.norm(score.ate["origin"].errors, axis=1)


def _map_file(run: Finished) -> Path | None:
    return next((path for path in sorted(run.job.folder.glob("map.*")) if path.suffix in (".ply", ".pcd")), None)


def _differences(sequence: str, runs: Sequence[Finished]) -> list[Difference]:
    """Every run against the reference's of the same seed, over the poses they share."""
    out = []
    reference = runs[0].job.method
    of_reference = {run.job.seed: run for run in runs if run.job.method == reference}
    for run in runs:
        other = of_reference.get(run.job.seed) or next(iter(of_reference.values()))
        if run.job.method == reference:
            continue
        try:
            score = evaluate(run.trajectory, other.trajectory, PREFERRED)
        except LslamError as error:
            log.warning("%s: %s and %s cannot be compared: %s", sequence, run.job.method, reference, error)
            continue
        rmse = {name: e.translation.rmse if e.translation else float("nan") for name, e in score.ate.items()}
        out.append(Difference(sequence, run.job.method, reference, run.job.seed, rmse["origin"], rmse["se3"]))
    return out


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
    lock_output(plan.out, COMPARISON, "comparison", plan.overwrite, plan.resume)
    if not (plan.out / COMPARISON).is_file():
        compare_table.write_running(plan.out / COMPARISON, plan.command)
    jobs: list[Job] = []
    try:
        for cell in _cells(plan, progress):
            jobs += expand([cell], plan.fitted(cell), plan.seeds, plan.out, plan.command)
        kept = set() if plan.overwrite else finished(jobs)
        left = [replace(job, goes_on=plan.resume) for job in jobs if job.folder not in kept]
        run_jobs(left, pool_of(plan.jobs, len(left), is_persistent=plan.ready is not None), progress)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; {len(finished(jobs))} of {len(jobs) or 'all'} runs are finished in {plan.out}: the same command with "
            "--resume goes on"
        ) from None
    except LslamError:
        release_output(plan.out, COMPARISON)
        raise
    scores = [collect_run(job, job.folder in kept) for job in jobs]
    comparison, drawings = _weigh(plan, jobs, scores)
    compare_table.write_files(plan.out, comparison)
    compare_html.write_page(plan.out / "compare.html", comparison, drawings, plan.crop)
    compare_table.write_result(plan.out / COMPARISON, comparison)
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
                scenes[subject.label],
                seed,
                plan.out / SIMULATED,
                lambda stage, total: progress.on_start(stage, total, "scans", 1),
                lambda: progress.on_step(""),
            )
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
        pairs=tuple(compare_pairs(scores, methods, ((v.name, v.without) for v in plan.variants if v.without))),
        differences=tuple(differences),
        notes=tuple(_notes(scores)),
        configs={v.name: v.config.model_dump(mode="json") for v in plan.variants},
        tie=TIE_M,
        beside=() if plan.ready is None else plan.ready.beside(scores),
    ), drawings
