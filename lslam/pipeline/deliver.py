"""What a run delivers: all of it into its folder, whatever becomes of it; or its record alone."""

from __future__ import annotations

import logging
from pathlib import Path

from lslam.config import Config
from lslam.errors import GateError, InputError, InterruptedRunError, OutputError, RunFailedError, RunFinishedError
from lslam.evaluation.evaluate import Evaluation
from lslam.keyframes.store import KeyframeStore
from lslam.osm.corrections import write_buildings
from lslam.pipeline import outputs
from lslam.pipeline.back_end_pass import write_back_end
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.odometry_pass import odometry_checkpoints
from lslam.pipeline.resume import may_go_on, run_identity
from lslam.pipeline.run_folder import KEYFRAMES, RunFolder
from lslam.pipeline.stages import make_feature_map, make_map, make_report, solve
from lslam.pipeline.storage import check_place, spool_of, upload
from lslam.pipeline.watch import RunOutcome
from lslam.remote import RemotePath
from lslam.types.run_record import RunRecord

log = logging.getLogger("lslam")


def perform(
    job: PreparedRun, out: Path | None, overwrite: bool, resume: bool, odometry_of: Path | None = None
) -> RunOutcome:  # fmt: skip
    """The run, into its folder when there is one; `odometry_of` : the folder of a run whose odometry serves."""
    manifest = job.manifest
    if isinstance(out, RemotePath):
        return _perform_afar(job, out, overwrite, resume)
    if out is None:
        record, _, evaluation = solve(job, KeyframeStore(deflate=job.config.keyframes.deflate))
        manifest.take_over(record)
        record.manifest = manifest.as_dict(manifest.outcome)
        return RunOutcome(record, evaluation)
    manifest.identity = run_identity(job.sequence, job.truth, job.config, job.given)
    goes_on = resume and may_go_on(out, manifest.identity, job.config)
    with RunFolder(out, overwrite or resume, goes_on) as folder:
        try:
            if odometry_of is not None:
                folder.write_text("config.toml", outputs.config_text(job.config))
                folder.begin_from(odometry_of)
            record, evaluation = _fill(folder, job, goes_on or odometry_of is not None, odometry_of is not None)
        except BaseException as error:
            status = manifest.word_for(error)
            _write_last(folder, manifest.as_dict(status, str(error) or type(error).__name__))
            raise
        if manifest.outcome != "interrupted":
            folder.keep_odometry()
        folder.write_manifest(record.manifest)
        if manifest.outcome != "interrupted":
            folder.drop_checkpoint()
        log.info("%s; results in %s", manifest.outcome, folder.path)
    return RunOutcome(record, evaluation)


def _perform_afar(job: PreparedRun, place: RemotePath, overwrite: bool, resume: bool) -> RunOutcome:
    """The run, into a folder of this machine that is uploaded when it has ended; what is to go on stays where it is."""
    check_place(place, overwrite or resume)
    if resume:
        may_go_on(place, run_identity(job.sequence, job.truth, job.config, job.given), job.config)
    spool = spool_of(place)
    try:
        outcome = perform(job, spool, not resume, resume)
    except RunFinishedError:  # and was not uploaded
        upload(spool, place)
        raise
    if job.manifest.outcome != "interrupted":
        upload(spool, place)
    return outcome


def _fill(
    folder: RunFolder, job: PreparedRun, goes_on: bool, has_odometry: bool = False
) -> tuple[RunRecord, Evaluation | None]:
    """The whole result in a run folder, the last word of its manifest aside; `has_odometry` : that of another run serves.

    Raises InputError when that cannot be read.
    """
    folder.require_space(outputs.least_bytes(len(job.sequence)), "the result without its map")
    folder.write_text("config.toml", outputs.config_text(job.config))
    folder.write_manifest(job.manifest.as_dict("running"))
    store = KeyframeStore(folder.path / KEYFRAMES, deflate=job.config.keyframes.deflate)
    checkpoints = odometry_checkpoints(folder, job.odometry, job.config, goes_on)
    if has_odometry and (checkpoints is None or not checkpoints.is_over):
        raise InputError("the state of the run's odometry is damaged or incomplete: run the sequence again")
    record, done, evaluation = solve(job, store, folder.path, checkpoints)
    write_back_end(folder.path, record, store, done)
    if job.osm is not None and record.buildings is not None:
        write_buildings(folder.path, record.buildings, job.osm.data)
    outputs.write_trajectories(folder, record, job.sequence.calibration)
    outputs.write_scans(folder, record)
    if record.map_fixes:
        outputs.write_localization(folder, record)
    try:
        make_map(folder, job, record)
    finally:  # with the map's crispness, and whatever becomes of the map
        outputs.write_evaluation(folder, record, evaluation)
    make_feature_map(folder, job, record)
    make_report(folder, job, record, evaluation)
    return record, evaluation


def _write_last(folder: RunFolder, manifest: dict[str, object]) -> None:
    """The status, after everything else; a disk too full even for this must not hide the first error."""
    try:
        folder.write_manifest(manifest)
    except OutputError as error:
        log.error("%s", error)


def raise_outcome(manifest: Manifest, config: Config, way_out: str) -> None:
    """Raise what became of a run that is neither done nor merely degraded; `way_out` ends the sentence."""
    why = "; ".join(manifest.problems)
    if manifest.outcome == "interrupted":
        raise InterruptedRunError(f"{why}; what was done is written{way_out}")
    if manifest.outcome == "diverged":
        raise RunFailedError(f"the run diverged: {why}")
    if manifest.outcome == "degraded" and config.input.strict:
        raise GateError(
            f"--strict: the run is degraded: {'; '.join([*manifest.sequence.problems, *manifest.problems])}"
        )
