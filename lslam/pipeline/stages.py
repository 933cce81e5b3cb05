"""The stages of a run: its folder, final poses, score, map, feature map, report."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.loops.find_loops import view_pairs
from lslam.backend.outcome import BackEnd, view_loop
from lslam.core.config import Config, load_config
from lslam.core.errors import (
    GateError,
    InputError,
    InterruptedRunError,
    LslamError,
    RunFailedError,
    RunFinishedError,
)
from lslam.core.kernels import jit
from lslam.core.machine import rarely_collecting
from lslam.core.types.run_record import RunRecord
from lslam.core.types.sequence import Sequence
from lslam.evaluation.evaluate import Evaluation, evaluate
from lslam.io.remote import RemotePath
from lslam.maps.crispness import crispness
from lslam.odometry.base import FeatureSource
from lslam.osm.corrections import write_buildings
from lslam.pipeline import outputs
from lslam.pipeline.back_end_pass import describe, level_world, optimise_poses, refine_poses, write_back_end
from lslam.pipeline.further_passes import build_feature_map, build_finished_map, view_features
from lslam.pipeline.job import PreparedRun, fit_to_scene, stoppable
from lslam.pipeline.localise_pass import localise_poses
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.map_pass import map_checkpoints
from lslam.pipeline.odometry_pass import odometry_checkpoints
from lslam.pipeline.precompile import load_parts
from lslam.pipeline.resume import may_go_on, run_identity
from lslam.pipeline.run_folder import KEYFRAMES, RunFolder, check_place, spool_of, upload

if TYPE_CHECKING:
    from lslam.pipeline.rebuild import EarlierRun

log = logging.getLogger("lslam")


def finalise_poses(job: PreparedRun, record: RunRecord) -> BackEnd:
    """Put the final poses into the record: of the pose graph, made level, or of localisation in a prior map."""
    _load(job, "loops", "walls")
    if job.config.localize.map:
        localise_poses(job, record)
        if record.georeference is not None:
            job.manifest.georeference = describe(record.georeference)
        return BackEnd(record.results)
    back_end = refine_poses(job, record, optimise_poses(job, record))
    level_world(record, job.sequence, job.config, job.manifest)
    record.loop_view = view_loop(record, back_end, job.store)
    record.pair_views = view_pairs(record, job.store, job.config.keyframes.submap_size)
    return back_end


def _load(job: PreparedRun, *parts: str) -> None:
    """After a cold start, compile or load the kernels of these parts. At others each is loaded when it is called."""
    if not jit.did_compile():
        return
    with job.manifest.time("compile_s"), rarely_collecting(), jit.count_kernels(log, None):
        load_parts(job.config, parts)


def score(record: RunRecord, sequence: Sequence, config: Config) -> Evaluation | None:
    """Evaluation against ground truth; None, with the reason among the record's problems."""
    if record.ground_truth is None:
        return None
    # Poses in frames of their own have no error.
    own = np.array([r.frame == 0 for r in record.results])
    try:
        score = evaluate(
            record.trajectory.select(own), record.ground_truth, config.eval, calibration=sequence.calibration
        )
        if record.odometry is not None and record.odometry is not record.trajectory:
            before = evaluate(
                record.odometry.select(own), record.ground_truth, config.eval, calibration=sequence.calibration
            )
            score = replace(score, odometry=before)
    except LslamError as error:
        record.no_score_reason = str(error)
        record.problems.append(f"not scored: {error}")
        log.warning("not scored: %s", error)
        if record.folder is not None:
            log.info("score it with other recipes: lslam eval %s GT", record.folder / "trajectory.tum")
        return None
    record.problems += score.faults
    return score


def make_map(folder: RunFolder, job: PreparedRun, record: RunRecord) -> None:
    """Build and write the merged map from the raw scans and the final poses, if configured."""
    config, watch, manifest = job.config, job.watch, job.manifest
    if not config.map.write or manifest.outcome == "interrupted":
        return
    watch.on_start("map", len(record.results))
    with manifest.time("map_s"), stoppable(job, "interrupted while the map was written"):
        built = build_finished_map(
            job.sequence,
            record.results,
            config,
            watch,
            folder.path,
            map_checkpoints(folder, config),
            manifest.problems,
        )
        score = crispness(built.cloud) if config.map.voxel else None
        outputs.write_map(folder, built, config.map, record)
        record.map_file = f"map.{config.map.format}"
        if not record.map_fixes:  # else the page shows the drive on the map that it was located in
            record.map_sample, record.map_extent = built.sample, built.view.extent
            record.map_image, record.map_heights = built.view.image, built.view.heights
        record.crispness = score
        manifest.map_points, manifest.map_colour = len(built.cloud), built.colour


def make_feature_map(folder: RunFolder, job: PreparedRun, record: RunRecord) -> None:
    """Build and write the feature map from the raw scans and the final poses, if configured and the method has features."""
    config, watch, manifest, odometry = job.config, job.watch, job.manifest, job.odometry
    if not config.map.write_features or manifest.outcome == "interrupted" or not isinstance(odometry, FeatureSource):
        return
    watch.on_start("feature map", len(record.results))
    with manifest.time("feature_map_s"), stoppable(job, "interrupted while the feature map was written"):
        checkpoints = map_checkpoints(folder, config, "feature map")
        features = build_feature_map(job.sequence, odometry, record.results, config, watch, checkpoints)
        outputs.write_feature_map(folder, features)
        log.info("feature map: %d points in %s", len(features), folder.path / "feature_map.ply")


