"""The grid of a study: sequences x methods x seeds, expanded to jobs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.config import Config
from lslam.config.input import AS_CONFIGURED, ScanRange
from lslam.pipeline.identity import job_digest
from lslam.studies.scenes import Scene
from lslam.studies.subjects import with_range
from lslam.studies.variants import Variant

if TYPE_CHECKING:
    from lslam.types.trajectory import Trajectory


@dataclass(frozen=True)
class Cell:
    """One recording of a study: of a subject, and of a seed when it was simulated with one.

    seed : of the simulation, None for a recording; truth : what replaces the recording's own ground truth
    digest : of the input; imu : likewise of its IMU, empty when no run asks for it
    data_root : where the IMU of a KITTI odometry sequence is looked for
    scene : what is simulated with `seed` when nothing lies in `path` yet; range : which scans are used, over the configuration
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


@dataclass(frozen=True)
class Job:
    """One run: what a process needs to make it, and `state_file`, where it leaves how it ended.

    method : the variant's name, the method of `config` or a preset that says more than a method
    digest : two jobs of one digest have the same result; scene : as of the cell; reading : what else `open_sequence` is given
    goes_on : where a run was begun and not finished, it is gone on with
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
    reading: dict[str, Any] = field(default_factory=dict)
    goes_on: bool = False

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.sequence} {self.method} seed {self.seed}"

    @property
    def state_file(self) -> Path:
        """Beside the run folder, because it outlives a run that could not even make its folder."""
        return self.folder.with_name(f"{self.folder.name}.json")


def run_folder(out: Path, sequence: str, method: str, seed: int) -> Path:
    """Where a run of the study lies."""
    return out / "runs" / sequence / f"{method}-s{seed}"


def expand(
    cells: Sequence[Cell], variants: Sequence[Variant], seeds: Sequence[int], out: Path, command: str
) -> list[Job]:
    """All jobs, methods innermost, so that what slows the machine for a while meets all methods alike.

    A recording is run once per seed by a method that draws, and once by one that does not; a simulated cell has its seed.
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
                config = with_range(config, cell.range)
                folder = run_folder(out, cell.sequence, variant.name, seed)
                digest = job_digest(config, cell.digest, cell.imu)
                jobs.append(
                    Job(
                        cell.sequence, variant.name, seed, cell.path, config, folder, digest, command, cell.truth,
                        cell.data_root, cell.scene,
                    )
                )  # fmt: skip
    return jobs
