"""The runs of one sequence brought into one world, for the page; and how far apart they are when nothing is true."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.config.eval import EvalConfig
from lslam.errors import LslamError
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.recipes import ALIGNMENTS
from lslam.evaluation.results import AbsoluteError
from lslam.formats.trajectory_files import read_trajectory
from lslam.readers import open_sequence
from lslam.studies.grid import Job
from lslam.types.comparison import Difference, Drawing, DrawnRun, RunScore
from lslam.types.sequence import Sequence as Recording
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")
PREFERRED = EvalConfig(align=("se3", "origin"))


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
    drawn, names, gt_positions = [], set(), None
    for run in runs:
        score = evaluate(run.trajectory, truth, PREFERRED, calibration=recording.calibration)
        error = _available(list(score.ate.values()))
        names.add(error.alignment)
        gt_positions = score.gt_positions
        distances = np.linalg.norm(error.errors, axis=1)
        drawn.append(
            DrawnRun(run.job.method, error.aligned_positions, score.distance, distances, error.T_gt_est, _map_file(run))
        )
    recipe = "; ".join(f"{name}: {ALIGNMENTS[name]}" for name in sorted(names))
    return Drawing(sequence, seed, gt_positions, tuple(drawn), f"moved onto the ground truth, {recipe}")


def _available(errors: list[AbsoluteError]) -> AbsoluteError:
    return next((error for error in errors if error.available), errors[-1])


def _in_own_world(sequence: str, seed: int, runs: Sequence[Finished]) -> Drawing:
    drawn = tuple(
        DrawnRun(run.job.method, run.trajectory.positions, None, None, np.eye(4), _map_file(run)) for run in runs
    )
    return Drawing(sequence, seed, None, drawn, "in the world of the LiDAR at the first scan")


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
