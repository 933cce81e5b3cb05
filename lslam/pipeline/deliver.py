"""What a run delivers: all of it into its folder, whatever becomes of it; or its record alone."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.outcome import BackEnd
from lslam.core.config import Config, load_config
from lslam.core.errors import GateError, InputError, InterruptedRunError, OutputError, RunFailedError, RunFinishedError
from lslam.core.types.run_record import RunRecord
from lslam.evaluation.evaluate import Evaluation
from lslam.io.remote import RemotePath
from lslam.osm.corrections import write_buildings
from lslam.pipeline import outputs
from lslam.pipeline.back_end_pass import write_back_end
from lslam.pipeline.job import PreparedRun, fit_to_scene
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.odometry_pass import odometry_checkpoints
from lslam.pipeline.resume import may_go_on, run_identity
from lslam.pipeline.run_folder import KEYFRAMES, RunFolder
from lslam.pipeline.stages import make_feature_map, make_map, make_report
from lslam.pipeline.storage import check_place, spool_of, upload

if TYPE_CHECKING:
    from lslam.pipeline.rebuild import EarlierRun

log = logging.getLogger("lslam")


@contextmanager
def in_folder(
    job: PreparedRun, out: Path | None, overwrite: bool, resume: bool, earlier: EarlierRun | None
) -> Iterator[PreparedRun]:
    """The run fitted to its scene, with its folder, which is held for the block and, in storage, uploaded after it.

    The status is written last, however the block ends. One in storage is filled on this machine; what is to go on stays there.
    earlier : the run whose odometry serves
    """
    if out is None:
        yield fit_to_scene(job)
        return
    manifest = job.manifest
    place = out if isinstance(out, RemotePath) else None
    if place is not None:
        check_place(place, overwrite or resume)
    manifest.identity = run_identity(job.sequence, job.truth, job.config, job.given)
    if place is not None and resume:
        may_go_on(place, manifest.identity, job.config)
    path = out if place is None else spool_of(place)
    try:
        goes_on = resume and may_go_on(path, manifest.identity, job.config)
    except RunFinishedError:
        if place is not None:  # it was not uploaded
            upload(path, place)
        raise
    with RunFolder(path, overwrite or resume or place is not None, goes_on) as folder:
        try:
            yield _begun(job, folder, goes_on, earlier)
        except BaseException as error:
            word = manifest.word_for(error)
            # A run that was stopped before it knew its configuration has nothing to go on with, and begins anew.
            if word != "interrupted" or (folder.path / "config.toml").is_file():
                _write_last(folder, manifest.as_dict(word, str(error) or type(error).__name__))
            raise
        if manifest.outcome != "interrupted":
            folder.keep_odometry()
        folder.write_manifest(manifest.last)
        if manifest.outcome != "interrupted":
            folder.drop_checkpoint()
        log.info("%s; results in %s", manifest.outcome, folder.path)
    if place is not None and manifest.outcome != "interrupted":
        upload(path, place)


def _begun(job: PreparedRun, folder: RunFolder, goes_on: bool, earlier: EarlierRun | None) -> PreparedRun:
    """The run in its folder, which says so from now on.

    Raises InputError when the odometry of the earlier run cannot be read.
    """
    folder.require_space(outputs.least_bytes(len(job.sequence)), "the result without its map")
    job = fit_to_scene(job, load_config(folder.path / "config.toml", environ={}) if goes_on else None)
    folder.write_text("config.toml", outputs.config_text(job.config))
    if earlier is not None:
        folder.begin_from(earlier.folder)
    folder.write_manifest(job.manifest.as_dict("running"))
    store = KeyframeStore(folder.path / KEYFRAMES, deflate=job.config.keyframes.deflate)
    checkpoints = odometry_checkpoints(folder, job, goes_on or earlier is not None)
    if earlier is not None and (checkpoints is None or not checkpoints.is_over):
        raise InputError("the state of the run's odometry is damaged or incomplete: run the sequence again")
    return replace(job, store=store, folder=folder, checkpoints=checkpoints)


def write_results(job: PreparedRun, record: RunRecord, done: BackEnd, evaluation: Evaluation | None) -> None:
    """The whole result, into the folder of the run where it has one, and the manifest into the record."""
    folder = job.folder
    if folder is None:
        job.manifest.take_over(record)
        record.manifest = job.manifest.conclude()
        return
    write_back_end(folder.path, record, job.store, done)
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
