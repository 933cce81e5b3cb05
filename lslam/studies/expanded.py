"""Every run of a sweep or a batch, made in order: keep what is finished, simulate, run, and write each row as it comes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lslam.config.input import ScanRange
from lslam.config.preset_files import read_toml
from lslam.config.study import StudySequence
from lslam.errors import InterruptedRunError, LslamError, OutputExistsError
from lslam.formats.atomic import write_text
from lslam.printable import file_safe
from lslam.readers import open_sequence
from lslam.readers.lookup import find_folder
from lslam.studies.cells import fitted_scene, recorded_cell, scene_cell
from lslam.studies.engines import Engine
from lslam.studies.grid import Cell, Job
from lslam.studies.jobs import finished
from lslam.studies.plan import SIMULATED, Follow, claim, release
from lslam.studies.points import Contender, free_name
from lslam.studies.results import Results
from lslam.studies.scenes import Scene
from lslam.studies.subjects import scans_needed, with_range
from lslam.types.study import StudyRow
from lslam.untrusted import parse_toml


@dataclass(frozen=True)
class Place:
    """Where runs go.

    overwrite : run everything anew; resume : keep finished runs, go on with the others
    scenes : where simulations lie, None for a folder in `out`; studies of the same scenarios can share them
    data_root : where recordings by name and the IMU of a KITTI odometry sequence are looked for
    """

    out: Path
    overwrite: bool = False
    resume: bool = False
    scenes: Path | None = None
    data_root: Path | None = None
    command: str = ""


@dataclass(frozen=True)
class Expanded:
    """Every run, and what its variants stand for, by name.

    name : of the study or batch, which `text` in the file `mark` describes; what : the word for it
    """

    name: str
    what: str
    mark: str
    text: str
    jobs: list[Job] = field(default_factory=list)
    contenders: dict[str, Contender] = field(default_factory=dict)


def check_same(
    place: Place, mark: str, what: str, text: str, names_of: Callable[[dict[str, Any]], Sequence[str]]
) -> None:
    """What changed since reuses its runs by digest; rows of two studies or batches in one table are of no use to either.

    text : for the file `mark`; names_of : what its content goes by, the same if what is there and `text` share a name
    Raises OutputExistsError when it is to go on in the folder of another one; ConfigError for a damaged `mark`.
    """
    if not place.resume or not (place.out / mark).is_file():
        return
    theirs, ours = names_of(read_toml(place.out / mark, what)), names_of(parse_toml(text))
    if not set(theirs) & set(ours):
        raise OutputExistsError(
            f"output folder {place.out} holds {what} {theirs[0]!r} and --resume would go on in it with {what} {ours[0]!r}: "
            "name another folder with --out"
        )


def left_to_do(place: Place, jobs: Sequence[Job]) -> list[Job]:
    """Those that are not finished, or all unless `place.resume`."""
    kept = finished(jobs) if place.resume else set()
    return [replace(job, goes_on=place.resume) for job in jobs if job.folder not in kept]


def make_runs(
    expanded: Expanded,
    place: Place,
    engine: Engine,
    follow: Follow | None = None,
    on_rows: Callable[[Sequence[StudyRow]], None] = lambda rows: None,
) -> list[StudyRow]:
    """Make every run that is not finished yet; results.csv and results.parquet in `place.out` grow as they end.

    on_rows : called with all rows so far

    Raises
    ------
    LslamError : as `claim` and the engine; OutputExistsError : a run's own folder holds something else
    InterruptedRunError : Ctrl-C or SIGTERM; finished runs are kept, and `resume` goes on
    """
    follow = follow or Follow()
    jobs = expanded.jobs
    results = Results(expanded.name, place.out, jobs, expanded.contenders)
    claim(place.out, expanded.mark, expanded.what, place.overwrite, place.resume)
    try:
        if not place.overwrite:
            results.check()
        write_text(place.out / expanded.mark, expanded.text)
        left = left_to_do(place, jobs)
        begun = {job.folder for job in left}
        _check_folders(left, place)
        results.add([job for job in jobs if job.folder not in begun])
        engine.prepare(left, follow)

        def on_done(job: Job) -> None:
            results.add([job])
            on_rows(results.rows)

        on_rows(results.rows)
        engine.run(left, follow, on_done)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; {len(finished(jobs))} of {len(jobs)} runs are finished in {place.out}: the same command with "
            "--resume goes on"
        ) from None
    except LslamError:
        release(place.out, expanded.mark)
        raise
    return results.rows


def _check_folders(jobs: Sequence[Job], place: Place) -> None:
    """Raise OutputExistsError for a run that was given a folder of its own, which no run of this place wrote."""
    for job in jobs:
        may_replace = place.overwrite or (place.resume and job.state_file.is_file())
        if place.out not in job.folder.parents and job.folder.exists() and not may_replace:
            raise OutputExistsError(
                f"the folder {job.folder} of {job.name} exists: name another, or --overwrite replaces it"
            )


def cells_of(
    sequences: Sequence[StudySequence],
    seeds: Sequence[int],
    found: Sequence[Contender],
    place: Place,
    settings: Sequence[str] = (),
) -> list[Cell]:
    """Recordings as they are, scenarios once per seed, every one with a label of its own.

    settings : "a.b=v" that beat the sequences' own `start`, `count` and `skip_frames`

    Raises InputError for a recording that cannot be opened or lacks the IMU; UsageError or ConfigError for a scenario that is
    none, UsageError for a sequence that ends before the scans that are its own.
    """
    configs = [c.variant.config for c in found]
    needs_imu = any(config.imu.use for config in configs)
    beaten = {setting.partition("=")[0].strip() for setting in settings}
    cells: list[Cell] = []
    taken: set[str] = set()
    for sequence in sequences:
        own = ScanRange(**{key: value for key, value in sequence.own.items() if f"input.{key}" not in beaten})
        needed = scans_needed([with_range(config, own).input for config in configs])
        made = (
            [_recorded(sequence.path, own, needs_imu, place)]
            if sequence.path
            else _simulated(sequence, own, needed, seeds, place)
        )
        # The same place with other settings is another sequence, with a folder of its own.
        label = free_name(made[0].sequence, taken)
        cells += [replace(cell, sequence=label) for cell in made]
    return cells


def _recorded(word: str, own: ScanRange, needs_imu: bool, place: Place) -> Cell:
    path = find_folder(word, place.data_root).absolute()
    label = file_safe(open_sequence(path).name)
    return recorded_cell(label, path, needs_imu=needs_imu, data_root=place.data_root, own=own)


def _simulated(s: StudySequence, own: ScanRange, needed: int | None, seeds: Sequence[int], place: Place) -> list[Cell]:
    scene = Scene(s.scenario, s.scans, s.lidar, s.columns, s.speed, s.compensated, s.imu, s.settings)
    scene = fitted_scene(scene, needed, own, seeds)
    return [scene_cell(scene, seed, place.scenes or place.out / SIMULATED, own) for seed in seeds]
