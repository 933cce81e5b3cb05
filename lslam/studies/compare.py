"""The comparison of methods in order: simulate what is a scenario, run the grid, collect, weigh, write."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import LslamError, UsageError
from lslam.core.types.comparison import Comparison, Difference, Drawing, DrawnRun, RunScore
from lslam.core.types.sequence import Sequence as Recording
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation import ALIGNMENTS
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import AbsoluteError
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.reports import compare_html, compare_table
from lslam.reports.picture import as_html
from lslam.studies.grid import Cell, Job, expand, fit_scene, recorded_cell
from lslam.studies.jobs import Local, left_to_do, study_folder
from lslam.studies.options import (
    COMPARISON,
    ONE_TRUTH,
    SIMULATED,
    OutputOptions,
    check_numbers,
    folder_by_time,
    require_free,
)
from lslam.studies.paired import TIE_M, compare_pairs, summarise
from lslam.studies.ready_comparison import ReadyComparison
from lslam.studies.results import IMU, collect_run, metrics_of
from lslam.studies.runner import StudyProgress
from lslam.studies.subjects import Scene, Subject, count_scans, find_subjects, simulate_once, with_range
from lslam.studies.variants import Imu, Variant, find_variants

log = logging.getLogger("lslam")
PAIR_EVALUATION = EvalConfig(align=("se3", "origin"))
# rad; half a metre at a wall that stands 30 m beside the path.
LARGEST_TURN = 1 / 60
# More than this many busy cores before the first run, and its times are somebody else's too.
BUSY = 0.5


@dataclass(frozen=True)
class Plan:
    """Sequences, methods and options of a comparison.

    jobs : runs at once, with more than one times cannot be compared; truth : replaces that of the only sequence
    crop : (x, y, size) of the map crop, m, None to choose; ready : that ships with lslam, which this is
    """

    subjects: tuple[Subject, ...]
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    output: OutputOptions
    jobs: int = 1
    truth: Trajectory | None = None
    crop: tuple[float, float, float] | None = None
    ready: ReadyComparison | None = None

    def variants_on(self, cell: Cell) -> Sequence[Variant]:
        """The variants as they run on the recording of a cell."""
        return self.variants if self.ready is None else self.ready.variants_on(self.variants, cell, self.output.out)


def check_plan(plan: Plan) -> None:
    """Raise UsageError for a plan that cannot be run."""
    if not plan.variants:
        raise UsageError("no method is named")
    if not plan.subjects:
        raise UsageError("no sequence is named")
    check_numbers(plan.seeds, plan.jobs, plan.crop)
    if plan.truth is not None and (len(plan.subjects) > 1 or plan.subjects[0].scenario):
        raise UsageError(ONE_TRUTH)
    if plan.crop is not None and not all(v.config.map.write for v in plan.variants):
        raise UsageError("--crop needs maps, and map.write is off")


@dataclass(frozen=True)
class UsableRun:
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
    """Trajectories of usable runs with the first seed by sequence, and, without ground truth, differences of the methods."""
    drawings, differences = [], []
    groups: dict[str, list[UsableRun]] = {}
    for job, score in zip(jobs, scores, strict=True):
        if score.is_usable:
            groups.setdefault(job.sequence, []).append(UsableRun(job, read_trajectory(job.folder)))
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
    """Context in which the log shows warnings and errors only."""
    before = log.level
    log.setLevel(max(before, logging.WARNING))
    try:
        yield
    finally:
        log.setLevel(before)


def _in_world_of_truth(
    sequence: str, seed: int, runs: Sequence[UsableRun], recording: Recording, truth: Trajectory
) -> Drawing:
    """Drawing of runs in the truth's frame; all by the alignment at the first pose where another one would turn a run much."""
    scores = [evaluate(run.trajectory, truth, PAIR_EVALUATION, calibration=recording.calibration) for run in runs]
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
    """Uncertainty, rad, of the rotation about the path in an alignment of positions: rmse over the path's width.

    Infinite for a straight path, and without errors.
    """
    width = np.linalg.svd(gt_positions - gt_positions.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(gt_positions))
    return np.inf if error.translation is None or width == 0 else float(error.translation.rmse / width)


