"""A sequence goes in; a trajectory, a map and an honest report come out: `job` resolves, passes work, `stages` write."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lslam.core.config import Config
from lslam.core.errors import InputError
from lslam.core.kernels import jit
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.core.types.warned import collect_warnings
from lslam.io.remote import as_path
from lslam.pipeline.job import announce, prepare
from lslam.pipeline.odometry_pass import estimate_poses
from lslam.pipeline.precompile import helper_process, start_helper
from lslam.pipeline.stages import finalise_poses, in_folder, raise_outcome, score, write_results
from lslam.pipeline.watch import RunOutcome, Watch

if TYPE_CHECKING:
    from lslam.pipeline.rebuild import EarlierRun

log = logging.getLogger("lslam")


def run(
    sequence: Sequence | str | Path,
    config: Config | None = None,
    *,
    out: Path | str | None = None,
    ground_truth: Trajectory | None = None,
    overwrite: bool = False,
    resume: bool = False,
    command: str = "",
    reading: Mapping[str, str] | None = None,
    watch: Watch | None = None,
    earlier: EarlierRun | None = None,
) -> RunOutcome:
    """Estimate the trajectory of a sequence, build its map, score it when truth is known, and write the run folder.

    Parameters
    ----------
    sequence : an open sequence, or an argument of `open_sequence`
    config : the method and every other key: `load_config(settings=["odometry.method=gicp", "map.voxel=0.1"])`
    out : the run folder, a URL for one in storage; None writes nothing and builds no map
    ground_truth : replaces the sequence's own
    reading : options that `open_sequence` took (topics, extrinsics), for the manifest: `lslam map` needs them
    overwrite : replace an earlier run in `out`; resume : continue an unfinished one, if there is one
    command : command line for the manifest; watch : receives progress, and may stop the run
    earlier : a run of the same scans whose odometry is reused instead of running it

    Raises
    ------
    RunFinishedError : `resume`, and the run is complete. RunFailedError : diverged. InterruptedRunError :
        `watch.should_stop` returned True. GateError : `input.strict` and the run is degraded. In these three, everything up to
        there is written. InputError, OutputError, UsageError : as named.
    """
    watch = watch or Watch()
    config = config or Config()
    with collect_warnings() as warnings, helper_process(), jit.announce_compiling(log, partial(start_helper, config)):
        watch.on_start("preparing", 0)
        job = prepare(sequence, config, ground_truth, command, watch)
        if earlier is not None and not np.array_equal(job.sequence.stamps_ns, earlier.trajectory.stamps_ns):
            count = len(job.sequence)
            raise InputError(f"{job.sequence.path} does not fit {earlier.folder}: its {count} scans have other stamps")
        if ground_truth is not None and Path(ground_truth.source).is_file():
            job.manifest.truth_file = str(Path(ground_truth.source).absolute())
        job.manifest.reading, job.manifest.warnings = dict(reading or {}), warnings
        with in_folder(job, None if out is None else as_path(out), overwrite, resume, earlier) as job:
            announce(job)
            record = estimate_poses(job)
            back_end = finalise_poses(job, record)
            watch.on_start("results", 0)
            evaluation = score(record, job.sequence, job.config)
            write_results(job, record, back_end, evaluation)
    outcome = RunOutcome(record, evaluation)
    watch.on_end(outcome)
    raise_outcome(job.manifest, job.config, "" if out is None else ", and --resume goes on")
    return outcome


def plan(sequence: Sequence, config: Config, ground_truth: Trajectory | None = None) -> Sequence:
    """Dry run: check all input that `run` would read and return the scans it would take; nothing is written or fetched.

    Raises InputError and UsageError as `run` does before it begins.
    """
    return prepare(sequence, config, ground_truth, "", Watch()).sequence
