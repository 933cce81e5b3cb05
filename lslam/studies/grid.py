"""Grid of a study as jobs: cells (recordings and simulations) x methods x seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.core.config import Config
from lslam.core.config.input import AS_CONFIGURED, ScanRange
from lslam.core.config.study import StudySequence
from lslam.core.errors import InputError, UsageError
from lslam.core.printable import file_safe
from lslam.io.formats.bag_listing import stem_of
from lslam.io.readers import find_folder, open_sequence
from lslam.io.readers.kitti_raw import with_imu
from lslam.io.remote import RemotePath, as_path
from lslam.pipeline.resume import imu_digest, input_digest, job_digest, listing_digest
from lslam.studies.options import SIMULATED, OutputOptions
from lslam.studies.subjects import Scene, check_range, count_scans, drive_of, scene_digest, scene_folder, with_range
from lslam.studies.variants import Variant, free_name

if TYPE_CHECKING:
    from lslam.core.types.trajectory import Trajectory


@dataclass(frozen=True)
class Cell:
    """One recording of a study: a subject, with a seed if it is simulated.

    seed : of the simulation, None for a recording; truth : replaces the recording's own ground truth
    digest : of the input; imu : likewise of its IMU, empty when no run asks for it
    data_root : where the IMU of a KITTI odometry sequence is looked for
    scene : simulated with `seed` if `path` does not exist yet; range : scans used, overriding the configuration
    refusal : why the recording cannot be read: the error of its runs; reading : further options of `open_sequence`
    """

    sequence: str
    path: Path
    seed: int | None
    digest: str
    truth: Trajectory | None = None
    imu: str = ""
    data_root: Path | None = None
    scene: Scene | None = None
    range: ScanRange = AS_CONFIGURED
    refusal: str = ""
    reading: Mapping[str, Any] = field(default_factory=dict)

    def job(self, method: str, seed: int, config: Config, folder: Path, command: str) -> Job:
        """Run of the recording by a `config` that has the scans used; method : name of the variant."""
        return Job(
            self.sequence,
            method,
            seed,
            self.path,
            config,
            folder,
            job_digest(config, self.digest, self.imu),
            command,
            self.truth,
            self.data_root,
            self.scene,
            self.reading,
            refusal=self.refusal,
        )


@dataclass(frozen=True)
class Job:
    """One run: all that a process needs to make it.

    method : the variant's name, the method of `config` or a preset that says more than a method
    digest : two jobs of one digest have the same result; truth to refusal : as of the cell
    goes_on : resume an unfinished run
    """

    sequence: str
    method: str
    seed: int
    path: Path
    config: Config
    folder: Path
    digest: str
    command: str
    truth: Trajectory | None = None
    data_root: Path | None = None
    scene: Scene | None = None
    reading: Mapping[str, Any] = field(default_factory=dict)
    goes_on: bool = False
    refusal: str = ""

    @property
    def name(self) -> str:
        """Display name."""
        return f"{self.sequence} {self.method} seed {self.seed}"

    @property
    def state_file(self) -> Path:
        """State file beside the run folder, which exists even if the run could not make its folder."""
        return self.folder.with_name(f"{self.folder.name}.json")


def run_folder(out: Path, sequence: str, method: str, seed: int) -> Path:
    """Folder of a run of the study."""
    return out / "runs" / sequence / f"{method}-s{seed}"


def expand(
    cells: Sequence[Cell], variants: Sequence[Variant], seeds: Sequence[int], out: Path, command: str
) -> list[Job]:
    """All jobs, methods innermost, so that a slow phase of the machine affects all methods alike.

    A recording is run once per seed by a random method, and once by a deterministic one. A simulated cell has its seed.
    """
    jobs = []
    for cell in cells:
        for seed in seeds if cell.seed is None else [cell.seed]:
            for variant in variants:
                config = variant.config
                if cell.seed is None and variant.draws:
                    config = variant.with_seed(seed)
                elif cell.seed is None and seed != seeds[0]:
                    continue
                folder = run_folder(out, cell.sequence, variant.name, seed)
                jobs.append(cell.job(variant.name, seed, with_range(config, cell.range), folder, command))
    return jobs


def recorded_cell(
    label: str,
    path: Path,
    seed: int | None = None,
    *,
    needs_imu: bool,
    truth: Trajectory | None = None,
    data_root: Path | None = None,
    own: ScanRange = AS_CONFIGURED,
) -> Cell:
    """Cell of an existing recording; `own` : its ranges of scans.

    Raises InputError when it cannot be opened, or has no IMU and some run asks for one; UsageError when it ends before `own`.
    """
    sequence = open_sequence(path)
    check_range(label, own, len(sequence))
    imu = imu_digest(with_imu(sequence, data_root)) if needs_imu else ""
    return Cell(label, path, seed, input_digest(sequence, truth), truth, imu, data_root, range=own)


def label_of(path: Path) -> str:
    """Label of a recording that is not opened: the name of its file or folder."""
    return file_safe(stem_of(path))


def fit_scene(scene: Scene, count: int | None, own: ScanRange, seeds: Sequence[int]) -> Scene:
    """Scene with the number of scans that the study needs, unless it states one; its whole path if skipping needs more.

    own : ranges of scans, overriding the configurations; seeds : of the simulations, whose paths differ a little
    Raises UsageError when the scenario ends before them.
    """
    if scene.scans is not None:
        check_range(scene.name, own, scene.scans)
        return scene
    enough = replace(scene, scans=count)
    if own.own:
        try:
            drives = [drive_of(enough, seed) for seed in seeds]
        except UsageError:
            enough = scene
            drives = [drive_of(scene, seed) for seed in seeds]
        check_range(scene.name, own, min(map(len, drives)))
    return enough


def cells_of(
    sequences: Sequence[StudySequence],
    seeds: Sequence[int],
    variants: Sequence[Variant],
    output: OutputOptions,
    settings: Sequence[str] = (),
    *,
    may_fail: bool = False,
) -> list[Cell]:
    """Recordings as they are, scenarios once per seed, every one with a label of its own.

    settings : "a.b=v" that beat the sequences' own `start`, `count` and `skip_frames`
    may_fail : a recording that cannot be read is a cell with its refusal

    Raises InputError for a recording that cannot be opened or lacks the IMU; UsageError or ConfigError for a scenario that is
    none, UsageError for a sequence that ends before the scans that are its own.
    """
    configs = [variant.config for variant in variants]
    needs_imu = any(config.imu.use for config in configs)
    beaten = {setting.partition("=")[0].strip() for setting in settings}
    cells: list[Cell] = []
    names: set[str] = set()
    for sequence in sequences:
        own = ScanRange(**{key: value for key, value in sequence.own.items() if f"input.{key}" not in beaten})
        count = count_scans([with_range(config, own).input for config in configs])
        if sequence.path:
            own_cells = [_recording_cell(sequence.path, own, needs_imu, output, may_fail)]
        else:
            own_cells = _scene_cells(sequence, own, count, seeds, output)
        # The same recording with other settings is another sequence, with a folder of its own.
        label = free_name(own_cells[0].sequence, names)
        cells += [replace(cell, sequence=label) for cell in own_cells]
    return cells


def _recording_cell(word: str, own: ScanRange, needs_imu: bool, output: OutputOptions, may_fail: bool) -> Cell:
    """Cell of the recording `word`, with the digest of its IMU if `needs_imu`; one in storage is listed, but not opened.

    Raises InputError when it cannot be opened; if `may_fail`, the cell holds it as `refusal`.
    """
    path = as_path(word).expanduser().absolute()
    try:
        path = find_folder(word, output.data_root).absolute()
        if isinstance(path, RemotePath):
            # Thousands of recordings are not opened here over a network: each run says what is wrong with its own.
            return Cell(label_of(path), path, None, listing_digest(path), data_root=output.data_root, range=own)
        label = file_safe(open_sequence(path).name)
        return recorded_cell(label, path, needs_imu=needs_imu, data_root=output.data_root, own=own)
    except InputError as error:
        if not may_fail:
            raise
        return Cell(label_of(path), path, None, "", data_root=output.data_root, range=own, refusal=str(error))


def _scene_cells(
    s: StudySequence, own: ScanRange, count: int | None, seeds: Sequence[int], output: OutputOptions
) -> list[Cell]:
    """Cell of the scenario for each seed; digests stand in for simulations that do not exist yet."""
    scene = Scene(s.scenario, s.scans, s.lidar, s.columns, s.speed, s.compensated, s.imu, s.settings)
    scene = fit_scene(scene, count, own, seeds)
    parent = output.scenes or output.out / SIMULATED
    # Simulations may still have to be made: their digests cover the future content and the IMU.
    return [
        Cell(scene.name, scene_folder(scene, k, parent), k, scene_digest(scene, k), scene=scene, range=own)
        for k in seeds
    ]
