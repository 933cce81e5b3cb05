"""Output folder of a comparison, study or batch: options, locking and cleaning up."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from lslam.core.errors import OutputError, OutputExistsError, UsageError, cause

SIMULATED = "simulated"
# The file that makes a folder one of ours.
COMPARISON, STUDY, BATCH = "compare.json", "study.toml", "batch.toml"


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


def lock_output(out: Path, mark: str, what: str, overwrite: bool, resume: bool) -> None:
    """Make the output folder, or raise as `require_free`; the caller writes the file `mark`, which identifies `what` it holds."""
    require_free(out, mark, what, overwrite, resume)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"output folder {out} cannot be used: {cause(error)}") from None


def require_free(out: Path, mark: str, what: str, overwrite: bool, resume: bool) -> None:
    """Raise OutputExistsError for a file, a foreign folder, or one with runs that may not be resumed.

    UsageError for `overwrite` and `resume` at once; OutputError when it cannot be read.
    """
    if overwrite and resume:
        raise UsageError("--overwrite runs everything anew and --resume keeps what is finished: give one of them")
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"output {out} is a file; name a folder with --out")
    try:
        has_something = out.is_dir() and any(out.iterdir())
        if has_something and not (out / mark).is_file():
            raise OutputExistsError(f"output folder {out} is not a {what} of lslam; name another with --out")
        if has_something and not (overwrite or resume):
            raise OutputExistsError(
                f"output folder {out} exists; --resume keeps its finished runs, --overwrite runs all anew, or name "
                "another with --out"
            )
    except OSError as error:
        raise OutputError(f"output folder {out} cannot be used: {cause(error)}") from None


def release_output(out: Path, mark: str) -> None:
    """Remove an output folder that holds nothing but its `mark`, so that the command can be repeated."""
    with contextlib.suppress(OSError):
        inside = [path.name for path in out.iterdir()]
        if inside == [mark]:
            (out / mark).unlink()
            out.rmdir()
