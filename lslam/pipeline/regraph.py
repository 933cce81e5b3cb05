"""The pose graph of a run again, from its odometry and its keyframes: other loops, fixes, control points or settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lslam.core.config import Config
from lslam.core.config.config import load_config
from lslam.core.errors import InputError, UsageError
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.pipeline.rebuild import EarlierRun, read_run, recording_of
from lslam.pipeline.run_folder import require_odometry

# Sections that odometry does not look at.
FREE = ("loops", "graph", "gnss", "osm", "map", "eval", "report")


def open_again(run: EarlierRun, sequence: Path | None = None, **reading: Any) -> Sequence:
    """The recording of the run, with the streams that its configuration asks for; `reading` goes over what the run was told.

    Raises InputError when it is gone.
    """
    config = run.config
    return open_sequence(
        recording_of(run, sequence), vertical_correction_deg=config.input.vertical_correction_deg, imu=config.imu.use,
        gnss=config.gnss.mode != "off", **reading_of(run, sequence, **reading),
    )  # fmt: skip


def reading_of(run: EarlierRun, sequence: Path | None = None, **reading: Any) -> dict[str, Any]:
    """Options of `open_sequence` for the recording of the run, or for what it has moved to."""
    told = run.manifest.get("sequence", {}).get("reading", {}) if sequence is None else {}
    return told | {name: value for name, value in reading.items() if value is not None}


def require_another(run: Path, out: Path) -> None:
    """Raise UsageError when both are one folder, by whatever name."""
    if out.resolve() == run.resolve():
        raise UsageError(f"--out {out}: the run itself stays as it is, name another folder")


def _require_same_odometry(run: EarlierRun) -> None:
    before = load_config(run.folder / "config.toml", environ={})
    for section in Config.model_fields:
        known, now = getattr(before, section), getattr(run.config, section)
        changed = [key for key in type(known).model_fields if getattr(known, key) != getattr(now, key)]
        if section not in FREE and changed:
            raise UsageError(
                f"{section}.{changed[0]} is of the odometry, which is not run again: lslam graph takes keys of {', '.join(FREE)}"
            )


def read_for_graph(folder: Path, settings: list[str]) -> EarlierRun:
    """As `read_run`, for `pipeline.run` to take as `earlier`.

    Raises InputError for a run that kept no odometry, or was located in a map, UsageError for settings of odometry.
    """
    run = read_run(folder, settings)
    require_odometry(folder)
    if run.config.localize.map:
        raise InputError(f"{folder} was located in a map, which takes the place of a pose graph")
    _require_same_odometry(run)
    return run
