"""The virtual environment; here, cheap checks of the folder of a simulation before heavy imports."""

from __future__ import annotations

from pathlib import Path

from lslam.core.errors import OutputError, OutputExistsError, cause

NUMBER = "00"  # of the one sequence in the folder


def check_target(out: Path, overwrite: bool, resume: bool = False) -> None:
    """Raise OutputExistsError when `out` is a file, or not empty and neither `overwrite` nor `resume` permits that."""
    try:
        if out.exists() and not out.is_dir():
            raise OutputExistsError(f"{out} is a file: give --out a folder that does not exist yet")
        if overwrite or not out.is_dir() or not any(out.iterdir()):
            return
        begun = part_of(out).is_dir()
        if resume and begun:
            return
        if begun:
            raise OutputExistsError(
                f"{out} holds a simulation that was interrupted: --resume goes on, --overwrite begins anew"
            )
        raise OutputExistsError(
            f"{out} exists already{' and nothing in it was interrupted' if resume else ''}: choose another --out, or "
            "--overwrite to replace the sequence in it"
        )
    except OSError as error:
        raise OutputError(f"{out} cannot be read: {cause(error)}") from None


def part_of(out: Path) -> Path:
    """Folder of the scans of an unfinished simulation."""
    return out / "sequences" / f"{NUMBER}.part"
