"""The stages of a run after odometry: final poses, score, map, feature map, report."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.backend.outcome import BackEnd, view_loop
from lslam.core.config import Config
from lslam.core.errors import LslamError
from lslam.core.types.run_record import RunRecord
from lslam.core.types.sequence import Sequence
from lslam.evaluation.evaluate import Evaluation, evaluate
from lslam.maps.crispness import crispness
from lslam.odometry.base import FeatureSource
from lslam.pipeline import outputs
from lslam.pipeline.back_end_pass import describe, level_world, optimise_poses
from lslam.pipeline.feature_pass import build_feature_map, view_features
from lslam.pipeline.job import PreparedRun, stoppable
from lslam.pipeline.localise_pass import localise_poses
from lslam.pipeline.map_pass import build_map, map_checkpoints
from lslam.pipeline.run_folder import RunFolder

log = logging.getLogger("lslam")


def finalise_poses(job: PreparedRun, record: RunRecord) -> BackEnd:
    """Put the final poses into the record: those of the pose graph, level; or, in its place, those in an existing map."""
    if job.config.localize.map:
        localise_poses(job, record)
        if record.georeference is not None:
            job.manifest.georeference = describe(record.georeference)
        return BackEnd(record.results)
    done = optimise_poses(job, record)
    level_world(record, job.sequence, job.config, job.manifest)
    record.loop_view = view_loop(record, done, job.store)
    return done


def score(record: RunRecord, sequence: Sequence, config: Config) -> Evaluation | None:
    """The evaluation, or None with the reason among the record's problems."""
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
        record.unscored = str(error)
        record.problems.append(f"not scored: {error}")
        log.warning("not scored: %s", error)
        if record.folder is not None:
            log.info("score it with other recipes: lslam eval %s GT", record.folder / "trajectory.tum")
        return None
    record.problems += score.faults
    return score


def make_map(folder: RunFolder, job: PreparedRun, record: RunRecord) -> None:
    """The merged map, from the raw scans and the final poses."""
    config, watch, manifest = job.config, job.watch, job.manifest
    if not config.map.write or manifest.outcome == "interrupted":
        return
    watch.on_start("map", len(record.results))
    with manifest.timed("map_s"), stoppable(job, "interrupted while the map was written"):
        built = build_map(
            job.sequence, record.results, config, watch.on_step, watch.should_stop, folder.path,
            map_checkpoints(folder, config),
        )  # fmt: skip
        score = crispness(built.merged)
        outputs.write_map(folder, built, config.map, record)
        record.map_file, record.map_sample = f"map.{config.map.format}", built.sample
        record.map_image, record.map_heights = built.view.image, built.view.heights
        record.map_extent = built.view.extent
        record.crispness = score
        manifest.map_points = len(built.merged)


def make_feature_map(folder: RunFolder, job: PreparedRun, record: RunRecord) -> None:
    """The feature map, likewise, when it was asked for."""
    config, watch, manifest, odometry = job.config, job.watch, job.manifest, job.odometry
    if not config.map.write_features or manifest.outcome == "interrupted" or not isinstance(odometry, FeatureSource):
        return
    watch.on_start("feature map", len(record.results))
    with manifest.timed("feature_map_s"), stoppable(job, "interrupted while the feature map was written"):
        built = build_feature_map(
            job.sequence, odometry, record.results, config, watch.on_step, watch.should_stop,
            map_checkpoints(folder, config, "feature map"),
        )  # fmt: skip
        outputs.write_feature_map(folder, built)
        log.info("feature map: %d points in %s", len(built), folder.path / "feature_map.ply")


def make_report(folder: RunFolder, job: PreparedRun, record: RunRecord, evaluation: Evaluation | None) -> None:
    """report.html; the record's manifest is the run's last word, with the report's own time."""
    manifest = job.manifest
    manifest.take_over(record)
    record.manifest = manifest.conclude()
    with manifest.timed("report_s"):
        if job.config.report.html:
            if isinstance(job.odometry, FeatureSource):
                record.features = view_features(job.sequence, job.odometry, record.results)
            outputs.write_html(folder, record, evaluation)
    if job.watch.should_stop() and manifest.outcome not in ("interrupted", "diverged"):
        manifest.interrupt("interrupted before the report was whole")
    record.manifest = manifest.conclude()
