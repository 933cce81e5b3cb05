"""Whether an output suits what is written there, seen before anything heavy is imported."""

from __future__ import annotations

from pathlib import Path

from lslam.errors import OutputExistsError, UsageError

SUFFIXES = {"bag": ".bag", "mcap": ".mcap", "sqlite": ".db3"}


def check_output(kind: str, out: Path, is_zstd: bool, overwrite: bool) -> None:
    """Raise UsageError when `out` does not suit `kind`, OutputExistsError when it is there already."""
    if kind not in (*SUFFIXES, "kitti"):
        raise UsageError(f"no layout {kind!r} for sequences: {', '.join(SUFFIXES)} and kitti are")
    if is_zstd and kind in ("bag", "kitti"):
        raise UsageError(f"--zstd is for mcap and sqlite, not for {kind}")
    fitting = SUFFIXES.get(kind, "")
    if out.suffix in SUFFIXES.values() and out.suffix != fitting:
        raise UsageError(f"--out {out}: a name in {out.suffix} is not for --to {kind}")
    if kind == "bag" and out.suffix != ".bag":
        raise UsageError(f"--out {out}: a ROS 1 bag is one file, its name ends in .bag")
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists already: choose another --out, or --overwrite it")
