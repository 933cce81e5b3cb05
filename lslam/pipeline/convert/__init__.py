"""Conversion of sequences, trajectories and runs to other formats; here, early checks of the output."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lslam.core.errors import OutputError, UsageError, cause
from lslam.pipeline.run_folder import require_new

SUFFIXES = {"bag": ".bag", "mcap": ".mcap", "sqlite": ".db3"}


def check_output(kind: str, out: Path, is_zstd: bool, overwrite: bool) -> None:
    """Raise UsageError when `out` does not suit `kind`, OutputExistsError when it exists."""
    if kind not in (*SUFFIXES, "kitti"):
        raise UsageError(f"no layout {kind!r} for sequences: {', '.join(SUFFIXES)} and kitti are")
    if is_zstd and kind in ("bag", "kitti"):
        raise UsageError(f"--zstd is for mcap and sqlite, not for {kind}")
    fitting = SUFFIXES.get(kind, "")
    if out.suffix in SUFFIXES.values() and out.suffix != fitting:
        raise UsageError(f"--out {out}: a name in {out.suffix} is not for --to {kind}")
    if kind == "bag" and out.suffix != ".bag":
        raise UsageError(f"--out {out}: a ROS 1 bag is one file, its name ends in .bag")
    require_new(out, overwrite)


def check_beside(out: Path, source: Path, what: str) -> None:
    """Raise UsageError when `out` is `source`, which messages call `what`, or a folder that holds it."""
    here, there = source.resolve(), out.resolve()
    if there == here or there in here.parents:
        raise UsageError(f"--out {out} holds {what} itself: choose another")


@contextmanager
def stage(out: Path) -> Iterator[Path]:
    """Temporary path that replaces `out`, file or folder, after the block. Raises OutputError if it cannot be written."""
    folder = out.with_name(out.name + ".new")
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        path = folder / out.name
        yield path
        if out.exists():
            out.rename(folder / "old")
        os.replace(path, out)
    except OSError as error:
        raise OutputError(f"{error.filename or out} cannot be written: {cause(error)}") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)