def make_report(folder: RunFolder, job: PreparedRun, record: RunRecord, evaluation: Evaluation | None) -> None:
    """Write report.html. The record's manifest is final then, including the report's own time."""
    manifest = job.manifest
    job.watch.on_start("report", 0)
    manifest.take_over(record)
    record.manifest = manifest.conclude()
    with manifest.time("report_s"):
        if job.config.report.html:
            if isinstance(job.odometry, FeatureSource):
                record.features = view_features(job.sequence, job.odometry, record.results)
            outputs.write_html(folder, record, evaluation)
    if job.watch.should_stop() and manifest.outcome not in ("interrupted", "diverged"):
        manifest.interrupt("interrupted before the report was whole")
    record.manifest = manifest.conclude()


@contextmanager
def in_folder(
    job: PreparedRun, out: Path | None, overwrite: bool, resume: bool, earlier: EarlierRun | None
) -> Iterator[PreparedRun]:
    """Context of the run fitted to its scene, with its folder locked, and uploaded at the end if it is in storage.

    The status is written last, also after an exception. A run in storage is written on this machine first; an interrupted
    one remains there. earlier : the run whose odometry is reused
    """
    if out is None:
        yield fit_to_scene(job)
        return
    manifest = job.manifest
    place = out if isinstance(out, RemotePath) else None
    if place is not None:
        check_place(place, overwrite or resume)
    manifest.identity = run_identity(
        job.sequence, job.truth, job.config, job.poses, None if job.wheels.motion is None else job.wheels.motion.wheels
    )
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
            yield _begin(job, folder, goes_on, earlier)
        except BaseException as error:
            word = manifest.word_for(error)
            # A run that was stopped before it knew its configuration has nothing to go on with, and begins anew.
            if word != "interrupted" or (folder.path / "config.toml").is_file():
                folder.write_failure(manifest.as_dict(word, str(error) or type(error).__name__))
            raise
        if manifest.outcome != "interrupted":
            folder.keep_odometry()
        folder.write_manifest(manifest.last)
        if manifest.outcome != "interrupted":
            folder.drop_checkpoint()
        log.info("%s; results in %s", manifest.outcome, folder.path)
    if place is not None and manifest.outcome != "interrupted":
        upload(path, place)


def _begin(job: PreparedRun, folder: RunFolder, goes_on: bool, earlier: EarlierRun | None) -> PreparedRun:
    """The run in its folder, its manifest `running`. Raises InputError if an earlier run's odometry is unreadable."""
    folder.require_space(outputs.least_bytes(len(job.sequence)), "the result without its map")
    job = fit_to_scene(job, load_config(folder.path / "config.toml", environ={}) if goes_on else None)
    folder.write_text("config.toml", outputs.config_text(job.config))
    if earlier is not None:
        folder.begin_from(earlier.folder)
    folder.write_manifest(job.manifest.as_dict("running"))
    store = KeyframeStore(folder.path / KEYFRAMES)
    checkpoints = odometry_checkpoints(folder, job, goes_on or earlier is not None)
    if earlier is not None and (checkpoints is None or not checkpoints.is_over):
        raise InputError("the state of the run's odometry is damaged or incomplete: run the sequence again")
    return replace(job, store=store, folder=folder, checkpoints=checkpoints)


def write_results(job: PreparedRun, record: RunRecord, back_end: BackEnd, evaluation: Evaluation | None) -> None:
    """Write all results into the run's folder, if it has one, and the manifest into the record."""
    folder = job.folder
    if folder is None:
        job.manifest.take_over(record)
        record.manifest = job.manifest.conclude()
        return
    write_back_end(folder.path, record, job.store, back_end)
    if job.osm is not None and record.buildings is not None:
        write_buildings(folder.path, record.buildings, job.osm.data)
    outputs.write_trajectories(folder, record, job.sequence.calibration)
    outputs.write_scans(folder, record)
    if record.map_fixes:
        outputs.write_localization(folder, record)
    _load(job, "map", "colours")
    try:
        make_map(folder, job, record)
    finally:  # with the map's crispness, and whatever becomes of the map
        outputs.write_evaluation(folder, record, evaluation)
    make_feature_map(folder, job, record)
    make_report(folder, job, record, evaluation)


def raise_outcome(manifest: Manifest, config: Config, way_out: str) -> None:
    """Raise the error of a run that diverged, was stopped, or is degraded under `input.strict`; `way_out` ends the sentence."""
    why = "; ".join(manifest.problems)
    if manifest.outcome == "interrupted":
        raise InterruptedRunError(f"{why}; what was done is written{way_out}")
    if manifest.outcome == "diverged":
        raise RunFailedError(f"the run diverged: {why}")
    if manifest.outcome == "degraded" and config.input.strict:
        raise GateError(
            f"--strict: the run is degraded: {'; '.join([*manifest.sequence.problems, *manifest.problems])}"
        )