def _available(errors: list[AbsoluteError]) -> AbsoluteError:
    """Errors by the first alignment that is determined, else by the last."""
    return next((error for error in errors if error.available), errors[-1])


def _in_own_world(sequence: str, seed: int, runs: Sequence[UsableRun]) -> Drawing:
    """Without ground truth: every run from the start that all share, and how far it is from the first, scan by scan."""
    drawn = []
    for run in runs:
        distance, errors = (None, None) if run is runs[0] else _apart(run, runs[0])
        positions, file = run.trajectory.positions, _map_file(run)
        drawn.append(DrawnRun(run.job.method, positions, distance, errors, np.eye(4), file))
    recipe = "in the world of the LiDAR at the first scan"
    return Drawing(sequence, seed, None, tuple(drawn), recipe, runs[0].job.method)


def _apart(run: UsableRun, other: UsableRun) -> tuple[Floats | None, Floats | None]:
    """m along another run and from it at the poses that both have, from the same start; None where they share none."""
    try:
        score = evaluate(run.trajectory, other.trajectory, EvalConfig(align=("origin",)))
    except LslamError:  # `_differences` says so
        return None, None
    return score.distance, np.linalg.norm(score.ate["origin"].errors, axis=1)


def _map_file(run: UsableRun) -> Path | None:
    """Map file of a run; None without one that can be drawn."""
    return next((path for path in sorted(run.job.folder.glob("map.*")) if path.suffix in (".ply", ".pcd")), None)


def _differences(sequence: str, runs: Sequence[UsableRun]) -> list[Difference]:
    """Every run against the reference's of the same seed, over the poses they share."""
    out = []
    reference = runs[0].job.method
    of_reference = {run.job.seed: run for run in runs if run.job.method == reference}
    for run in runs:
        other = of_reference.get(run.job.seed) or next(iter(of_reference.values()))
        if run.job.method == reference:
            continue
        try:
            score = evaluate(run.trajectory, other.trajectory, PAIR_EVALUATION)
        except LslamError as error:
            log.warning("%s: %s and %s cannot be compared: %s", sequence, run.job.method, reference, error)
            continue
        rmse = {name: e.translation.rmse if e.translation else float("nan") for name, e in score.ate.items()}
        out.append(Difference(sequence, run.job.method, reference, run.job.seed, rmse["origin"], rmse["se3"]))
    return out


def run_comparison(plan: Plan, progress: StudyProgress | None = None) -> Comparison:
    """Run every method on every sequence and seed, and write compare.csv, .tex, .json and .html into the output folder.

    Raises
    ------
    UsageError : methods or numbers that make no sense, before anything runs; OutputExistsError : `out` holds something and
        neither `overwrite` nor `resume` is set; OutputError; InputError : a sequence that cannot be opened
    InterruptedRunError : Ctrl-C or SIGTERM; finished runs are kept, and `resume` goes on
    """
    progress = progress or StudyProgress()
    check_plan(plan)
    output, out, jobs = plan.output, plan.output.out, list[Job]()
    with study_folder(output, COMPARISON, jobs):
        if not (out / COMPARISON).is_file():
            compare_table.write_running(out / COMPARISON, output.command)
        for cell in _cells(plan, progress):
            jobs += expand([cell], plan.variants_on(cell), plan.seeds, out, output.command)
        left = left_to_do(output, jobs)
        Local(plan.jobs, plan.ready is not None, "comparing", tries=1).run(left, progress)
    folders = {job.folder for job in left}
    scores = [collect_run(job, job.folder not in folders) for job in jobs]
    comparison, drawings = _weigh(plan, jobs, scores)
    compare_table.write_files(out, comparison)
    compare_html.write_page(out / "compare.html", comparison, drawings, plan.crop)
    compare_table.write_result(out / COMPARISON, comparison)
    return comparison


