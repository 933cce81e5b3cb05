"""Options of a comparison, study or batch, without heavy imports: its output folder, its numbers, a study by its name."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lslam.core.errors import OutputExistsError, UsageError, nearest, output_errors
from lslam.core.untrusted import parse_toml

if TYPE_CHECKING:
    from lslam.core.config.study import StudyConfig

SIMULATED = "simulated"
# The file that makes a folder one of ours, and what such a folder holds.
COMPARISON, STUDY, BATCH = "compare.json", "study.toml", "batch.toml"
WORDS = {COMPARISON: "comparison", STUDY: "study", BATCH: "batch"}
ONE_TRUTH = "--gt belongs to one recorded sequence: a scenario has its own, and several need one each"


@dataclass(frozen=True)
class OutputOptions:
    """Options of the output folder.

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


def folder_by_time(name: str) -> Path:
    """Default output folder: runs/<name>-<time>."""
    return Path("runs") / time.strftime(f"{name}-%Y%m%d-%H%M%S")


def make_output(output: OutputOptions, mark: str) -> None:
    """Make the output folder, or raise as `require_free`; the caller writes the file `mark`, which identifies what it holds."""
    require_free(output, mark)
    with output_errors(f"output folder {output.out}"):
        output.out.mkdir(parents=True, exist_ok=True)


def require_free(output: OutputOptions, mark: str) -> None:
    """Raise OutputExistsError for a file, a foreign folder, or one with runs that may not be resumed.

    UsageError for `overwrite` and `resume` at once; OutputError when it cannot be read.
    """
    out = output.out
    if output.overwrite and output.resume:
        raise UsageError("--overwrite runs everything anew and --resume keeps what is finished: give one of them")
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"output {out} is a file; name a folder with --out")
    with output_errors(f"output folder {out}"):
        has_something = out.is_dir() and any(out.iterdir())
        if has_something and not (out / mark).is_file():
            raise OutputExistsError(f"output folder {out} is not a {WORDS[mark]} of lslam; name another with --out")
    if has_something and not (output.overwrite or output.resume):
        raise OutputExistsError(
            f"output folder {out} exists; --resume keeps its finished runs, --overwrite runs all anew, or name "
            "another with --out"
        )


def release_output(out: Path, mark: str) -> None:
    """Remove an output folder that holds nothing but its `mark`, so that the command can be repeated."""
    with contextlib.suppress(OSError):
        inside = [path.name for path in out.iterdir()]
        if inside == [mark]:
            (out / mark).unlink()
            out.rmdir()


def check_numbers(seeds: Sequence[int], jobs: int, crop: tuple[float, float, float] | None) -> None:
    """Raise UsageError for numbers of a plan that are out of range."""
    if len(set(seeds)) < len(seeds) or not seeds or min(seeds) < 0:
        raise UsageError(f"--seeds {','.join(map(str, seeds))}: different whole numbers from 0, for example 0,1,2")
    if jobs < 1:
        raise UsageError(f"--jobs {jobs}: at least one run at a time")
    if crop is not None and not crop[2] > 0:
        raise UsageError(f"--crop: the size of {crop[2]:g} m must be above 0")


def study_names() -> tuple[str, ...]:
    """Names of the studies that ship with lslam: those of Girolimetto's chapter 5.3."""
    from lslam.core.config.config import read_package_files

    return tuple(sorted(read_package_files("lslam.studies", "ready")))


def find_study(word: str) -> StudyConfig:
    """Study of a TOML file or a ready one. Raises UsageError with the nearest name for neither, or as `read_study`."""
    from lslam.core.config.config import read_package_files
    from lslam.core.config.study import parse_study, read_study

    if word.endswith(".toml") or Path(word).is_file():
        return read_study(Path(word))
    if word not in study_names():
        raise UsageError(f"no study {word!r} and no TOML file; {nearest(word, study_names())}")
    return parse_study(parse_toml(read_package_files("lslam.studies", "ready")[word]), f"study {word!r}", word)
