"""The grid of a study: sequences x methods x seeds, expanded to jobs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lslam.config import Config
from lslam.errors import UsageError
from lslam.odometry import known_methods
from lslam.pipeline.check import check_config

if TYPE_CHECKING:
    from lslam.types.trajectory import Trajectory

# Methods that bring their own preprocessing and so never draw by `preprocess.seed`.
DRAW_NOTHING = ("kiss-icp",)


@dataclass(frozen=True)
class Cell:
    """One recording of a study: of a subject, and of a seed when it was simulated with one.

    seed : of the simulation, None for a recording; truth : what replaces the recording's own ground truth
    digest : of the input
    """

    sequence: str
    path: Path
    seed: int | None
    digest: str
    truth: Trajectory | None = None


@dataclass(frozen=True)
class Job:
    """One run: what a process needs to make it, and `state_file`, where it leaves how it ended.

    digest : two jobs of one digest have the same result
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

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.sequence} {self.method} seed {self.seed}"

    @property
    def state_file(self) -> Path:
        """Beside the run folder, because it outlives a run that could not even make its folder."""
        return self.folder.with_name(f"{self.folder.name}.json")


def check_methods(methods: Sequence[str], config: Config) -> None:
    """Raise UsageError for an empty list, an unknown name (with the nearest one) or a name given twice."""
    if not methods:
        raise UsageError(f"--methods is empty; known: {', '.join(known_methods())}")
    for method in methods:
        check_config(with_method(config, method))
        if methods.count(method) > 1:
            raise UsageError(f"--methods names {method!r} twice")


def with_method(config: Config, method: str) -> Config:
    """The same configuration with another method."""
    return config.model_copy(update={"odometry": config.odometry.model_copy(update={"method": method})})


def with_seed(config: Config, seed: int) -> Config:
    """The same configuration with another seed of what it draws."""
    return config.model_copy(update={"preprocess": config.preprocess.model_copy(update={"seed": seed})})


def draws(config: Config) -> bool:
    """Whether a run depends on `preprocess.seed`."""
    return config.preprocess.downsample == "random" and config.odometry.method not in DRAW_NOTHING


def run_folder(out: Path, sequence: str, method: str, seed: int) -> Path:
    """Where a run of the study lies."""
    return out / "runs" / sequence / f"{method}-s{seed}"


def expand(
    cells: Sequence[Cell], methods: Sequence[str], seeds: Sequence[int], config: Config, out: Path, command: str
) -> list[Job]:
    """All jobs, methods innermost, so that what slows the machine for a while meets all methods alike.

    A recording is run once per seed by a method that draws, and once by one that does not; a simulated cell has its seed.
    """
    from lslam.studies.identity import job_digest

    jobs = []
    for cell in cells:
        for seed in seeds if cell.seed is None else [cell.seed]:
            for method in methods:
                own = with_method(config, method)
                if cell.seed is None and draws(own):
                    own = with_seed(own, seed)
                elif cell.seed is None and seed != seeds[0]:
                    continue
                folder = run_folder(out, cell.sequence, method, seed)
                digest = job_digest(own, cell.digest)
                jobs.append(
                    Job(cell.sequence, method, seed, cell.path, own, folder, digest, command, cell.truth)
                )  # fmt: skip
    return jobs