def _cells(plan: Plan, progress: StudyProgress) -> list[Cell]:
    """Cells of the comparison: recordings as they are, scenarios simulated once per seed."""
    needs_imu = any(variant.config.imu.use for variant in plan.variants)
    # What cannot be opened, or has no IMU though one is asked for, is said before anything is simulated.
    root = plan.output.data_root
    recordings = {
        s.label: recorded_cell(s.label, s.path, needs_imu=needs_imu, truth=plan.truth, data_root=root, own=s.range)
        for s in plan.subjects
        if s.path is not None
    }
    scenes = {s.label: _scene(plan, s) for s in plan.subjects if s.scenario is not None}
    cells = []
    for subject in plan.subjects:
        if subject.label in recordings:
            cells.append(recordings[subject.label])
            continue
        for seed in plan.seeds:
            path = simulate_once(scenes[subject.label], seed, plan.output.out / SIMULATED, progress)
            cells.append(recorded_cell(subject.label, path, seed, needs_imu=needs_imu, own=subject.range))
    return cells


def _scene(plan: Plan, subject: Subject) -> Scene:
    """Scene simulated of a scenario; raises UsageError when it ends before the scans that are used."""
    assert subject.scenario is not None
    needed = count_scans([with_range(v.config, subject.range).input for v in plan.variants])
    return fit_scene(Scene(subject.scenario), needed, subject.range, plan.seeds)


def _notes(scores: Sequence[RunScore]) -> list[str]:
    """Sentences on what limits the comparison of times, for readers of the tables."""
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
    """Compare the scores of `jobs`: tables, pairs and differences; and drawings of their trajectories."""
    drawings, differences = draw(jobs, scores)
    methods = tuple(variant.name for variant in plan.variants)
    return Comparison(
        command=plan.output.command,
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


@dataclass(frozen=True)
class CompareOutcome:
    """Result of `compare`: all numbers, and the folder of the runs with the page `compare.html`."""

    comparison: Comparison
    folder: Path

    def table(self, style: str = "text") -> str:
        """Tables as `text`, `md`, `csv` (a row per run) or `tex`."""
        return compare_table.render(self.comparison, style)

    def __str__(self) -> str:
        """Tables as text."""
        return self.table()

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        return as_html(self.table())


def compare(
    sequences: Iterable[str | Path],
    methods: Iterable[str],
    *,
    seeds: Iterable[int] = (0,),
    out: str | Path | None = None,
    jobs: int = 1,
    imu: Imu | None = None,
    settings: Iterable[str] = (),
    overwrite: bool = False,
    resume: bool = False,
) -> CompareOutcome:
    """Run methods on the same sequences, and weigh them against each other.

    Parameters
    ----------
    sequences : recordings as `open_sequence` takes them, or names of scenarios, which are simulated once per seed
    methods : names of methods or presets, or TOML files; the first is the reference
    out : folder of all runs (default: runs/compare-TIME); jobs : runs at once, times are comparable with one only
    imu : `both` makes two of each, `on` and `off` one; settings : "map.voxel=0.1", of all runs

    Raises
    ------
    UsageError, InputError and OutputError as the command does.

    Notes
    -----
    Runs are processes of their own: in a script call it below ``if __name__ == "__main__":``.
    """
    folder = Path(out) if out is not None else folder_by_time("compare")
    output = OutputOptions(folder, overwrite, resume, command="lslam.compare")
    require_free(output, COMPARISON)
    subjects = tuple(find_subjects([str(sequence) for sequence in sequences]))
    variants = tuple(find_variants(list(methods), None, list(settings), imu))
    return CompareOutcome(run_comparison(Plan(subjects, variants, tuple(seeds), output, jobs)), folder)
