"""A sensitivity study in order: expand, keep what is finished, simulate, run, and write every row as it comes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import tomli_w

from lslam.config.study import StudyConfig, StudySequence
from lslam.errors import InterruptedRunError, LslamError, RunFailedError
from lslam.formats.atomic import atomic_write
from lslam.readers import open_sequence
from lslam.readers.lookup import find_folder
from lslam.studies.cells import recorded_cell, scene_cell
from lslam.studies.engines import Engine
from lslam.studies.grid import Cell, Job, expand
from lslam.studies.jobs import finished
from lslam.studies.plan import SIMULATED, Follow, claim, release
from lslam.studies.points import Contender, contenders
from lslam.studies.results import Results
from lslam.studies.scenes import Scene
from lslam.studies.subjects import file_safe, scans_needed
from lslam.types.study import StudyRow

# The study as it was resolved; it makes the folder one of a study.
MARK = "study.toml"


@dataclass(frozen=True)
class Sweep:
    """What is to be studied where.

    settings : "a.b=v" over what the study says; overwrite : run everything anew; resume : keep finished runs
    scenes : where simulations lie, None for a folder in `out`; studies of the same scenarios can share them
    data_root : where recordings by name and the IMU of a KITTI odometry sequence are looked for
    """

    study: StudyConfig
    out: Path
    settings: tuple[str, ...] = ()
    overwrite: bool = False
    resume: bool = False
    scenes: Path | None = None
    data_root: Path | None = None
    command: str = ""


@dataclass(frozen=True)
class Expanded:
    """Every run of a study, and what its variants stand for, by name."""

    jobs: list[Job]
    contenders: dict[str, Contender]


def expand_study(sweep: Sweep) -> Expanded:
    """All runs, checked before any begins; nothing is simulated or written.

    Raises ConfigError, UsageError or InputError for parameters, methods, recordings and scenarios that make no sense.
    """
    found = contenders(sweep.study, sweep.settings)
    variants = [c.variant for c in found]
    jobs = expand(_cells(sweep, found), variants, sweep.study.seeds, sweep.out, sweep.command)
    return Expanded(jobs, {c.variant.name: c for c in found})


def left_to_do(sweep: Sweep, jobs: Sequence[Job]) -> list[Job]:
    """Those that are not finished in `sweep.out`, or all when they are to be overwritten."""
    kept = set() if sweep.overwrite else finished(jobs)
    return [job for job in jobs if job.folder not in kept]


def run_sweep(
    sweep: Sweep,
    engine: Engine,
    follow: Follow | None = None,
    on_rows: Callable[[Sequence[StudyRow]], None] = lambda rows: None,
) -> list[StudyRow]:
    """Make every run that is not finished yet; results.csv and results.parquet in `sweep.out` grow as they end.

    on_rows : called with all rows so far

    Raises
    ------
    LslamError : as `expand_study`, `claim` and the engine. RunFailedError : all runs failed
    InterruptedRunError : Ctrl-C or SIGTERM; finished runs are kept, and `resume` goes on
    """
    follow = follow or Follow()
    expanded = expand_study(sweep)
    jobs = expanded.jobs
    results = Results(sweep.study.name, sweep.out, jobs, expanded.contenders)
    claim(sweep.out, MARK, "study", sweep.overwrite, sweep.resume)
    try:
        if not sweep.overwrite:
            results.check()
        _write_mark(sweep)
        left = left_to_do(sweep, jobs)
        begun = {job.folder for job in left}
        results.add([job for job in jobs if job.folder not in begun])
        engine.prepare(left, follow)

        def on_done(job: Job) -> None:
            results.add([job])
            on_rows(results.rows)

        on_rows(results.rows)
        engine.run(left, follow, on_done)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; {len(finished(jobs))} of {len(jobs)} runs are finished in {sweep.out}: the same command with "
            "--resume goes on"
        ) from None
    except LslamError:
        release(sweep.out, MARK)
        raise
    rows = results.rows
    if rows and not any(row.is_usable for row in rows):
        raise RunFailedError(f"all {len(rows)} runs failed, the first one: {rows[0].reason}")
    return rows


def _cells(sweep: Sweep, found: Sequence[Contender]) -> list[Cell]:
    configs = [c.variant.config for c in found]
    needed = scans_needed([config.input for config in configs])
    needs_imu = any(config.imu.use for config in configs)
    cells: list[Cell] = []
    for sequence in sweep.study.sequences:
        made = [_recorded(sequence.path, needs_imu, sweep)] if sequence.path else _simulated(sequence, needed, sweep)
        # The same place with other settings is another sequence, with a folder of its own.
        taken = {cell.sequence for cell in cells}
        label = made[0].sequence
        number = next(k for k in count(1) if (label if k == 1 else f"{label}-{k}") not in taken)
        cells += made if number == 1 else [replace(cell, sequence=f"{label}-{number}") for cell in made]
    return cells


def _recorded(word: str, needs_imu: bool, sweep: Sweep) -> Cell:
    path = find_folder(word, sweep.data_root).absolute()
    label = file_safe(open_sequence(path).name)
    return recorded_cell(label, path, needs_imu=needs_imu, data_root=sweep.data_root)


def _simulated(sequence: StudySequence, needed: int | None, sweep: Sweep) -> list[Cell]:
    s = sequence
    scans = needed if s.count is None else s.count
    scene = Scene(s.scenario, scans, s.lidar, s.columns, s.speed, s.compensated, s.imu, s.settings)
    return [scene_cell(scene, seed, sweep.scenes or sweep.out / SIMULATED) for seed in sweep.study.seeds]


def _write_mark(sweep: Sweep) -> None:
    tree = sweep.study.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    with atomic_write(sweep.out / MARK) as stream:
        stream.write(tomli_w.dumps(tree).encode())
