"""The pose graph of a run again, from its odometry and its keyframes: other loops, fixes, control points or settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lslam.config import Config
from lslam.config.load import load_config
from lslam.errors import InputError, UsageError
from lslam.pipeline.deliver import perform, raise_outcome
from lslam.pipeline.job import prepare
from lslam.pipeline.rebuild import EarlierRun, read_run
from lslam.pipeline.run_folder import require_odometry
from lslam.pipeline.watch import RunOutcome, Watch
from lslam.readers import open_sequence
from lslam.remote import as_path
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory
from lslam.warned import hearing

# Sections that odometry does not look at.
FREE = ("loops", "graph", "gnss", "osm", "map", "eval", "report")


def open_again(run: EarlierRun, sequence: Path | None = None, **reading: Any) -> Sequence:
    """The recording of the run, with the streams that its configuration asks for; `reading` goes over what the run was told.

    Raises InputError when it is gone.
    """
    path = as_path(run.sequence_path) if sequence is None else sequence
    if sequence is None and not path.exists():
        raise InputError(
            f"the raw scans of {run.folder} are gone: {path} does not exist; say where they are with --sequence"
        )
    told = run.manifest.get("sequence", {}).get("reading", {}) if sequence is None else {}
    given = {name: value for name, value in reading.items() if value is not None}
    config = run.config
    return open_sequence(
        path, vertical_correction_deg=config.input.vertical_correction_deg, imu=config.imu.use,
        gnss=config.gnss.mode != "off", **(told | given),
    )  # fmt: skip


def optimise_again(
    run: EarlierRun, sequence: Sequence, out: Path, *, ground_truth: Trajectory | None = None, overwrite: bool = False,
    resume: bool = False, command: str = "", watch: Watch | None = None,
) -> RunOutcome:  # fmt: skip
    """A run folder at `out` with the odometry of `run` and the pose graph of its configuration; `run` stays as it is.

    Raises as `pipeline.run`, and UsageError for settings that odometry would have to be run again for.
    """
    watch = watch or Watch()
    _require_same_odometry(run)
    with hearing() as heard:
        job = prepare(sequence, run.config, ground_truth, command, watch)
        stamps = np.asarray(job.sequence.stamps_ns)
        if not np.array_equal(stamps, run.trajectory.stamps_ns):
            raise InputError(f"{sequence.path} does not fit {run.folder}: its {len(stamps)} scans have other stamps")
        job.manifest.reading = dict(run.manifest.get("sequence", {}).get("reading", {}))
        job.manifest.warnings = heard
        outcome = perform(job, out, overwrite, resume, odometry_of=run.folder)
    watch.on_end(outcome)
    raise_outcome(job.manifest, job.config, ", and --resume goes on")
    return outcome


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
    """As `read_run`; raises InputError for a run that kept no odometry, or was located in a map."""
    run = read_run(folder, settings)
    require_odometry(folder)
    if run.config.localize.map:
        raise InputError(f"{folder} was located in a map, which takes the place of a pose graph")
    return run
